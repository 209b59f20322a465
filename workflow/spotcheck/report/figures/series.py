"""Series of values over one axis of the grid, and texts about the grid.

The values of frames lie on a grid of angles, exposures, repeats and declared conditions. One dimension becomes the
abscissa, one becomes the lines, and frames are averaged over all others.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.ticker import MaxNLocator

from spotcheck.report.figures import style
from spotcheck.report.figures.results import Unavailable

UNITS = {"angle": "degree", "exposure": "s", "repeat": "1"}
# Largest number of values that are used as ticks.
MAX_TICKS = 10


class PlotAxes(NamedTuple):
    """Use of the dimensions of the grid in a plot."""

    abscissa: str  # dimension on the abscissa
    lines: str | None  # dimension with one line per value; None for a single line
    pooled: tuple[str, ...]  # dimensions that are averaged over


class LineStatistics(NamedTuple):
    """Statistics of frames, each [line, point]."""

    mean: np.ndarray  # mean; NaN without frames
    sd: np.ndarray  # standard deviation (n − 1); NaN below two frames
    frames: np.ndarray  # number of frames with a finite value


def choose_axes(ds: xr.Dataset, grid: tuple[str, ...]) -> PlotAxes:
    """Return the axes of a plot: the abscissa is the angle, a declared condition, the exposure or the repeat."""
    conditions = [dim for dim in grid if dim not in UNITS]
    order = ("angle", *conditions, "exposure", "repeat")
    abscissa = next((dim for dim in order if ds.sizes[dim] > 1), "repeat")
    lines = "exposure" if abscissa != "exposure" else None
    return PlotAxes(abscissa, lines, tuple(dim for dim in grid if dim not in (abscissa, lines)))


def average_frames(values: xr.DataArray, axes: PlotAxes) -> LineStatistics:
    """Return mean and standard deviation of values on the grid for each line and point; NaN is left out."""
    kept = [dim for dim in (axes.lines, axes.abscissa) if dim]
    array = values.transpose(*kept, *axes.pooled).values.astype(float)
    array = array.reshape(*array.shape[: len(kept)], -1)
    array = array if axes.lines else array[None]
    is_finite = np.isfinite(array)
    count = is_finite.sum(axis=-1)
    mean = np.where(is_finite, array, 0.0).sum(axis=-1) / np.where(count, count, np.nan)
    square = np.where(is_finite, array - mean[..., None], 0.0) ** 2
    sd = np.sqrt(square.sum(axis=-1) / np.where(count > 1, count - 1, np.nan))
    return LineStatistics(mean, sd, count)


def require_values(statistics: LineStatistics, quantity: str) -> LineStatistics:
    """Return the statistics. Raises `Unavailable` if no frame has a value."""
    if not statistics.frames.any():
        raise Unavailable(f"no usable spot gives {quantity}")
    return statistics


def axis_values(ds: xr.Dataset, dim: str) -> tuple[np.ndarray, str, str]:
    """Return the values of a dimension in the displayed unit, that unit, and the axis label.

    The values are 0, 1, … if none were recorded.
    """
    if dim not in ds.coords:
        return np.arange(ds.sizes[dim], dtype=float), "", f"{style.axis_name(dim)} (number)"
    values = ds[dim].values.astype(float)
    factor, unit = style.choose_unit(values, str(ds[dim].attrs.get("units", UNITS.get(dim, "1"))))
    return values * factor, unit, style.axis_label(style.axis_name(dim), unit)


def value_text(ds: xr.Dataset, dim: str, k: int) -> str:
    """Return one value of a dimension as text: `500 µs`, `45°`, `repeat 3`; "" if it was not recorded."""
    if dim not in ds.coords:
        return ""
    values, unit, _ = axis_values(ds, dim)
    text = style.format_value(values[k], unit)
    return text if unit else f"{style.axis_name(dim)} {text}"


def condition_text(ds: xr.Dataset, index: dict[str, int]) -> str:
    """Return the recorded values at an index of the grid as text: `45°, 500 µs`."""
    return ", ".join(filter(None, (value_text(ds, dim, k) for dim, k in index.items())))


def list_line_names(ds: xr.Dataset, axes: PlotAxes) -> list[str]:
    """Return the name of each line in the legend; "" if its value was not recorded."""
    return [value_text(ds, axes.lines, k) for k in range(ds.sizes[axes.lines])] if axes.lines else [""]


def set_abscissa(ax: Axes, ds: xr.Dataset, axes: PlotAxes) -> np.ndarray:
    """Label the abscissa, set its ticks to the values if there are few, and return the values."""
    x, _, label = axis_values(ds, axes.abscissa)
    ax.set_xlabel(label)
    if len(x) <= MAX_TICKS and (len(x) < 2 or np.diff(x).min() > np.ptp(x) / 14):
        ax.set_xticks(x, [f"{value:.4g}" for value in x])
    elif axes.abscissa == "repeat":
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    margin = 1.0
    if len(x) > 1:
        margin = 0.5 * float(np.diff(x).min()) if len(x) <= MAX_TICKS else 0.03 * float(np.ptp(x))
    ax.set_xlim(x.min() - margin, x.max() + margin)
    return x


def offset_lines(x: np.ndarray, count: int) -> np.ndarray:
    """Return a small shift along the abscissa for each line, so that error bars do not overlap."""
    gap = float(np.diff(x).min()) if len(x) > 1 else 1.0
    step = min(0.1, 0.5 / max(count, 1)) * gap
    return step * (np.arange(count) - (count - 1) / 2)


def draw_error_bars(
    ax: Axes, x: np.ndarray, mean: np.ndarray, sd: np.ndarray, line: style.LineStyle, is_filled: bool = True
) -> ErrorbarContainer:
    """Draw markers joined by a thin line, with error bars if any standard deviation is known; return the handle."""
    return ax.errorbar(
        x,
        mean,
        yerr=sd if np.isfinite(sd).any() else None,
        color=line.colour,
        marker=line.marker,
        markerfacecolor=line.colour if is_filled else "white",
        linewidth=0.7,
        elinewidth=1.1,
    )


def frames_text(statistics: LineStatistics, axes: PlotAxes) -> str:
    """Return a sentence on the number of frames per point and the meaning of the error bars."""
    counts = statistics.frames[statistics.frames > 0]
    if counts.max() < 2:
        return "One frame a point, so there are no error bars"
    over = " and ".join("repeats" if dim == "repeat" else style.axis_name(dim) for dim in axes.pooled) or "frames"
    return f"Mean ± standard deviation (n − 1) over {over}, {range_text(counts)} frames a point"


def range_text(counts: Sequence[int] | np.ndarray) -> str:
    """Return the range of counts as text: `3`, or `2 to 3`."""
    low, high = int(min(counts)), int(max(counts))
    return f"{low}" if low == high else f"{low} to {high}"


def pick_evenly(count: int, most: int) -> np.ndarray:
    """Return at most `most` of the indices 0 to `count` − 1, evenly spaced, with both ends."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
