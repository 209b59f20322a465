"""What the subcommands of a verdict share: the frames of a dataset, ready to be judged, and what a user tolerates."""

import json
from typing import NamedTuple

import xarray as xr

from spotcheck import store
from spotcheck.dataset import Dataset
from spotcheck.errors import InputError
from spotcheck.estimate.sensor import known_beforehand, model_of, stderr_of
from spotcheck.old_engine import criteria
from spotcheck.old_engine.boundary import old_sensor
from spotcheck.old_engine.model.baseline import of_instrument
from spotcheck.old_engine.observe.frames import Setting
from spotcheck.old_engine.observe.shots import Shot, left_out, never_chose, shots_of, together

UNKNOWN_SENSOR = "gain or read noise of the sensor is unknown, and the frames do not tell them"


class Tolerance(NamedTuple):
    """What is not called a disagreement: rms of what is left of mean images [peak], and the rate of false alarms."""

    of_peak: float = criteria.LEFT.value
    alpha: float = criteria.ALPHA.value


class OpenSet(NamedTuple):
    """All usable frames, what the instrument fixes, and what of the dataset no verdict rests on ("": nothing)."""

    shots: list[Shot]
    setting: Setting
    beware: str


def open_set(found: Dataset, crops: xr.Dataset, sensor: xr.Dataset) -> OpenSet | str:
    """The frames of a dataset, ready to be judged; or why they cannot be."""
    shots, astray = together(shots_of(found, crops), found.instrument.crop_px)
    missing = left_out(found, crops)
    if not shots:
        return missing
    known = model_of(sensor)
    if known is None:
        return UNKNOWN_SENSOR
    model = old_sensor(known)
    if not found.exposures:
        model = model._replace(dark_current_e_per_s=0.0)
    rows, columns = crops.sizes["row"], crops.sizes["column"]
    baseline = of_instrument(found.instrument, found.exposures)
    setting = Setting(baseline, model, stderr_of(sensor), rows, columns, known_beforehand(sensor))
    remarks = (missing, astray, never_chose(shots), *store.remarks_of(sensor))
    return OpenSet(shots, setting, "; ".join(remark for remark in remarks if remark))


def tolerance_of(text: str) -> Tolerance:
    """Tolerance from the JSON of the configuration."""
    try:
        return Tolerance(**json.loads(text))
    except (TypeError, ValueError):
        raise InputError(
            f"--tolerance: {text} is no JSON object of of_peak and alpha; write e.g. "
            '{"of_peak": 0.002, "alpha": 0.01}'
        ) from None
