"""A case of the rig as an analysis sees it: crops of all frames by the library's own search for the spot, and the data
sheet."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rig import hidden
from spotcheck import frames, instrument
from spotcheck.discrepancy.calibration import Kind
from spotcheck.discrepancy.cells import Setting
from spotcheck.discrepancy.shots import Shot
from spotcheck.instrument import Instrument
from spotcheck.model.baseline import of_instrument
from spotcheck.model.sensor import SensorModel


class Set(NamedTuple):
    """What an analysis may see of a case."""

    shots: list[Shot]
    setting: Setting
    kind: Kind


def set_of(case: hidden.Case) -> Set:
    """Crops of all frames, by the library's own search for the spot."""
    data_sheet = instrument_of(case.instrument)
    crop = data_sheet.crop_px
    shots, shape = [], (0, 0)
    for k, (row, frame) in enumerate(hidden.frames(case)):
        spot = frames.light_centroid(frame, crop)
        image, shape = frames.cut(frame, spot, crop), frame.shape
        if not spot.found:
            continue
        left, top = spot.column - crop // 2, spot.row - crop // 2
        shots.append(
            Shot(
                _number(row["angle_deg"]),
                _number(row["exposure_s"]),
                int(row["repeat"]),
                k,
                (),
                left,
                top,
                constant(image),
            )
        )
    own = data_sheet.sensor
    assert own.gain_dn_per_e is not None and own.read_noise_e is not None
    full_scale = 2.0 ** (own.bit_depth or 0) - 1
    sensor = SensorModel(
        own.gain_dn_per_e, own.read_noise_e, own.dark_current_e_per_s,
        np.inf if own.full_well_e is None else own.full_well_e, own.black_level_dn, full_scale, own.quantum_efficiency,
    )  # fmt: skip
    exposures = tuple(sorted({s.exposure_s for s in shots if s.exposure_s is not None}))
    baseline = of_instrument(data_sheet, exposures)
    rows, columns = shape
    setting = Setting(baseline, sensor, float(rows), ((columns - 1) / 2, (rows - 1) / 2))
    return Set(shots, setting, Kind(crop, own.bit_depth or 0, baseline.photon_budget, baseline.top_hat))


def instrument_of(content: dict[str, Any]) -> Instrument:
    """Instrument from the content of instrument.yaml."""
    own = dict(content)
    sections = {name: kind(**(own.pop(name, None) or {})) for name, kind in instrument.SECTIONS.items()}
    return Instrument(**own, **sections)


def constant(image: np.ndarray) -> Callable[[], np.ndarray]:
    return lambda: image


def _number(value: Any) -> float | None:
    return None if value in ("", None) else float(value)
