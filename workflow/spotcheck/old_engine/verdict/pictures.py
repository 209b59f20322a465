"""discrepancy.nc: all that the pictures of a verdict show, over the grid of conditions."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy import stats

from spotcheck import store
from spotcheck.dataset import Dataset
from spotcheck.old_engine.conclude.detect import Detection
from spotcheck.old_engine.conclude.judgement import Fits, Judgement
from spotcheck.old_engine.observe.pixels import Expectation, Frame, Model

BEFORE, AFTER = "before", "after"
# Sides of the square blocks of pixels: so many along the crop's shorter side.
BLOCKS = 40
# Inner radii of rings around the spot's centre [σ_g], the last one open.
RINGS = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
# Azimuthal orders of a ring that are looked at, from 1 on.
ORDERS = 6


class Summed(NamedTuple):
    """Sums over the pixels of each block [frame, block row, block column]: readings, measured less model and its
    variance, and how many pixels they are of."""

    reading: np.ndarray
    rest: np.ndarray
    variance: np.ndarray
    pixels: np.ndarray


class Canvas(NamedTuple):
    """Names and lengths of the grid's dimensions without repeats, and the place on it of each condition [condition]."""

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    places: list[tuple[int, ...]]

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Values [condition, …] on the grid, NaN where there is no condition."""
        out = np.full((*self.shape, *values.shape[1:]), np.nan)
        for place, own in zip(self.places, values, strict=True):
            out[place] = own
        return out


def pictures_of(judgement: Judgement, verdict: dict[str, Any], dataset: Dataset) -> xr.Dataset:
    """The pictures' data of a judgement; what was not assessed leaves only attributes, with the reason in `skipped`."""
    out = store.grid(dataset).drop_vars("repeat", errors="ignore")
    out.attrs |= {"status": verdict["status"], "alpha": verdict["detection"]["alpha"]}
    fits = judgement.fits
    if fits is None or judgement.gap is None:
        return out.assign_attrs(skipped=judgement.why_not)
    canvas = _canvas(fits, dataset)
    side = max(min(fits.frames[0].pixels.shape) // BLOCKS, 1)
    stages = {BEFORE: summed(fits.frames, fits.before, side)}
    if verdict["effects"]:
        stages[AFTER] = summed(fits.frames, fits.after, side)
    _add_spots(out, canvas, fits)
    wide = side * fits.frames[0].step
    _add_maps(out, canvas, fits, stages, wide)
    _add_gap(out, canvas, fits, stages)
    _add_rings(out, canvas, fits, stages[BEFORE], wide)
    if judgement.detection is not None:
        _add_parts(out, judgement.detection)
    return out


def summed(frames: Sequence[Frame], model: Model, side: int) -> Summed:
    """Sums over blocks of so many pixels to a side, those left over at the far edges left out."""
    ready, sums = Expectation(frames, model), []
    for k, frame in enumerate(frames):
        seen, known = ready.of(frame, k), np.isfinite(frame.pixels)
        parts = (frame.pixels, frame.pixels - seen.mean, seen.variance, np.ones_like(seen.mean))
        sums.append([_blocks(np.where(known, part, 0.0), side) for part in parts])
    return Summed(*np.swapaxes(np.array(sums), 0, 1))


def _blocks(values: np.ndarray, side: int) -> np.ndarray:
    rows, columns = (n // side for n in values.shape)
    return values[: rows * side, : columns * side].reshape(rows, side, columns, side).sum(axis=(1, 3))


def _canvas(fits: Fits, dataset: Dataset) -> Canvas:
    axes = [axis for axis in dataset.axes if axis.name != "repeat"]
    condition = fits.design.condition
    first = [fits.shots[int(np.flatnonzero(condition == c)[0])] for c in np.unique(condition)]
    places = [
        tuple(axis.index(value) for axis, value in zip(axes, (s.angle_deg, s.exposure_s, *s.conditions), strict=True))
        for s in first
    ]
    return Canvas(tuple(axis.name for axis in axes), tuple(axis.size for axis in axes), places)


def _put(out: xr.Dataset, name: str, dims: tuple[str, ...], values: Any, units: str, long_name: str) -> None:
    values = np.asarray(values)
    values = values.astype("f4") if values.dtype.kind == "f" and values.ndim > 2 else values
    out[name] = (dims, values, {"units": units, "long_name": long_name})


def _means(fits: Fits, values: np.ndarray) -> np.ndarray:
    """Means over the frames of each condition [condition, …]; NaN where none of them knows."""
    condition = fits.design.condition
    with np.errstate(invalid="ignore"):
        known = np.isfinite(values)
        own = [condition == c for c in np.unique(condition)]
        return np.array([np.where(known[at], values[at], 0).sum(0) / known[at].sum(0) for at in own])


def _add_spots(out: xr.Dataset, canvas: Canvas, fits: Fits) -> None:
    """Where the spot lies in the crop, how wide it is, and how bright the brightest is."""
    numbers, corner = fits.before.numbers, [(f.view.x.min(), f.view.y.min()) for f in fits.frames]
    left, top = np.array(corner).T
    for name, values, text in (
        ("spot_x", numbers.x - left, "column of the spot's centre in the crop, mean over frames"),
        ("spot_y", numbers.y - top, "row of the spot's centre in the crop, mean over frames"),
        ("sigma", np.exp(numbers.log_width), "width sigma_g under the declared model, mean over frames"),
    ):
        _put(out, name, canvas.dims, canvas.spread(_means(fits, values)), "pixel", text)
    peak = float(np.exp(numbers.log_peak.max()))
    _put(out, "peak", (), peak, "DN", "brightest light under the declared model")


def _add_maps(out: xr.Dataset, canvas: Canvas, fits: Fits, stages: dict[str, Summed], side: int) -> None:
    """Readings, and what models leave of them, as maps and by distance from the centre."""
    first = stages[BEFORE]
    for axis, along, count in (("block_y", "rows", first.rest.shape[1]), ("block_x", "columns", first.rest.shape[2])):
        values = side * np.arange(count) + (side - 1) / 2
        out.coords[axis] = (axis, values, {"units": "pixel", "long_name": f"middle of a block of pixels along {along}"})
    dims = (*canvas.dims, "block_y", "block_x")
    with np.errstate(invalid="ignore"):
        reading = first.reading / first.pixels
    _put(out, "reading", dims, canvas.spread(_means(fits, reading)), "DN", "mean over the frames that were searched")
    edges = side * np.arange(max(min(first.rest.shape[1:]) // 2, 1) + 1)
    middle = (edges[:-1] + edges[1:]) / 2
    out.coords["radius"] = ("radius", middle, {"units": "pixel", "long_name": "distance from the spot's centre"})
    distance = np.hypot(*_offsets(fits, side, first.rest.shape[1:]))
    for stage, own in stages.items():
        text = "declared model" if stage == BEFORE else "extended model"
        with np.errstate(invalid="ignore"):
            rest = own.rest / own.pixels
        text = f"measured less {text}, mean over the frames that were searched"
        _put(out, f"residual_{stage}", dims, canvas.spread(_means(fits, rest)), "DN", text)
        value, error = _profile(fits, own, distance, edges)
        rings = (*canvas.dims, "radius")
        _put(out, f"profile_{stage}", rings, canvas.spread(value), "DN", f"{text} and over a ring")
        _put(out, f"profile_{stage}_stderr", rings, canvas.spread(error), "DN", f"standard error of profile_{stage}")


def _offsets(fits: Fits, side: int, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Where the middles of blocks lie from each frame's centre [frame, block row, block column] in px."""
    numbers = fits.before.numbers
    left, top = np.array([(f.view.x.min(), f.view.y.min()) for f in fits.frames]).T
    y, x = (side * np.arange(n) + (side - 1) / 2 for n in shape)
    dx = x[None, None, :] - (numbers.x - left)[:, None, None]
    dy = y[None, :, None] - (numbers.y - top)[:, None, None]
    return np.broadcast_arrays(dx, dy)  # type: ignore[return-value]


def _profile(fits: Fits, own: Summed, distance: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean residual [condition, ring] and its standard error [DN]."""
    ring = np.digitize(distance, edges) - 1
    condition, rings = fits.design.condition, len(edges) - 1
    inside = ring < rings
    at = (np.unique(condition, return_inverse=True)[1][:, None, None] * rings + ring)[inside]
    count = int(len(np.unique(condition)) * rings)
    rest, variance, pixels = (
        np.bincount(at, v[inside], minlength=count).reshape(-1, rings) for v in (own.rest, own.variance, own.pixels)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return rest / pixels, np.sqrt(variance) / pixels


def _add_gap(out: xr.Dataset, canvas: Canvas, fits: Fits, stages: dict[str, Summed]) -> None:
    """Mean square of what is left of block means over the declared model's noise, by condition."""
    variance = stages[BEFORE].variance
    known = variance > 0
    number = np.maximum(_means(fits, known.sum(axis=(1, 2)).astype(float)), 1.0)
    frames = np.unique(fits.design.condition, return_counts=True)[1]
    for stage, own in stages.items():
        square = np.where(known, own.rest**2 / np.where(known, variance, 1.0), 0.0).sum(axis=(1, 2))
        values = canvas.spread(_means(fits, square) / number)
        text = f"mean square of block residuals over the declared model's noise, {stage}"
        _put(out, f"gap_{stage}", canvas.dims, values, "1", text)
    last = stages.get(AFTER, stages[BEFORE]).variance
    floor = float(np.mean(last[known] / variance[known]))
    _put(out, "gap_floor", (), floor, "1", "the same where only noise is left")
    scatter = floor * np.sqrt(2 / (number * frames))
    _put(out, "gap_stderr", canvas.dims, canvas.spread(scatter), "1", "by how much noise alone makes it scatter")
    out.attrs["gap_on"] = "frames that were searched"


def _add_rings(out: xr.Dataset, canvas: Canvas, fits: Fits, own: Summed, side: int) -> None:
    """z of the mean residual of each ring, and of its strongest azimuthal order."""
    dx, dy = _offsets(fits, side, own.rest.shape[1:])
    radius = np.hypot(dx, dy) / np.exp(fits.before.numbers.log_width)[:, None, None]
    ring, turn = np.digitize(radius, RINGS) - 1, np.arctan2(dy, dx)
    order = np.arange(len(RINGS))
    names = {"units": "1", "long_name": "ring around the spot's centre"}
    out.coords["ring"] = ("ring", order, names)
    _put(out, "ring_low", ("ring",), np.array(RINGS), "1", "inner radius in widths sigma_g")
    _put(out, "ring_high", ("ring",), [*RINGS[1:], np.nan], "1", "outer radius in widths sigma_g; missing: open")
    condition, count = np.unique(fits.design.condition, return_inverse=True)[1], len(canvas.places)
    at = (condition[:, None, None] * len(RINGS) + ring).ravel()

    def total(weight: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.bincount(at, (weight * values).ravel(), count * len(RINGS)).reshape(count, len(RINGS))

    with np.errstate(invalid="ignore", divide="ignore"):
        radial = total(np.ones_like(turn), own.rest) / np.sqrt(total(np.ones_like(turn), own.variance))
        each = []
        for m in range(1, ORDERS + 1):
            waves = np.cos(m * turn), np.sin(m * turn)
            each.append(sum(total(w, own.rest) ** 2 / total(w * w, own.variance) for w in waves))
    # χ² of 2 as the z of as small a probability, of the largest of so many orders.
    power = np.array(each)
    log_p = np.log(ORDERS) - np.nanmax(np.where(np.isfinite(power), power, 0.0), axis=0) / 2
    azimuthal = np.where(np.isfinite(radial), stats.norm.isf(np.exp(np.minimum(log_p, -1e-3)) / 2), np.nan)
    azimuthal = np.where(log_p < -500, np.sqrt(np.maximum(-2 * log_p, 0.0)), azimuthal)
    strongest = 1 + np.argmax(np.where(np.isfinite(power), power, 0.0), axis=0)
    dims = (*canvas.dims, "ring")
    _put(out, "z_radial", dims, canvas.spread(radial), "1", "z of the mean residual of a ring")
    _put(out, "z_azimuthal", dims, canvas.spread(azimuthal), "1", "z of the strongest azimuthal order of a ring")
    _put(out, "z_order", dims, canvas.spread(strongest.astype(float)), "1", "that order")
    cells = 2 * int(np.isfinite(radial).sum())
    threshold = float(stats.norm.isf(float(out.attrs["alpha"]) / (2 * max(cells, 1))))
    _put(out, "z_threshold", (), threshold, "1", "|z| that noise reaches anywhere at the rate of false alarms")


def _add_parts(out: xr.Dataset, found: Detection) -> None:
    """The tests of detection, each as the z of as small a probability."""
    names = [f"{part.name}: {part.where}" if part.where else part.name for part in found.parts]
    out.coords["part"] = ("part", np.array(names, dtype=str), {"units": "1", "long_name": "test of detection"})
    _put(out, "part_z", ("part",), [part.z for part in found.parts], "1", "how odd its places are together")
