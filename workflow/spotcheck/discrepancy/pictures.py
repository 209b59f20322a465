"""discrepancy.nc: what the figures of a verdict show, over the grid of conditions.

Blocks of pixels hold sums of residuals and of their variance, from which maps, radial profiles, rings and the gap of
each condition follow.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from scipy import stats

from spotcheck.dataset.folder import Dataset
from spotcheck.discrepancy.findings import Detection
from spotcheck.discrepancy.frames import FrameSet
from spotcheck.discrepancy.joint_fit import JointModel
from spotcheck.discrepancy.residuals import measure_residuals
from spotcheck.io import store

BEFORE, AFTER = "before", "after"
MODEL_NAMES = {BEFORE: "declared model", AFTER: "extended model"}
# Blocks along the shorter side of a crop.
BLOCKS = 40
# Inner radii of rings around the spot [σ_g], the last one open.
RINGS = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
# Azimuthal orders of a ring, from 1 on.
ORDERS = 6
# ln p below which the normal distribution's inverse is taken from its asymptote.
LEAST_LOG_P = -500.0


@dataclass(frozen=True)
class BlockSums:
    """Sums over the pixels of each block that are not masked; arrays [frame, block row, block column]."""

    reading: np.ndarray  # readings [DN]
    residual: np.ndarray  # reading less mean of the model [DN]
    variance: np.ndarray  # variance of the residual [DN²]
    pixels: np.ndarray  # number of pixels


@dataclass(frozen=True)
class ConditionGrid:
    """The grid of conditions: that of the dataset without repeats."""

    dims: tuple[str, ...]  # names of the dimensions
    shape: tuple[int, ...]  # their lengths
    places: tuple[tuple[int, ...], ...]  # place of each of C conditions that have frames
    condition: np.ndarray  # number of the condition [frame]

    @classmethod
    def of_frames(cls, dataset: Dataset, cells: Sequence[tuple[int, ...]]) -> "ConditionGrid":
        """Return the grid of frames at some cells of the grid of a dataset."""
        keys = [k for k, axis in enumerate(dataset.axes) if axis.name != "repeat"]
        places = [tuple(cell[k] for k in keys) for cell in cells]
        number = {place: k for k, place in enumerate(sorted(set(places)))}
        axes = [dataset.axes[k] for k in keys]
        return cls(
            tuple(axis.name for axis in axes),
            tuple(axis.size for axis in axes),
            tuple(number),
            np.array([number[place] for place in places], int),
        )

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Return values [condition, …] on the grid, NaN where there is no condition."""
        out = np.full((*self.shape, *values.shape[1:]), np.nan)
        for place, value in zip(self.places, values, strict=True):
            out[place] = value
        return out

    def means(self, values: np.ndarray) -> np.ndarray:
        """Return the means [condition, …] of values [frame, …], NaN where no frame has one."""
        known = np.isfinite(values)
        groups = [self.condition == number for number in range(len(self.places))]
        with np.errstate(invalid="ignore"):
            return np.array([np.where(known[at], values[at], 0.0).sum(0) / known[at].sum(0) for at in groups])


@dataclass(frozen=True)
class Geometry:
    """Where blocks lie."""

    side: int  # side of a block [px]
    dx: np.ndarray  # column of the middle of each block less that of the spot [frame, block row, block column, px]
    dy: np.ndarray  # the same of rows
    left: np.ndarray  # column of the spot in its crop [frame, px]
    top: np.ndarray  # row of the spot in its crop [frame, px]
    sigma: np.ndarray  # width σ_g of the spot [frame, px]
    peak_dn: float  # brightest peak of all frames [DN]


def skipped_pictures(dataset: Dataset, status: str, alpha: float, reason: str) -> xr.Dataset:
    """Return the content of a file without pictures; `reason` says why nothing was assessed."""
    return _empty(dataset, status, alpha).assign_attrs(skipped=reason)


def draw_pictures(
    dataset: Dataset,
    cells: Sequence[tuple[int, ...]],
    frames: FrameSet,
    models: Mapping[str, JointModel],
    detection: Detection | None,
    *,
    status: str,
    alpha: float,
) -> xr.Dataset:
    """Return the content of discrepancy.nc.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    cells : sequence of index
        Place of each frame on the grid of the dataset.
    frames : FrameSet
        Frames that were searched.
    models : mapping of str to JointModel
        Models of these frames: the declared one as `BEFORE`; if anything was added, the extended one as `AFTER`.
    detection : Detection or None
        Tests of the declared model.
    status : str
        Status of the verdict.
    alpha : float
        Rate of false alarms.
    """
    out, grid = _empty(dataset, status, alpha), ConditionGrid.of_frames(dataset, cells)
    side = max(min(frames.readings.shape[1:]) // BLOCKS, 1)
    sums = {stage: sum_blocks(frames, model, side) for stage, model in models.items()}
    geometry = _geometry(frames, models[BEFORE], side, sums[BEFORE].residual.shape)
    _add_spots(out, grid, geometry)
    _add_maps(out, grid, geometry, sums)
    _add_profiles(out, grid, geometry, sums)
    _add_gap(out, grid, sums)
    _add_rings(out, grid, geometry, sums[BEFORE])
    if detection is not None:
        names = [f"{test.name}: {test.where}" if test.where else test.name for test in detection.tests]
        out.coords["part"] = ("part", np.array(names, dtype=str), {"units": "1", "long_name": "test of detection"})
        _put(out, "part_z", ("part",), [test.z for test in detection.tests], "1", "how odd its places are together")
    return out


def _empty(dataset: Dataset, status: str, alpha: float) -> xr.Dataset:
    out = store.make_grid(dataset).drop_vars("repeat", errors="ignore")
    return out.assign_attrs(status=status, alpha=alpha)


def sum_blocks(frames: FrameSet, model: JointModel, side: int) -> BlockSums:
    """Return sums over blocks of `side` × `side` pixels; pixels left over at the far edges take no part."""
    images = measure_residuals(model, frames)
    is_known = images.weight > 0
    _, height, width = is_known.shape
    rows, columns = height // side, width // side

    def blocks(values: np.ndarray) -> np.ndarray:
        cut = np.where(is_known, values, 0.0)[:, : rows * side, : columns * side]
        return cut.reshape(-1, rows, side, columns, side).sum(axis=(2, 4), dtype=float)

    # Sums scatter by more if granular light makes neighbouring pixels alike.
    dispersion = 1.0 if frames.light_field is None else frames.light_field.dispersion
    variance = dispersion / np.where(is_known, images.weight, 1.0)
    return BlockSums(blocks(frames.readings), blocks(images.residual), blocks(variance), blocks(np.ones_like(variance)))


def _geometry(frames: FrameSet, model: JointModel, side: int, shape: tuple[int, ...]) -> Geometry:
    """Return where blocks [frame, block row, block column] of that shape lie."""
    spots = model.spots
    left, top = spots.x - frames.left, spots.y - frames.top
    y, x = (side * np.arange(count) + (side - 1) / 2 for count in shape[1:])
    dx, dy = np.broadcast_arrays(x[None, None, :] - left[:, None, None], y[None, :, None] - top[:, None, None])
    return Geometry(side, dx, dy, left, top, np.exp(spots.log_sigma), float(np.exp(spots.log_peak.max())))


def _put(out: xr.Dataset, name: str, dims: tuple[str, ...], values: Any, units: str, long_name: str) -> None:
    """Add a variable; images are kept in single precision."""
    values = np.asarray(values)
    is_image = values.dtype.kind == "f" and values.ndim > 2
    out[name] = (dims, values.astype("f4") if is_image else values, {"units": units, "long_name": long_name})


def _add_spots(out: xr.Dataset, grid: ConditionGrid, geometry: Geometry) -> None:
    """Add place and width of the spots, and the brightest peak."""
    for name, values, text in (
        ("spot_x", geometry.left, "column of the spot's centre in the crop, mean over frames"),
        ("spot_y", geometry.top, "row of the spot's centre in the crop, mean over frames"),
        ("sigma", geometry.sigma, "width sigma_g under the declared model, mean over frames"),
    ):
        _put(out, name, grid.dims, grid.spread(grid.means(values)), "pixel", text)
    _put(out, "peak", (), geometry.peak_dn, "DN", "brightest light under the declared model")


def _residual_text(stage: str) -> str:
    return f"measured less {MODEL_NAMES[stage]}, mean over the frames that were searched"


def _add_maps(out: xr.Dataset, grid: ConditionGrid, geometry: Geometry, sums: Mapping[str, BlockSums]) -> None:
    """Add means of readings and residuals over the pixels of blocks and the frames of conditions."""
    side, first = geometry.side, sums[BEFORE]
    for axis, along, count in (
        ("block_y", "rows", first.residual.shape[1]),
        ("block_x", "columns", first.residual.shape[2]),
    ):
        values = side * np.arange(count) + (side - 1) / 2
        out.coords[axis] = (axis, values, {"units": "pixel", "long_name": f"middle of a block of pixels along {along}"})
    dims = (*grid.dims, "block_y", "block_x")
    images = {"reading": (first.reading / _count(first), "mean over the frames that were searched")}
    for stage, blocks in sums.items():
        images[f"residual_{stage}"] = blocks.residual / _count(blocks), _residual_text(stage)
    for name, (values, text) in images.items():
        _put(out, name, dims, grid.spread(grid.means(values)), "DN", text)


def _count(blocks: BlockSums) -> np.ndarray:
    """Return the number of pixels of each block, NaN for none."""
    return np.where(blocks.pixels > 0, blocks.pixels, np.nan)


def _add_profiles(out: xr.Dataset, grid: ConditionGrid, geometry: Geometry, sums: Mapping[str, BlockSums]) -> None:
    """Add mean residuals by distance from the spot, in rings as wide as a block."""
    shape = sums[BEFORE].residual.shape
    edges = geometry.side * np.arange(max(min(shape[1:]) // 2, 1) + 1)
    attributes = {"units": "pixel", "long_name": "distance from the spot's centre"}
    out.coords["radius"] = ("radius", (edges[:-1] + edges[1:]) / 2, attributes)
    rings = len(edges) - 1
    ring = np.digitize(np.hypot(geometry.dx, geometry.dy), edges) - 1
    is_inside = ring < rings
    cell = (grid.condition[:, None, None] * rings + ring)[is_inside]
    dims = (*grid.dims, "radius")
    for stage, blocks in sums.items():
        residual, variance, pixels = (
            np.bincount(cell, values[is_inside], len(grid.places) * rings).reshape(-1, rings)
            for values in (blocks.residual, blocks.variance, blocks.pixels)
        )
        count = np.where(pixels > 0, pixels, np.nan)
        name, text = f"profile_{stage}", f"{_residual_text(stage)} and over a ring"
        _put(out, name, dims, grid.spread(residual / count), "DN", text)
        _put(out, f"{name}_stderr", dims, grid.spread(np.sqrt(variance) / count), "DN", f"standard error of {name}")


def _add_gap(out: xr.Dataset, grid: ConditionGrid, sums: Mapping[str, BlockSums]) -> None:
    """Add the mean square of the residuals of blocks over the declared model's noise, by condition."""
    variance = sums[BEFORE].variance
    known = variance > 0
    noise = np.where(known, variance, 1.0)
    blocks_known = np.maximum(grid.means(known.sum(axis=(1, 2)).astype(float)), 1.0)
    for stage, blocks in sums.items():
        squares = np.where(known, blocks.residual**2 / noise, 0.0).sum(axis=(1, 2))
        text = f"mean square of block residuals over the declared model's noise, {stage}"
        _put(out, f"gap_{stage}", grid.dims, grid.spread(grid.means(squares) / blocks_known), "1", text)
    last = sums.get(AFTER, sums[BEFORE]).variance
    floor = float(np.mean(last[known] / variance[known])) if known.any() else 1.0
    _put(out, "gap_floor", (), floor, "1", "the same where only noise is left")
    frames = np.bincount(grid.condition, minlength=len(grid.places))
    scatter = floor * np.sqrt(2 / (blocks_known * frames))
    _put(out, "gap_stderr", grid.dims, grid.spread(scatter), "1", "by how much noise alone makes it scatter")
    out.attrs["gap_on"] = "frames that were searched"


def _add_rings(out: xr.Dataset, grid: ConditionGrid, geometry: Geometry, blocks: BlockSums) -> None:
    """Add z of the mean residual of each ring, and of its strongest azimuthal order."""
    radius = np.hypot(geometry.dx, geometry.dy) / geometry.sigma[:, None, None]
    direction = np.arctan2(geometry.dy, geometry.dx)
    rings, conditions = len(RINGS), len(grid.places)
    cell = (grid.condition[:, None, None] * rings + np.digitize(radius, RINGS) - 1).ravel()

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(cell, values.ravel(), conditions * rings).reshape(conditions, rings)

    with np.errstate(invalid="ignore", divide="ignore"):
        radial = total(blocks.residual) / np.sqrt(total(blocks.variance))
        power = np.array(
            [
                sum(
                    total(wave * blocks.residual) ** 2 / total(wave**2 * blocks.variance)
                    for wave in (np.cos(order * direction), np.sin(order * direction))
                )
                for order in range(1, ORDERS + 1)
            ]
        )
    power = np.where(np.isfinite(power), power, 0.0)
    azimuthal = np.where(np.isfinite(radial), z_of_strongest(power), np.nan)
    out.coords["ring"] = ("ring", np.arange(rings), {"units": "1", "long_name": "ring around the spot's centre"})
    _put(out, "ring_low", ("ring",), np.array(RINGS), "1", "inner radius in widths sigma_g")
    _put(out, "ring_high", ("ring",), [*RINGS[1:], np.nan], "1", "outer radius in widths sigma_g; missing: open")
    dims = (*grid.dims, "ring")
    _put(out, "z_radial", dims, grid.spread(radial), "1", "z of the mean residual of a ring")
    _put(out, "z_azimuthal", dims, grid.spread(azimuthal), "1", "z of the strongest azimuthal order of a ring")
    _put(out, "z_order", dims, grid.spread(1.0 + power.argmax(axis=0)), "1", "that order")
    tests = 2 * int(np.isfinite(radial).sum())
    threshold = float(stats.norm.isf(float(out.attrs["alpha"]) / (2 * max(tests, 1))))
    _put(out, "z_threshold", (), threshold, "1", "|z| that noise reaches anywhere at the rate of false alarms")


def z_of_strongest(power: np.ndarray) -> np.ndarray:
    """Return the z of as small a probability as the largest of several χ² of 2 degrees of freedom [order, …].

    The probability is Bonferroni's bound: the number of orders times exp(−χ²/2).
    """
    log_p = np.log(len(power)) - power.max(axis=0) / 2
    z = stats.norm.isf(np.exp(np.clip(log_p, LEAST_LOG_P, -1e-3)) / 2)
    return np.where(log_p < LEAST_LOG_P, np.sqrt(np.maximum(-2 * log_p, 0.0)), z)
