"""What the subcommands of the verdict share: the set of frames, opened the same way by each."""

import json
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.dataset import Dataset
from spotcheck.discrepancy.base import Base
from spotcheck.discrepancy.calibration import Kind
from spotcheck.discrepancy.cells import Setting
from spotcheck.discrepancy.extend import Findings, Tolerance
from spotcheck.discrepancy.saved import recalled
from spotcheck.discrepancy.shots import Design, Shot, shots_of
from spotcheck.discrepancy.verdict import prepared
from spotcheck.errors import InputError
from spotcheck.estimate.sensor import model_of
from spotcheck.model.baseline import of_instrument


class OpenSet(NamedTuple):
    """All usable frames, those that may choose the model, their design and base, and what stays the same."""

    shots: list[Shot]
    chosen: list[Shot]
    design: Design
    base: Base
    setting: Setting
    kind: Kind


def open_set(found: Dataset, crops: xr.Dataset, sensor: xr.Dataset) -> OpenSet | str:
    """The frames of a dataset, ready to be judged; or why they cannot be."""
    model = model_of(sensor)
    if model is None:
        return "gain or read noise of the sensor is unknown, and the frames do not tell them"
    rows, columns = crops.sizes["row"], crops.sizes["column"]
    if not found.exposures:
        model = model._replace(dark_current_e_per_s=0.0)
    baseline = of_instrument(found.instrument, found.exposures)
    setting = Setting(baseline, model, float(rows), ((columns - 1) / 2, (rows - 1) / 2))
    bits = int(np.ceil(np.log2(model.full_scale_dn + 1)))
    kind = Kind(found.instrument.crop_px, bits, baseline.photon_budget, baseline.top_hat)
    shots = shots_of(found, crops)
    ready = prepared(shots, setting, kind)
    return ready if isinstance(ready, str) else OpenSet(shots, *ready, setting, kind)


def findings_of(saved: dict, ready: OpenSet) -> Findings:
    """What the loop found, taken up from its file."""
    return recalled(saved, ready.chosen, ready.design, ready.base, ready.setting)


def tolerance_of(text: str) -> Tolerance:
    """Tolerance from the JSON of the configuration."""
    try:
        return Tolerance(**json.loads(text))
    except (TypeError, ValueError):
        raise InputError(
            f"--tolerance: {text} is no JSON object of of_peak, of_noise and alpha; write e.g. "
            '{"of_peak": 0.002, "of_noise": 0.02, "alpha": 0.01}'
        ) from None
