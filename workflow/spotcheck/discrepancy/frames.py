"""Spot frames with their conditions, held-out repeats, and the pixels that fits use.

A crop is a rectangular part of a sensor's frame around the spot. Coordinates x and y [px] are columns and rows of the
whole sensor. A site is a set of frames with the same angle, declared conditions and repeat; they see the same granular
light. The information on the light is the Fisher information of the readings on the light of each pixel. Pixels under
one grain share its noise, so that sums over pixels scatter more than those of independent readings: the dispersion is
the ratio of these variances, 1 without granular light.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr

from spotcheck.crops.cropping import is_usable
from spotcheck.dataset.conditions import held_out_repeats
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import Frame, parse_number
from spotcheck.io import store
from spotcheck.model.conditions import FrameConditions, PixelGrid

# Parameters of a spot, in the order in which arrays of unknowns hold them for each frame.
LOG_PEAK, LOG_SIGMA, CENTRE_X, CENTRE_Y = range(4)
SPOT_PARAMETERS = 4
# Pixels within INNER_REACH [σ] of a spot along each axis are all used. Beyond it every OUTER_STRIDE-th row and column
# is used.
INNER_REACH, OUTER_STRIDE = 3.2, 4
# Most pixels of a fit: larger sets of frames are strided further.
MOST_PIXELS = 2_200_000
# Pixels of the subset on which candidates are ranked, and least rows and columns of each frame in it.
THINNED_PIXELS, FEWEST_LINES = 100_000, 8
# Seed of that subset: the same at every call.
THINNED_SEED = 20210


# Index of a spot frame on the grid of the dataset, and its row of the manifest.
Cell = tuple[tuple[int, ...], Frame]


@dataclass(frozen=True)
class Design:
    """Conditions of F frames."""

    exposure_s: np.ndarray  # exposure [frame, s]; 1 where it was not recorded
    angle: np.ndarray  # angle of the fibres [frame, rad]; 0 where it was not recorded
    order: np.ndarray  # position in the order of acquisition, from 0 to 1 [frame]; 0.5 where it is unknown
    repeat: np.ndarray  # number of the repeat [frame]; 0 where it was not recorded
    site: np.ndarray  # number of the site, which is one angle, set of declared conditions and repeat [frame]
    condition: np.ndarray  # number of the condition, which is one exposure and set of declared conditions [frame]
    longest_s: float  # longest exposure of the dataset [s]
    reference_s: float  # geometric mean of the distinct exposures [s]
    has_exposures: bool  # whether exposures were recorded
    has_order: bool  # whether the order of acquisition is known
    # Estimates of what effects draw anew for each site, such as the phase of stripes, by name of the effect [frame].
    draws: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def sites(self) -> int:
        """Number of sites."""
        return len(np.unique(self.site))

    def select(self, frames: np.ndarray | slice) -> "Design":
        """Return the conditions of some frames, by index, mask or slice; those of the dataset stay."""
        names = ("exposure_s", "angle", "order", "repeat", "site", "condition")
        draws = {name: values[frames] for name, values in self.draws.items()}
        return replace(self, draws=draws, **{name: getattr(self, name)[frames] for name in names})


@dataclass(frozen=True)
class LightField:
    """Granular light (a field of grains, such as speckle), which adds scatter that neighbouring pixels share.

    Its variance is that at the light of a first fit and is kept. A variance that followed the mean would bias the mean,
    since the distribution of the field is skewed.
    """

    variance: np.ndarray  # variance that the field adds to readings, beyond that of the model [frame, row, column] DN²
    dispersion: float  # variance of the score of the light (derivative of ln L) over that of independent readings
    share: np.ndarray  # fraction of the variance of a reading that the field causes [frame, row, column]
    mean_share: float  # mean of `share`, weighted with the information on the light

    def select(self, frames: np.ndarray) -> "LightField":
        """Return the field of some frames, by index or mask."""
        return replace(self, variance=self.variance[frames], share=self.share[frames])


@dataclass(frozen=True)
class FrameSet:
    """Crops of F spot frames."""

    readings: np.ndarray  # [frame, row, column] DN; NaN where a pixel is masked
    left: np.ndarray  # column of the sensor under column 0 of each crop [frame]
    top: np.ndarray  # row of the sensor under row 0 [frame]
    design: Design  # conditions of the frames
    sensor_columns: int  # columns of the sensor's frame
    sensor_rows: int  # rows of the sensor's frame
    light_field: LightField | None = field(default=None, repr=False)  # granular light; None if the frames show none

    def __len__(self) -> int:
        return len(self.left)

    def select(self, frames: np.ndarray) -> "FrameSet":
        """Return some of the frames, by index or mask."""
        crops = {"readings": self.readings[frames], "left": self.left[frames], "top": self.top[frames]}
        light_field = None if self.light_field is None else self.light_field.select(frames)
        return replace(self, design=self.design.select(frames), light_field=light_field, **crops)

    def held_out(self) -> np.ndarray:
        """Return which frames [frame] are kept from search and fit, by `held_out_repeats`."""
        return held_out_repeats(self.design.repeat)


@dataclass(frozen=True)
class FrameParameters:
    """Peak, width and centre of the spot of each frame, which a joint fit estimates."""

    log_peak: np.ndarray  # ln of the peak in DN [frame]
    log_sigma: np.ndarray  # ln of the width σ_g in px [frame]
    x: np.ndarray  # column of the centre on the sensor [frame, px]
    y: np.ndarray  # row of the centre [frame, px]

    def select(self, frames: np.ndarray | slice) -> "FrameParameters":
        """Return the parameters of some frames, by index, mask or slice."""
        return FrameParameters(*(values[frames] for values in self.as_rows()))

    def as_rows(self) -> np.ndarray:
        """Return ln peak, ln σ_g, x and y as an array [spot parameter, frame]."""
        return np.stack([self.log_peak, self.log_sigma, self.x, self.y])


@dataclass(frozen=True)
class Pixels:
    """Readings at selected rows and columns of each frame: h rows and w columns, the same number in all frames."""

    x: np.ndarray  # columns on the sensor [frame, 1, w]
    y: np.ndarray  # rows on the sensor [frame, h, 1]
    readings: np.ndarray  # [frame, h, w] DN, 0 where a pixel is not used
    is_used: np.ndarray  # whether a pixel is used [frame, h, w]
    row_share: np.ndarray  # number of rows of the crop that each selected row represents [frame, h, 1]
    sensor_columns: int  # columns of the sensor's frame
    sensor_rows: int  # rows of the sensor's frame
    extra_variance: np.ndarray  # variance of readings beyond that of the model, [frame, h, w] or broadcasts to it, DN²
    field_share: np.ndarray  # fraction of the variance that granular light causes, [frame, h, w] or broadcasts to it
    mean_field_share: float = 0.0  # mean of `field_share`, weighted with the information on the light
    dispersion: float = 1.0  # variance of the score of the light (derivative of ln L) over that of independent readings
    share: float = 1.0  # fraction that these are of the pixels of the full fit; penalties and priors are scaled by it

    @property
    def count(self) -> int:
        """Number of used pixels."""
        return int(self.is_used.sum())

    def select(self, frames: slice | np.ndarray) -> "Pixels":
        """Return the pixels of some frames, by index, mask or slice."""
        names = ("x", "y", "readings", "is_used", "row_share", "extra_variance", "field_share")
        return replace(self, **{name: getattr(self, name)[frames] for name in names})

    def dispersion_of(self, field_share: float | np.ndarray) -> float | np.ndarray:
        """Return the dispersion of the score of a change of the readings, such as that by an effect.

        Granular light is the only noise that pixels share, so that the excess over 1 is proportional to its share of
        the variance. A change where there is no granular light has the dispersion 1.

        Parameters
        ----------
        field_share : float or array
            Share of granular light in the variance of the readings, the mean weighted with the information on the
            change.
        """
        if self.mean_field_share == 0:
            return self.dispersion
        return 1 + (self.dispersion - 1) * field_share / self.mean_field_share


def add_field(pixels: Pixels, frames: FrameSet) -> Pixels:
    """Return the pixels with the variance of the frames' light field added to `extra_variance`.

    The frames must have a light field; the pixels are some of theirs.
    """
    assert frames.light_field is not None
    frame = np.arange(len(frames))[:, None, None]
    row = (pixels.y - frames.top[:, None, None]).astype(int)
    column = (pixels.x - frames.left[:, None, None]).astype(int)
    return replace(pixels, extra_variance=pixels.extra_variance + frames.light_field.variance[frame, row, column])


def conditions_of(design: Design, spots: FrameParameters, pixels: Pixels) -> FrameConditions:
    """Return the conditions of all frames for the forward model, with values per frame as arrays [frame, 1, 1].

    These broadcast over the pixels, whose x is [frame, 1, w] and y [frame, h, 1].
    """

    def per_frame(values: np.ndarray) -> np.ndarray:
        """Return values [frame] as an array [frame, 1, 1]."""
        return np.asarray(values, float)[:, None, None]

    grid = PixelGrid(pixels.x, pixels.y, pixels.sensor_columns, pixels.sensor_rows, pixels.row_share)
    return FrameConditions(
        pixels=grid,
        x0=per_frame(spots.x),
        y0=per_frame(spots.y),
        exposure_s=per_frame(design.exposure_s),
        longest_s=design.longest_s,
        reference_s=design.reference_s,
        angle=per_frame(design.angle),
        order=per_frame(design.order),
        peak_dn=per_frame(np.exp(spots.log_peak)),
        sigma_px=per_frame(np.exp(spots.log_sigma)),
        draws={name: per_frame(values) for name, values in design.draws.items()},
    )


def select_pixels(frames: FrameSet, spots: FrameParameters) -> Pixels:
    """Return the pixels of a fit: all near each spot, every `OUTER_STRIDE`-th row and column beyond.

    If these were more than `MOST_PIXELS` in all frames, both strides are increased by the same factor.
    """
    shape = frames.readings.shape[1:]
    near_px = INNER_REACH * float(np.exp(np.max(spots.log_sigma)))
    inner = [min(2 * int(near_px) + 1, size) for size in shape]
    # Number of strided rows and columns, rounded up.
    outer = [-(-(size - near) // OUTER_STRIDE) for size, near in zip(shape, inner, strict=True)]
    count = len(frames) * (inner[0] + outer[0]) * (inner[1] + outer[1])
    stride = max(int(np.ceil(np.sqrt(count / MOST_PIXELS))), 1)
    # Offsets of rows and columns differ, so that together the frames show every pixel.
    y, x = spots.y - frames.top, spots.x - frames.left
    rows = [_axis_indices(y[f], shape[0], inner[0], stride, f // OUTER_STRIDE) for f in range(len(frames))]
    columns = [_axis_indices(x[f], shape[1], inner[1], stride, f) for f in range(len(frames))]
    return _take_pixels(frames, *_equal_lengths(rows), *_equal_lengths(columns))


def thin_pixels(pixels: Pixels, count: int = THINNED_PIXELS) -> Pixels:
    """Return a random subset of rows and columns of each frame with about `count` pixels, the same at every call.

    The rows are divided into groups of neighbours and one is drawn from each group; likewise the columns. Sums over
    a column of the sensor, weighted by `row_share`, are then much more precise than with rows drawn out of all.
    """
    frames, rows, columns = pixels.readings.shape
    linear_share = np.sqrt(min(count / (frames * rows * columns), 1.0))
    row_count, column_count = (max(round(linear_share * size), min(size, FEWEST_LINES)) for size in (rows, columns))
    rng = np.random.default_rng(THINNED_SEED)
    row, column = _draw_evenly(rng, frames, rows, row_count), _draw_evenly(rng, frames, columns, column_count)
    index = (np.arange(frames)[:, None, None], row[:, :, None], column[:, None, :])
    y = np.take_along_axis(pixels.y[:, :, 0], row, axis=1)
    x = np.take_along_axis(pixels.x[:, 0, :], column, axis=1)
    row_share = _row_share(y, pixels.y[:, :, 0], pixels.row_share[:, :, 0])
    arrays: dict[str, Any] = {
        "readings": pixels.readings[index],
        "is_used": pixels.is_used[index],
        "row_share": row_share[:, :, None],
        "extra_variance": np.broadcast_to(pixels.extra_variance, pixels.readings.shape)[index],
        "field_share": np.broadcast_to(pixels.field_share, pixels.readings.shape)[index],
    }
    thinned = replace(pixels, x=x[:, None, :], y=y[:, :, None], **arrays)
    used_share = thinned.count / max(pixels.count, 1)
    # Each pixel shares its grain with fewer others, in proportion to the pixels that are left.
    return replace(thinned, share=pixels.share * used_share, dispersion=1 + used_share * (pixels.dispersion - 1))


def _draw_evenly(rng: np.random.Generator, frames: int, size: int, count: int) -> np.ndarray:
    """Return one random index below `size` out of each of `count` groups of neighbours, ascending [frame, count]."""
    edges = np.linspace(0, size, count + 1).astype(int)
    return rng.integers(edges[:-1], edges[1:], size=(frames, count))


def _axis_indices(centre: float, size: int, inner: int, stride: int, offset: int) -> np.ndarray:
    """Return the selected indices of rows or columns of a crop, ascending.

    Every `stride`-th of the `inner` indices around the centre [px in the crop] is selected, and every
    `OUTER_STRIDE * stride`-th of the others. `offset` shifts the pattern.
    """
    start = int(np.clip(round(centre) - inner // 2, 0, size - inner))
    index = np.arange(size)
    is_inner = (index >= start) & (index < start + inner)
    is_selected = np.where(is_inner, (index + offset) % stride == 0, (index + offset) % (OUTER_STRIDE * stride) == 0)
    return index[is_selected]


def _equal_lengths(indices: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of all frames padded to the same length with their last one, and which are not padding.

    Both are arrays [frame, n].
    """
    longest = max(len(index) for index in indices)
    padded = np.stack([np.pad(index, (0, longest - len(index)), mode="edge") for index in indices])
    return padded, np.arange(longest) < np.array([len(index) for index in indices])[:, None]


def _take_pixels(
    frames: FrameSet, row: np.ndarray, has_row: np.ndarray, column: np.ndarray, has_column: np.ndarray
) -> Pixels:
    """Return the pixels at rows [frame, h] and columns [frame, w] of the crops.

    Frames with fewer rows or columns are padded. `has_row` and `has_column`, of the same shapes, are False at padding,
    whose pixels are not used.
    """
    # Index of each pixel in arrays [frame, row, column].
    index = (np.arange(len(frames))[:, None, None], row[:, :, None], column[:, None, :])
    readings, light_field = frames.readings[index], frames.light_field
    is_used = np.isfinite(readings) & has_row[:, :, None] & has_column[:, None, :]
    y, x = row + frames.top[:, None], column + frames.left[:, None]
    crop_rows = np.arange(frames.readings.shape[1]) + frames.top[:, None]
    # Each row of a crop counts for the nearest of these rows, which is never padding at −∞.
    row_share = _row_share(np.where(has_row, y, -np.inf), crop_rows, np.ones(crop_rows.shape))
    return Pixels(
        x=x[:, None, :].astype(float),
        y=y[:, :, None].astype(float),
        readings=np.where(is_used, readings, 0.0),
        is_used=is_used,
        row_share=row_share[:, :, None],
        sensor_columns=frames.sensor_columns,
        sensor_rows=frames.sensor_rows,
        extra_variance=np.zeros((len(frames), 1, 1)) if light_field is None else light_field.variance[index],
        field_share=np.zeros((len(frames), 1, 1)) if light_field is None else light_field.share[index],
        mean_field_share=0.0 if light_field is None else light_field.mean_share,
        dispersion=1.0 if light_field is None else light_field.dispersion,
    )


def _row_share(selected: np.ndarray, rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the summed weights of the rows to which each selected row is the nearest one [frame, h].

    Parameters
    ----------
    selected : array [frame, h]
        Rows of the sensor [px].
    rows : array [frame, n]
        All rows that the selected ones represent [px].
    weights : array [frame, n]
        Number of rows that each of these represents already.
    """
    shares = np.zeros(selected.shape)
    for f in range(len(selected)):
        nearest = np.abs(rows[f][:, None] - selected[f]).argmin(axis=1)
        np.add.at(shares[f], nearest, weights[f])
    return shares


def usable_cells(dataset: Dataset, status: xr.DataArray) -> list[Cell]:
    """Return the cells of the usable spot frames, in the order of the manifest.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    status : xr.DataArray
        Flags of the crops over the grid, for one way of centring them.
    """
    # crops.nc has all dimensions of the grid, also those without recorded values.
    dims = [axis.name for axis in dataset.axes]
    position = {id(frame): k for k, frame in enumerate(dataset.spots)}
    cells = [cell for cell in dataset.cells() if is_usable(status.isel(dict(zip(dims, cell[0], strict=True))))]
    return sorted(cells, key=lambda cell: position[id(cell[1])])


def load_frames(dataset: Dataset, crops: xr.Dataset, cells: Sequence[Cell]) -> FrameSet:
    """Return the spot frames of some cells of a dataset.

    Parameters
    ----------
    dataset : Dataset
        Frames with their conditions.
    crops : xr.Dataset
        Content of crops.nc, of which the crops about the centroid of the light are taken.
    cells : sequence of (index, Frame)
        Result of `usable_cells`.
    """
    at_light, dims = crops.sel(centring="light"), store.grid_dims(crops)
    at_cells = [at_light.isel(dict(zip(dims, index, strict=True))) for index, _ in cells]
    images, left, top = (np.array([cell[name].values for cell in at_cells]) for name in ("image", "left", "top"))
    frames = [frame for _, frame in cells]
    number_of = {id(frame): k for k, frame in enumerate(dataset.spots)}
    exposures = [frame.exposure_s for frame in frames]
    exposure_s = np.array([1.0 if value is None else value for value in exposures])
    angle = np.deg2rad([frame.angle_deg or 0.0 for frame in frames])
    repeat = np.array([frame.repeat or 0 for frame in frames])
    declared = [tuple(parse_number(frame.extra[name]) for name in dataset.instrument.conditions) for frame in frames]
    number = np.array([number_of[id(frame)] for frame in frames], float)
    has_order = dataset.instrument.order_known and len(frames) > 1
    distinct_s = np.unique(exposure_s)
    design = Design(
        exposure_s=exposure_s,
        angle=angle,
        order=number / max(len(dataset.spots) - 1, 1) if has_order else np.full(len(frames), 0.5),
        repeat=repeat,
        site=_number_distinct(list(zip(angle, declared, repeat, strict=True))),
        condition=_number_distinct(list(zip(exposure_s, declared, strict=True))),
        longest_s=float(distinct_s.max()),
        reference_s=float(np.exp(np.mean(np.log(distinct_s)))),
        has_exposures=None not in exposures,
        has_order=has_order,
    )
    return FrameSet(images, left, top, design, crops.sizes["column"], crops.sizes["row"])


def _number_distinct(keys: list) -> np.ndarray:
    """Return the number of each key [key]; equal keys share one, counted from 0 in the order of first occurrence."""
    number_of: dict[str, int] = {}
    return np.array([number_of.setdefault(repr(key), len(number_of)) for key in keys])
