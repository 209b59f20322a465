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
from spotcheck.discrepancy.shots import Design, Shot, design_of, left_out, never_chose, shots_of, together
from spotcheck.discrepancy.verdict import prepared
from spotcheck.errors import InputError
from spotcheck.estimate.sensor import model_of
from spotcheck.model.baseline import of_instrument


class OpenSet(NamedTuple):
    """All usable frames, those that may choose the model, their design and base, what stays the same, and what the
    dataset holds that no verdict rests on ("" if nothing)."""

    shots: list[Shot]
    chosen: list[Shot]
    design: Design
    base: Base
    setting: Setting
    kind: Kind
    beware: str


def open_set(found: Dataset, crops: xr.Dataset, sensor: xr.Dataset) -> OpenSet | str:
    """The frames of a dataset, ready to be judged; or why they cannot be."""
    shots, astray = together(shots_of(found, crops), found.instrument.crop_px)
    missing = left_out(found, crops)
    if not shots:
        return missing
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
    remarks = [missing, astray, never_chose(design_of(shots)), sensor.attrs.get("remark", "")]
    remarks = [remark for remark in remarks if remark]
    ready = prepared(shots, setting, kind)
    if isinstance(ready, str):
        return "; ".join([ready, *remarks])
    return OpenSet(shots, *ready, setting, kind, "; ".join(remarks))


def findings_of(saved: dict, ready: OpenSet) -> Findings:
    """What the loop found, taken up from its file."""
    again = recalled(saved, ready.chosen, ready.design, ready.base, ready.setting)
    # What no effect was assessed on stands beside the effects that were not assessed.
    remarks = [remark for remark in (ready.beware, again.not_assessed.get("all", "")) if remark]
    return again._replace(not_assessed=again.not_assessed | ({"all": "; ".join(remarks)} if remarks else {}))


def tolerance_of(text: str) -> Tolerance:
    """Tolerance from the JSON of the configuration."""
    try:
        return Tolerance(**json.loads(text))
    except (TypeError, ValueError):
        raise InputError(
            f"--tolerance: {text} is no JSON object of of_peak, of_noise and alpha; write e.g. "
            '{"of_peak": 0.002, "of_noise": 0.02, "alpha": 0.01}'
        ) from None
