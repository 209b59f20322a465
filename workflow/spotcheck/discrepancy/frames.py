"""Spot frames with their conditions, held-out repeats, and the pixels that fits use."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr

from spotcheck.crops.cropping import is_usable
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.manifest import parse_number
from spotcheck.io import store
from spotcheck.model.conditions import FrameConditions, PixelGrid

# Repeats from which on every third one is held out.
FEWEST_REPEATS = 6
# Pixels within this distance [σ] of a spot along each axis are used densely, those beyond every `OUTER_STRIDE`-th.
INNER_REACH, OUTER_STRIDE = 3.2, 4
# Most pixels of a fit: larger sets of frames are strided further.
MOST_PIXELS = 2_200_000
# Pixels of the subset on which candidates are ranked.
THINNED_PIXELS = 100_000
# Seed of that subset: the same at every call.
THINNED_SEED = 20210


@dataclass(frozen=True)
class Design:
    """Conditions of F frames."""

    exposure_s: np.ndarray  # exposure [frame, s]; 1 where it was not recorded
    angle: np.ndarray  # angle of the fibres [frame, rad]; 0 where it was not recorded
    order: np.ndarray  # place in the order of acquisition, from 0 to 1 [frame]; 0.5 where it is unknown
    repeat: np.ndarray  # repeat of the condition [frame]
    site: np.ndarray  # number of the site: angle, declared conditions and repeat [frame]
    condition: np.ndarray  # number of the condition: exposure and declared conditions [frame]
    longest_s: float  # longest exposure of the dataset [s]
    reference_s: float  # geometric mean of its exposures [s]
    has_exposures: bool  # whether exposures were recorded
    has_order: bool  # whether the order of acquisition is known

    @property
    def sites(self) -> int:
        """Number of sites."""
        return len(np.unique(self.site))

    def select(self, frames: np.ndarray | slice) -> "Design":
        """Return the conditions of some frames."""
        names = ("exposure_s", "angle", "order", "repeat", "site", "condition")
        return replace(self, **{name: getattr(self, name)[frames] for name in names})


@dataclass(frozen=True)
class LightField:
    """Granular light, which adds to the scatter of readings and makes neighbouring pixels alike.

    Its variance is that at the light of a first fit and is kept: if it followed the mean, the skewness of the field
    would pull on the mean.
    """

    variance: np.ndarray  # of the readings by the field, beyond the model's [frame, row, column] DN²
    dispersion: float  # variance of the light's score over that of independent readings
    share: np.ndarray  # part of the variance of a reading that is the field's [frame, row, column]
    mean_share: float  # its mean over the information on the light

    def select(self, frames: np.ndarray) -> "LightField":
        """Return the field of some frames."""
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
    light_field: "LightField | None" = field(default=None, repr=False)  # granular light of the frames

    def __len__(self) -> int:
        return len(self.left)

    def select(self, frames: np.ndarray) -> "FrameSet":
        """Return some of the frames."""
        parts = {"readings": self.readings[frames], "left": self.left[frames], "top": self.top[frames]}
        light_field = None if self.light_field is None else self.light_field.select(frames)
        return replace(self, design=self.design.select(frames), light_field=light_field, **parts)

    def held_out(self) -> np.ndarray:
        """Return which frames [frame] are kept from the search: every third repeat (2, 5, 8, …) of six or more."""
        repeats = np.unique(self.design.repeat)
        if len(repeats) < FEWEST_REPEATS:
            return np.zeros(len(self), bool)
        return np.isin(self.design.repeat, repeats[2::3])


@dataclass(frozen=True)
class FrameParameters:
    """Spot of each frame, as the joint fit has it."""

    log_peak: np.ndarray  # ln of the peak in DN [frame]
    log_sigma: np.ndarray  # ln of the width σ_g in px [frame]
    x: np.ndarray  # column of the centre on the sensor [frame, px]
    y: np.ndarray  # row of the centre [frame, px]

    def select(self, frames: np.ndarray | slice) -> "FrameParameters":
        """Return the parameters of some frames."""
        return FrameParameters(*(values[frames] for values in self.as_rows()))

    def as_rows(self) -> np.ndarray:
        """Return the parameters as an array [parameter, frame]."""
        return np.stack([self.log_peak, self.log_sigma, self.x, self.y])


@dataclass(frozen=True)
class Pixels:
    """Readings at selected rows and columns of each frame: h rows and w columns, the same number in all frames."""

    x: np.ndarray  # columns on the sensor [frame, 1, w]
    y: np.ndarray  # rows on the sensor [frame, h, 1]
    readings: np.ndarray  # [frame, h, w] DN, 0 where a pixel is not used
    is_used: np.ndarray  # whether a pixel takes part [frame, h, w]
    row_share: np.ndarray  # rows of the sensor that each row stands for [frame, h, 1]
    sensor_columns: int  # columns of the sensor's frame
    sensor_rows: int  # rows of the sensor's frame
    extra_variance: np.ndarray  # of readings beyond that of the model [frame, h, w] DN²; broadcasts
    field_share: np.ndarray  # part of the variance that a granular field has [frame, h, w]; broadcasts
    mean_field_share: float = 0.0  # its mean over the information on the light
    dispersion: float = 1.0  # variance of the light's score over that of independent readings
    share: float = 1.0  # part of the pixels of a fit; the penalty of a free shape is scaled by it

    @property
    def count(self) -> int:
        """Number of pixels that take part."""
        return int(self.is_used.sum())

    def select(self, frames: slice | np.ndarray) -> "Pixels":
        """Return the pixels of some frames."""
        names = ("x", "y", "readings", "is_used", "row_share", "extra_variance", "field_share")
        return replace(self, **{name: getattr(self, name)[frames] for name in names})

    def dispersion_of(self, field_share: float | np.ndarray) -> float | np.ndarray:
        """Return the variance of the score of a change of the readings over that of independent readings.

        Pixels share the noise of a granular field only. `field_share` is the field's part of the variance, in the mean
        over the information on the change: a change where the field is dark has a dispersion of 1.
        """
        if self.mean_field_share == 0:
            return self.dispersion
        return 1 + (self.dispersion - 1) * field_share / self.mean_field_share


def add_field(pixels: Pixels, frames: FrameSet) -> Pixels:
    """Return pixels of frames with the variance of the frames' light field beside their present one."""
    assert frames.light_field is not None
    number = np.arange(len(frames))[:, None, None]
    row, column = (
        (place - corner[:, None, None]).astype(int)
        for place, corner in ((pixels.y, frames.top), (pixels.x, frames.left))
    )
    return replace(pixels, extra_variance=pixels.extra_variance + frames.light_field.variance[number, row, column])


def conditions_of(design: Design, spots: FrameParameters, pixels: Pixels) -> FrameConditions:
    """Return what the forward model needs of all frames at once: arrays [frame, 1, 1] beside the pixels."""

    def column(values: np.ndarray) -> np.ndarray:
        return np.asarray(values, float)[:, None, None]

    grid = PixelGrid(pixels.x, pixels.y, pixels.sensor_columns, pixels.sensor_rows, pixels.row_share)
    return FrameConditions(
        pixels=grid,
        x0=column(spots.x),
        y0=column(spots.y),
        exposure_s=column(design.exposure_s),
        longest_s=design.longest_s,
        reference_s=design.reference_s,
        angle=column(design.angle),
        order=column(design.order),
        peak_dn=column(np.exp(spots.log_peak)),
        sigma_px=column(np.exp(spots.log_sigma)),
    )


def select_pixels(frames: FrameSet, spots: FrameParameters) -> Pixels:
    """Return the pixels of a fit: dense near each spot, every `OUTER_STRIDE`-th row and column beyond."""
    _, rows, columns = frames.readings.shape
    near_px = INNER_REACH * float(np.exp(np.max(spots.log_sigma)))
    inner = [min(2 * int(near_px) + 1, size) for size in (rows, columns)]
    outer = [-(-(size - near) // OUTER_STRIDE) for size, near in zip((rows, columns), inner, strict=True)]
    count = len(frames) * (inner[0] + outer[0]) * (inner[1] + outer[1])
    stride = max(int(np.ceil(np.sqrt(count / MOST_PIXELS))), 1)
    # Offsets of rows and columns differ, so that together the frames show every pixel.
    y_index = [
        _axis_indices(spots.y[f] - frames.top[f], rows, inner[0], stride, f // OUTER_STRIDE) for f in range(len(frames))
    ]
    x_index = [_axis_indices(spots.x[f] - frames.left[f], columns, inner[1], stride, f) for f in range(len(frames))]
    return _take_pixels(frames, *_equal_lengths(y_index), *_equal_lengths(x_index))


def thin_pixels(pixels: Pixels, count: int = THINNED_PIXELS) -> Pixels:
    """Return a random subset of rows and columns of each frame with about `count` pixels, the same at every call.

    One row, and one column, is drawn out of as many neighbours as it stands for: a sum over a column by `row_share` is
    then off by much less than one over rows that are drawn out of all.
    """
    frames, rows, columns = pixels.readings.shape
    share = np.sqrt(min(count / (frames * rows * columns), 1.0))
    kept_rows, kept_columns = (max(round(share * size), min(size, 8)) for size in (rows, columns))
    rng = np.random.default_rng(THINNED_SEED)
    row, column = _draw_evenly(rng, frames, rows, kept_rows), _draw_evenly(rng, frames, columns, kept_columns)
    number = np.arange(frames)[:, None, None]
    at = (number, row[:, :, None], column[:, None, :])
    y = np.take_along_axis(pixels.y[:, :, 0], row, axis=1)
    x = np.take_along_axis(pixels.x[:, 0, :], column, axis=1)
    share_of_rows = _row_share(y, pixels.y[:, :, 0], pixels.row_share[:, :, 0])
    selected: dict[str, Any] = {
        "readings": pixels.readings[at],
        "is_used": pixels.is_used[at],
        "row_share": share_of_rows[:, :, None],
        "extra_variance": np.broadcast_to(pixels.extra_variance, pixels.readings.shape)[at],
        "field_share": np.broadcast_to(pixels.field_share, pixels.readings.shape)[at],
    }
    thinned = replace(pixels, x=x[:, None, :], y=y[:, :, None], **selected)
    part = thinned.count / max(pixels.count, 1)
    # Of the pixels that a grain covers only this part is left beside each pixel.
    return replace(thinned, share=pixels.share * part, dispersion=1 + part * (pixels.dispersion - 1))


def _draw_evenly(rng: np.random.Generator, frames: int, size: int, count: int) -> np.ndarray:
    """Return one random index out of each of `count` groups of neighbours, ascending [frame, count]."""
    edges = np.linspace(0, size, count + 1).astype(int)
    return rng.integers(edges[:-1], edges[1:], size=(frames, count))


def _axis_indices(centre: float, size: int, inner: int, stride: int, offset: int) -> np.ndarray:
    """Return indices along an axis: `inner` neighbours of the centre densely, the others sparsely from an offset on."""
    start = int(np.clip(round(centre) - inner // 2, 0, size - inner))
    index = np.arange(size)
    is_inner = (index >= start) & (index < start + inner)
    is_kept = np.where(is_inner, (index + offset) % stride == 0, (index + offset) % (OUTER_STRIDE * stride) == 0)
    return index[is_kept]


def _equal_lengths(indices: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return indices [frame, n] of equal number, filled up by their last one, and which of them count."""
    longest = max(len(index) for index in indices)
    filled = np.stack([np.pad(index, (0, longest - len(index)), mode="edge") for index in indices])
    return filled, np.arange(longest) < np.array([len(index) for index in indices])[:, None]


def _take_pixels(
    frames: FrameSet, row: np.ndarray, has_row: np.ndarray, column: np.ndarray, has_column: np.ndarray
) -> Pixels:
    """Return the pixels at rows [frame, h] and columns [frame, w] of which some are fillers."""
    at = (np.arange(len(frames))[:, None, None], row[:, :, None], column[:, None, :])
    readings, light_field = frames.readings[at], frames.light_field
    is_used = np.isfinite(readings) & has_row[:, :, None] & has_column[:, None, :]
    y, x = row + frames.top[:, None], column + frames.left[:, None]
    every_row = np.arange(frames.readings.shape[1]) + frames.top[:, None]
    share = _row_share(np.where(has_row, y, -np.inf), every_row, np.ones(every_row.shape))
    return Pixels(
        x=x[:, None, :].astype(float),
        y=y[:, :, None].astype(float),
        readings=np.where(is_used, readings, 0.0),
        is_used=is_used,
        row_share=share[:, :, None],
        sensor_columns=frames.sensor_columns,
        sensor_rows=frames.sensor_rows,
        extra_variance=np.zeros((len(frames), 1, 1)) if light_field is None else light_field.variance[at],
        field_share=np.zeros((len(frames), 1, 1)) if light_field is None else light_field.share[at],
        mean_field_share=0.0 if light_field is None else light_field.mean_share,
        dispersion=1.0 if light_field is None else light_field.dispersion,
    )


def _row_share(kept: np.ndarray, rows: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Return the rows of the sensor [frame, h] that each kept row stands for: those nearest to it."""
    out = np.zeros(kept.shape)
    for f in range(len(kept)):
        nearest = np.abs(rows[f][:, None] - kept[f]).argmin(axis=1)
        np.add.at(out[f], nearest, shares[f])
    return out


def load_frames(dataset: Dataset, crops: xr.Dataset) -> FrameSet:
    """Return the usable spot frames of a dataset in the order of acquisition."""
    at_light = crops.sel(centring="light")
    dims = store.grid_dims(crops)
    number = {id(frame): k for k, frame in enumerate(dataset.spots)}
    cells = [(dict(zip(dims, index, strict=True)), frame) for index, frame in dataset.cells()]
    cells = [(at, frame) for at, frame in cells if is_usable(at_light["status"].isel(at))]
    cells.sort(key=lambda cell: number[id(cell[1])])
    frames = [frame for _, frame in cells]
    images, left, top = (
        np.array([at_light[name].isel(at).values for at, _ in cells]) for name in ("image", "left", "top")
    )
    exposures = [frame.exposure_s for frame in frames]
    has_exposures = None not in exposures
    exposure_s = np.array([1.0 if value is None else value for value in exposures])
    angle = np.deg2rad([frame.angle_deg or 0.0 for frame in frames])
    repeat = np.array([frame.repeat or 0 for frame in frames])
    declared = [tuple(parse_number(frame.extra[name]) for name in dataset.instrument.conditions) for frame in frames]
    place = np.array([number[id(frame)] for frame in frames], float)
    has_order = dataset.instrument.order_known and len(frames) > 1
    order = place / max(len(dataset.spots) - 1, 1) if has_order else np.full(len(frames), 0.5)
    distinct = np.unique(exposure_s)
    design = Design(
        exposure_s=exposure_s,
        angle=angle,
        order=order,
        repeat=repeat,
        site=_numbers([(a, d, r) for a, d, r in zip(angle, declared, repeat, strict=True)]),
        condition=_numbers(list(zip(exposure_s, declared, strict=True))),
        longest_s=float(distinct.max()),
        reference_s=float(np.exp(np.mean(np.log(distinct)))),
        has_exposures=has_exposures,
        has_order=has_order,
    )
    return FrameSet(images, left, top, design, crops.sizes["column"], crops.sizes["row"])


def _numbers(keys: list) -> np.ndarray:
    """Return the number of each key among the distinct ones, in the order of their first occurrence."""
    first: dict[str, int] = {}
    return np.array([first.setdefault(repr(key), len(first)) for key in keys])
