"""Content of discrepancy.nc, which the figures of a verdict show over the grid of conditions.

A condition is a combination of values of all dimensions of the grid of frames, except repeats. Readings and residuals
are summed over square blocks of pixels. Maps, radial profiles, rings about the spot and gaps follow from these sums.
The gap is the mean over blocks of (Σ residual)² over the variance that noise gives this sum; noise alone gives 1.
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
from spotcheck.discrepancy.residuals import measure_residuals, sum_over_blocks
from spotcheck.io import store

BEFORE, AFTER = "before", "after"
MODEL_NAMES = {BEFORE: "declared model", AFTER: "extended model"}
# Number of blocks along the shorter side of a crop; blocks of less than a pixel are of one.
BLOCKS = 40
# Inner radii of the rings about the spot, in widths σ_g of the spot; the last ring has no outer radius.
RINGS = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
# Azimuthal orders that are tested in a ring: waves cos(order · direction) and sin(order · direction), from 1 on.
ORDERS = 6
# ln p below which z is taken from the asymptote p ~ exp(−z²/2): exp(ln p) would underflow soon.
LEAST_LOG_P = -500.0
# ln p above which z is taken at this value: the bound on p may exceed 1, where z is not defined.
LARGEST_LOG_P = -1e-3


@dataclass(frozen=True)
class BlockSums:
    """Sums over the pixels of each block that are not masked; arrays [frame, block row, block column]."""

    reading: np.ndarray  # sum of the readings [DN]
    residual: np.ndarray  # sum of the residuals, reading less mean of the model [DN]
    variance: np.ndarray  # variance of `residual` by noise [DN²]
    pixels: np.ndarray  # number of pixels that are not masked


@dataclass(frozen=True)
class ConditionGrid:
    """Grid of the conditions of a dataset: its grid of frames without the dimension of repeats."""

    dims: tuple[str, ...]  # names of the dimensions
    shape: tuple[int, ...]  # their lengths
    places: tuple[tuple[int, ...], ...]  # index on the grid of each condition that has frames
    condition: np.ndarray  # position in `places` of the condition of each frame [frame]

    @classmethod
    def of_frames(cls, dataset: Dataset, cells: Sequence[tuple[int, ...]]) -> "ConditionGrid":
        """Return the grid for frames at `cells`, their indices on the dataset's grid with repeats."""
        condition_axes = [k for k, axis in enumerate(dataset.axes) if axis.name != "repeat"]
        places = [tuple(cell[k] for k in condition_axes) for cell in cells]
        number_of = {place: number for number, place in enumerate(sorted(set(places)))}
        axes = [dataset.axes[k] for k in condition_axes]
        return cls(
            tuple(axis.name for axis in axes),
            tuple(axis.size for axis in axes),
            tuple(number_of),
            np.array([number_of[place] for place in places], int),
        )

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Return values [condition, …] on the grid [*shape, …]; NaN for conditions without frames."""
        on_grid = np.full((*self.shape, *values.shape[1:]), np.nan)
        for place, value in zip(self.places, values, strict=True):
            on_grid[place] = value
        return on_grid

    def average(self, values: np.ndarray) -> np.ndarray:
        """Return means [condition, …] over frames of values [frame, …]; NaN if no frame has a value."""
        known = np.isfinite(values)
        groups = [self.condition == number for number in range(len(self.places))]
        with np.errstate(invalid="ignore"):
            return np.array([np.where(known[group], values[group], 0.0).sum(0) / known[group].sum(0)
                             for group in groups])  # fmt: skip


@dataclass(frozen=True)
class Geometry:
    """Positions of the blocks and of the spots of the frames."""

    side: int  # side of a block [px]
    dx: np.ndarray  # column of a block's middle less that of the spot [frame, block row, block column, px]
    dy: np.ndarray  # row of a block's middle less that of the spot [frame, block row, block column, px]
    left: np.ndarray  # column of the spot in its crop [frame, px]
    top: np.ndarray  # row of the spot in its crop [frame, px]
    sigma: np.ndarray  # width σ_g of the spot [frame, px]
    peak_dn: float  # brightest peak of all frames [DN]


def skipped_pictures(dataset: Dataset, status: str, alpha: float, reason: str) -> xr.Dataset:
    """Return the content of a file without pictures.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    status : str
        Status of the verdict.
    alpha : float
        Rate of false alarms of detection.
    reason : str
        Why nothing was assessed.
    """
    return _empty_content(dataset, status, alpha).assign_attrs(skipped=reason)


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
    """Return the content of discrepancy.nc, from which the figures of a verdict are drawn.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    cells : sequence of tuple of int
        Index of each frame on the grid of the dataset.
    frames : FrameSet
        Frames that were searched for effects: those that are not held out.
    models : mapping of str to JointModel
        Models of these frames: the declared one as `BEFORE`; if anything was added, the extended one as `AFTER`.
    detection : Detection or None
        Tests of the residuals of the declared model; None if there are none.
    status : str
        Status of the verdict.
    alpha : float
        Rate of false alarms of detection.
    """
    content, grid = _empty_content(dataset, status, alpha), ConditionGrid.of_frames(dataset, cells)
    side = max(min(frames.readings.shape[1:]) // BLOCKS, 1)
    sums = {stage: sum_blocks(frames, model, side) for stage, model in models.items()}
    geometry = _locate_blocks(frames, models[BEFORE], side, sums[BEFORE].residual.shape)
    _add_spots(content, grid, geometry)
    _add_maps(content, grid, geometry, sums)
    _add_profiles(content, grid, geometry, sums)
    _add_gap(content, grid, sums)
    _add_rings(content, grid, geometry, sums[BEFORE])
    if detection is not None:
        names = [f"{test.name}: {test.where}" if test.where else test.name for test in detection.tests]
        _put(content, "part", ("part",), np.array(names, dtype=str), "1", "test of detection")
        z = [test.z for test in detection.tests]
        _put(content, "part_z", ("part",), z, "1", "how odd its places are together")
    return content


def _empty_content(dataset: Dataset, status: str, alpha: float) -> xr.Dataset:
    """Return the grid of conditions of a dataset without variables, with status and rate of false alarms."""
    grid = store.make_grid(dataset).drop_vars("repeat", errors="ignore")
    return grid.assign_attrs(status=status, alpha=alpha)


def sum_blocks(frames: FrameSet, model: JointModel, side: int) -> BlockSums:
    """Return sums over blocks of `side` × `side` pixels; rows and columns that fill no block are left out."""
    images = measure_residuals(model, frames)
    is_known = images.weight > 0
    # The score of granular light, which neighbouring pixels share, has a larger variance than independent readings.
    dispersion = 1.0 if frames.light_field is None else frames.light_field.dispersion
    variance = dispersion / np.where(is_known, images.weight, 1.0)
    arrays = (frames.readings, images.residual, variance, np.ones_like(variance))
    return BlockSums(*(sum_over_blocks(np.where(is_known, values, 0.0), side) for values in arrays))


def _locate_blocks(frames: FrameSet, model: JointModel, side: int, shape: tuple[int, ...]) -> Geometry:
    """Return the positions of blocks of `side` px; `shape` is their number (frames, block rows, block columns)."""
    spots = model.spots
    left, top = spots.x - frames.left, spots.y - frames.top
    y, x = (_block_middles(side, count) for count in shape[1:])
    dx, dy = np.broadcast_arrays(x[None, None, :] - left[:, None, None], y[None, :, None] - top[:, None, None])
    return Geometry(side, dx, dy, left, top, np.exp(spots.log_sigma), float(np.exp(spots.log_peak.max())))


def _block_middles(side: int, count: int) -> np.ndarray:
    """Return row or column of the middle of each of `count` blocks in the crop [px]."""
    return side * np.arange(count) + (side - 1) / 2


def _put(content: xr.Dataset, name: str, dims: tuple[str, ...], values: Any, units: str, long_name: str) -> None:
    """Add a variable with its attributes, or a coordinate if it has the name of its dimension.

    Floating-point arrays of 3 or more dimensions are stored in single precision.
    """
    values = np.asarray(values)
    is_image = values.dtype.kind == "f" and values.ndim > 2
    content[name] = (dims, values.astype("f4") if is_image else values, {"units": units, "long_name": long_name})


def _add_spots(content: xr.Dataset, grid: ConditionGrid, geometry: Geometry) -> None:
    """Add centre and width of the spots by condition, and the brightest peak."""
    for name, values, text in (
        ("spot_x", geometry.left, "column of the spot's centre in the crop, mean over frames"),
        ("spot_y", geometry.top, "row of the spot's centre in the crop, mean over frames"),
        ("sigma", geometry.sigma, "width sigma_g under the declared model, mean over frames"),
    ):
        _put(content, name, grid.dims, grid.spread(grid.average(values)), "pixel", text)
    _put(content, "peak", (), geometry.peak_dn, "DN", "brightest light under the declared model")


def _residual_text(stage: str) -> str:
    """Return the text for residuals under the model of a stage, `BEFORE` or `AFTER`."""
    return f"measured less {MODEL_NAMES[stage]}, mean over the frames that were searched"


def _add_maps(content: xr.Dataset, grid: ConditionGrid, geometry: Geometry, sums: Mapping[str, BlockSums]) -> None:
    """Add mean readings and residuals of blocks by condition, and the blocks' positions as coordinates."""
    first = sums[BEFORE]
    for axis, along, count in (
        ("block_y", "rows", first.residual.shape[1]),
        ("block_x", "columns", first.residual.shape[2]),
    ):
        middles, text = _block_middles(geometry.side, count), f"middle of a block of pixels along {along}"
        _put(content, axis, (axis,), middles, "pixel", text)
    dims = (*grid.dims, "block_y", "block_x")
    images = {"reading": (first.reading / _count_pixels(first), "mean over the frames that were searched")}
    for stage, blocks in sums.items():
        images[f"residual_{stage}"] = blocks.residual / _count_pixels(blocks), _residual_text(stage)
    for name, (values, text) in images.items():
        _put(content, name, dims, grid.spread(grid.average(values)), "DN", text)


def _count_pixels(blocks: BlockSums) -> np.ndarray:
    """Return the number of pixels of each block [frame, block row, block column], NaN for none."""
    return np.where(blocks.pixels > 0, blocks.pixels, np.nan)


def _add_profiles(content: xr.Dataset, grid: ConditionGrid, geometry: Geometry, sums: Mapping[str, BlockSums]) -> None:
    """Add mean residuals and their standard errors by condition and distance from the spot.

    The distance is divided into rings as wide as a block, from the spot's centre to half the shorter side of the crop.
    """
    shape = sums[BEFORE].residual.shape
    edges = geometry.side * np.arange(max(min(shape[1:]) // 2, 1) + 1)
    _put(content, "radius", ("radius",), (edges[:-1] + edges[1:]) / 2, "pixel", "distance from the spot's centre")
    rings = len(edges) - 1
    ring_of_block = np.digitize(np.hypot(geometry.dx, geometry.dy), edges) - 1
    is_inside = ring_of_block < rings
    # Number of the pair of condition and ring to which each block belongs.
    label = (grid.condition[:, None, None] * rings + ring_of_block)[is_inside]
    dims = (*grid.dims, "radius")
    for stage, blocks in sums.items():
        residual, variance, pixels = (
            np.bincount(label, values[is_inside], len(grid.places) * rings).reshape(-1, rings)
            for values in (blocks.residual, blocks.variance, blocks.pixels)
        )
        count = np.where(pixels > 0, pixels, np.nan)
        name, text = f"profile_{stage}", f"{_residual_text(stage)} and over a ring"
        _put(content, name, dims, grid.spread(residual / count), "DN", text)
        _put(content, f"{name}_stderr", dims, grid.spread(np.sqrt(variance) / count), "DN", f"standard error of {name}")


def _add_gap(content: xr.Dataset, grid: ConditionGrid, sums: Mapping[str, BlockSums]) -> None:
    """Add the gap of each condition under each model, its expectation by noise alone, and its standard deviation.

    Squares of both models are divided by the declared model's variance, so that a larger noise cannot close the gap.
    """
    variance = sums[BEFORE].variance
    known = variance > 0
    noise = np.where(known, variance, 1.0)
    mean_blocks = np.maximum(grid.average(known.sum(axis=(1, 2)).astype(float)), 1.0)
    for stage, blocks in sums.items():
        squares = np.where(known, blocks.residual**2 / noise, 0.0).sum(axis=(1, 2))
        text = f"mean square of block residuals over the declared model's noise, {stage}"
        _put(content, f"gap_{stage}", grid.dims, grid.spread(grid.average(squares) / mean_blocks), "1", text)
    # Noise alone leaves the last model's variance over the declared one's.
    last_variance = sums.get(AFTER, sums[BEFORE]).variance
    floor = float(np.mean(last_variance[known] / variance[known])) if known.any() else 1.0
    _put(content, "gap_floor", (), floor, "1", "the same where only noise is left")
    frames = np.bincount(grid.condition, minlength=len(grid.places))
    # The square of a normal number has the variance 2 times its squared mean.
    gap_sd = floor * np.sqrt(2 / (mean_blocks * frames))
    _put(content, "gap_stderr", grid.dims, grid.spread(gap_sd), "1", "by how much noise alone makes it scatter")
    content.attrs["gap_on"] = "frames that were searched"


def _add_rings(content: xr.Dataset, grid: ConditionGrid, geometry: Geometry, blocks: BlockSums) -> None:
    """Add z of each ring and condition: of its mean residual, and of its strongest azimuthal order."""
    radius = np.hypot(geometry.dx, geometry.dy) / geometry.sigma[:, None, None]
    direction = np.arctan2(geometry.dy, geometry.dx)
    rings, conditions = len(RINGS), len(grid.places)
    # Number of the pair of condition and ring to which each block belongs.
    label = (grid.condition[:, None, None] * rings + np.digitize(radius, RINGS) - 1).ravel()

    def sum_rings(values: np.ndarray) -> np.ndarray:
        """Return the sums [condition, ring] of values of blocks."""
        return np.bincount(label, values.ravel(), conditions * rings).reshape(conditions, rings)

    def order_power(order: int) -> np.ndarray:
        """Return χ² of 2 degrees of freedom [condition, ring] of an azimuthal order."""
        waves = (np.cos(order * direction), np.sin(order * direction))
        return sum(sum_rings(w * blocks.residual) ** 2 / sum_rings(w**2 * blocks.variance) for w in waves)

    with np.errstate(invalid="ignore", divide="ignore"):
        radial = sum_rings(blocks.residual) / np.sqrt(sum_rings(blocks.variance))
        power = np.array([order_power(order) for order in range(1, ORDERS + 1)])
    power = np.where(np.isfinite(power), power, 0.0)
    azimuthal = np.where(np.isfinite(radial), z_of_strongest(power), np.nan)
    _put(content, "ring", ("ring",), np.arange(rings), "1", "ring around the spot's centre")
    _put(content, "ring_low", ("ring",), np.array(RINGS), "1", "inner radius in widths sigma_g")
    _put(content, "ring_high", ("ring",), [*RINGS[1:], np.nan], "1", "outer radius in widths sigma_g; missing: open")
    dims = (*grid.dims, "ring")
    _put(content, "z_radial", dims, grid.spread(radial), "1", "z of the mean residual of a ring")
    _put(content, "z_azimuthal", dims, grid.spread(azimuthal), "1", "z of the strongest azimuthal order of a ring")
    _put(content, "z_order", dims, grid.spread(1.0 + power.argmax(axis=0)), "1", "that order")
    # Bonferroni over the two tests of each ring that has pixels, both of them two-sided.
    tests = 2 * int(np.isfinite(radial).sum())
    threshold = float(stats.norm.isf(float(content.attrs["alpha"]) / (2 * max(tests, 1))))
    _put(content, "z_threshold", (), threshold, "1", "|z| that noise reaches anywhere at the rate of false alarms")


def z_of_strongest(power: np.ndarray) -> np.ndarray:
    """Return the normal deviate z [1] with the same two-sided p-value as the largest of several χ².

    Parameters
    ----------
    power : array [order, …]
        χ² of 2 degrees of freedom, of which the largest along the first axis counts.

    Returns
    -------
    array […]
        z ≥ 0. The p-value is Bonferroni's bound: the number of orders times exp(−χ²/2).
    """
    log_p = np.log(len(power)) - power.max(axis=0) / 2
    z = stats.norm.isf(np.exp(np.clip(log_p, LEAST_LOG_P, LARGEST_LOG_P)) / 2)
    return np.where(log_p < LEAST_LOG_P, np.sqrt(np.maximum(-2 * log_p, 0.0)), z)
