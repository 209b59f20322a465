"""The sensor that the chain runs on: data sheet where it speaks, frames where they allow, else unknown with the
reason."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck import store
from spotcheck.dataset import Dataset
from spotcheck.estimate.noise import NoiseCurve, gain_from_curve, noise_curve
from spotcheck.frames import Surround, full_scale
from spotcheck.model.sensor import ROUNDING_VARIANCE, SensorModel

QUANTITIES = {
    "gain_dn_per_e": ("DN/e-", "overall gain K"),
    "read_noise_e": ("e-", "read noise, rms"),
    "dark_current_e_per_s": ("e-/s", "dark current"),
    "quantum_efficiency": ("1", "quantum efficiency"),
    "full_well_e": ("e-", "full well"),
    "black_level_dn": ("DN", "reading without light"),
    "full_scale_dn": ("DN", "largest reading of the converter"),
}

# A dark frame holds light that reads more than the darkest by this part of full scale; less does not matter.
LIT = 1e-3


class Darks(NamedTuple):
    """Level [DN] of each dark frame without light in it, and what is wrong with the others ("" if nothing)."""

    levels: list[float]
    remark: str


def level_of(frame: Surround) -> float:
    """What a frame reads in most of its rows, columns or blocks [DN]: a spot and hot pixels hardly move it."""
    return float(min(np.nanmedian(values) for values in frame))


def judge_darks(darks: Iterable[Surround], spots: Iterable[Surround], full_scale_dn: float) -> Darks:
    """Which dark frames are dark. Light only adds to a reading: no frame, beside its spot, reads less than black; and
    a dark frame reads alike all over."""
    found = [(level_of(frame), float(np.mean(frame.row_mean))) for frame in darks]
    if not found:
        return Darks([], "")
    darkest = min([*(level for level, _ in found), *(level_of(frame) for frame in spots)])
    good = [level for level, mean in found if max(level, mean) <= darkest + LIT * full_scale_dn]
    if len(good) == len(found):
        return Darks(good, "")
    brightest = max(mean for _, mean in found)
    lit = f"{len(found) - len(good)} of {len(found)} dark frames hold light"
    why = f"they read up to {brightest:.4g} DN on average, where black is {darkest:.4g} DN at most"
    taken = "that of the others" if good else "not taken from them"
    return Darks(good, f"{lit} ({why}), so the black level is {taken}")


def resolve(
    dataset: Dataset,
    container_bits: int,
    crops: Iterable[np.ndarray],
    dark_means: Sequence[float] = (),
    remark: str = "",
) -> xr.Dataset:
    """Every sensor quantity with its standard error and its source; NaN and the reason where it stays unknown. With a
    `remark` on the dark frames wherever the black level would come from them."""
    given = dataset.instrument.sensor
    highest = full_scale(dataset.instrument, container_bits)
    value: dict[str, float | None] = {name: getattr(given, name, None) for name in QUANTITIES}
    source = {name: dataset.instrument.source(f"sensor.{name}") for name in QUANTITIES}
    stderr = dict.fromkeys(QUANTITIES, np.nan)
    value["full_scale_dn"], source["full_scale_dn"] = float(highest), "bits of the converter"
    if source["black_level_dn"] == "default" and len(dark_means):
        count = len(dark_means)
        value["black_level_dn"] = float(np.mean(dark_means))
        stderr["black_level_dn"] = float(np.std(dark_means, ddof=1) / np.sqrt(count)) if count > 1 else np.nan
        source["black_level_dn"] = f"mean of {count} dark frame{'s' if count > 1 else ''}"
    remark = "" if dataset.instrument.source("sensor.black_level_dn") != "default" else remark
    if remark:
        source["black_level_dn"] += f"; {remark}"
    if given.bit_depth is None:
        source["full_scale_dn"] = f"container of {container_bits} bit (sensor.bit_depth is missing)"
    if value["full_well_e"] is None:
        value["full_well_e"], source["full_well_e"] = np.inf, "none given"
    if value["gain_dn_per_e"] is None or value["read_noise_e"] is None:
        _from_frames(value, stderr, source, crops, highest)
    ds = store.grid(dataset).drop_vars([axis.name for axis in dataset.axes if axis.values is not None])
    ds.attrs["remark"] = remark
    for name, (units, long_name) in QUANTITIES.items():
        known = value[name]
        number = np.nan if known is None else float(known)
        ds[name] = ((), number, {"units": units, "long_name": long_name, "source": source[name]})
        ds[f"{name}_stderr"] = (
            (),
            stderr[name],
            {"units": units, "long_name": f"standard error of {long_name}"},
        )
    return ds


def _from_frames(value: dict, stderr: dict, source: dict, crops: Iterable[np.ndarray], highest: float) -> None:
    """Fill gain and read noise from the differences of neighbouring pixels, all frames pooled."""
    curves = [curve for curve in (noise_curve(crop, highest) for crop in crops) if curve.level.size]
    pooled = NoiseCurve(*(np.concatenate(parts) for parts in zip(*curves, strict=True))) if curves else None
    found = gain_from_curve(pooled, value["black_level_dn"]) if pooled else None
    if found is None:
        for name in ("gain_dn_per_e", "read_noise_e"):
            if value[name] is None:
                source[name] = "unknown: not in instrument.yaml, and no frame shows noise that grows with its light"
        return
    how = f"differences of neighbouring pixels in {len(curves)} frame{'s' if len(curves) > 1 else ''}"
    if value["gain_dn_per_e"] is None:
        value["gain_dn_per_e"], stderr["gain_dn_per_e"], source["gain_dn_per_e"] = found.gain, found.gain_stderr, how
    if value["read_noise_e"] is None:
        gain, gain_error = float(value["gain_dn_per_e"]), float(np.nan_to_num(stderr["gain_dn_per_e"]))
        floor = max(found.floor - ROUNDING_VARIANCE, 0.0)
        noise = np.sqrt(floor) / gain
        value["read_noise_e"], source["read_noise_e"] = noise, how
        # σ = √floor/K: a floor of 0 within its error leaves a noise of 0 with the error of √floor_stderr.
        own = min(found.floor_stderr / (2 * np.sqrt(floor)) if floor > 0 else np.inf, np.sqrt(found.floor_stderr))
        stderr["read_noise_e"] = float(np.hypot(own / gain, noise * gain_error / gain))


def model_of(ds: xr.Dataset) -> SensorModel | None:
    """Sensor model of a sensor file; None where gain or read noise is unknown."""
    numbers = {name: float(ds[name]) for name in QUANTITIES}
    if not np.isfinite(numbers["gain_dn_per_e"]) or not np.isfinite(numbers["read_noise_e"]):
        return None
    return SensorModel(**numbers)
