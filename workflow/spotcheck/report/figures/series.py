"""Series of values over one dimension of the grid of frames, and texts about the grid.

The grid has the dimensions angle, exposure and repeat, and one for each condition that the instrument file declares.
In a plot one dimension becomes the abscissa, one has a line for each value, and frames are averaged over all others.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.ticker import MaxNLocator

from spotcheck.report.figures import style
from spotcheck.report.figures.results import Unavailable

# Units of the dimensions that every grid has; any other dimension is a declared condition.
UNITS = {"angle": "degree", "exposure": "s", "repeat": "1"}
# Ticks are at the values if there are at most MAX_TICKS, all further apart than the range of the values / TICK_SLOTS:
# the labels of closer ticks would overlap.
MAX_TICKS, TICK_SLOTS = 10, 14


class PlotAxes(NamedTuple):
    """Role of each dimension of the grid in a plot."""

    abscissa: str  # dimension on the abscissa
    lines: str | None  # dimension with one line per value; None for a single line
    pooled: tuple[str, ...]  # dimensions that are averaged over


class LineStatistics(NamedTuple):
    """Statistics of a quantity over frames, each [line, point of the abscissa]."""

    mean: np.ndarray  # mean, in the unit of the quantity; NaN without frames
    sd: np.ndarray  # standard deviation (n − 1), in the unit of the quantity; NaN below two frames
    frames: np.ndarray  # number of frames with a finite value


def choose_axes(ds: xr.Dataset, grid: tuple[str, ...]) -> PlotAxes:
    """Return the role of each dimension of `grid` in a plot of values in `ds`.

    The abscissa is the first of angle, declared conditions, exposure and repeat that has more than one value. Each
    exposure is a line unless the exposure is the abscissa.
    """
    conditions = [dim for dim in grid if dim not in UNITS]
    order = ("angle", *conditions, "exposure", "repeat")
    abscissa = next((dim for dim in order if ds.sizes[dim] > 1), "repeat")
    lines = "exposure" if abscissa != "exposure" else None
    return PlotAxes(abscissa, lines, tuple(dim for dim in grid if dim not in (abscissa, lines)))


def average_frames(values: xr.DataArray, axes: PlotAxes) -> LineStatistics:
    """Return mean, standard deviation and number of the finite `values` for each line and point.

    `values` has the dimensions that `axes` names, in any order. The statistics have one line if `axes.lines` is None.
    """
    plot_dims = [dim for dim in (axes.lines, axes.abscissa) if dim]
    array = values.transpose(*plot_dims, *axes.pooled).values.astype(float)
    array = array.reshape(*array.shape[: len(plot_dims)], -1)
    array = array if axes.lines else array[None]
    is_finite = np.isfinite(array)
    count = is_finite.sum(axis=-1)
    mean = np.where(is_finite, array, 0.0).sum(axis=-1) / np.where(count, count, np.nan)
    square = np.where(is_finite, array - mean[..., None], 0.0) ** 2
    sd = np.sqrt(square.sum(axis=-1) / np.where(count > 1, count - 1, np.nan))
    return LineStatistics(mean, sd, count)


def require_values(statistics: LineStatistics, quantity: str) -> LineStatistics:
    """Return the same statistics. Raises `Unavailable`, which names the `quantity`, if no frame has a value."""
    if not statistics.frames.any():
        raise Unavailable(f"no usable spot gives {quantity}")
    return statistics


def axis_values(ds: xr.Dataset, dim: str) -> tuple[np.ndarray, str, str]:
    """Return the values of a dimension of the grid in the displayed unit, that unit, and the label of the axis.

    If the values were not recorded, they are 0, 1, … and the unit is "".
    """
    if dim not in ds.coords:
        return np.arange(ds.sizes[dim], dtype=float), "", f"{style.axis_name(dim)} (number)"
    values = ds[dim].values.astype(float)
    factor, unit = style.choose_unit(values, str(ds[dim].attrs.get("units", UNITS.get(dim, "1"))))
    return values * factor, unit, style.axis_label(style.axis_name(dim), unit)


def value_text(ds: xr.Dataset, dim: str, k: int) -> str:
    """Return the value at index `k` of a dimension as text: `500 µs`, `45°`, `repeat 3`; "" if not recorded."""
    if dim not in ds.coords:
        return ""
    values, unit, _ = axis_values(ds, dim)
    text = style.format_value(values[k], unit)
    return text if unit else f"{style.axis_name(dim)} {text}"


def iterate_places(ds: xr.Dataset, dims: Iterable[str]) -> Iterator[dict[str, int]]:
    """Yield each place on some dimensions: an index of each dimension, by its name. The last one varies fastest."""
    dims = tuple(dims)
    for index in np.ndindex(*(ds.sizes[dim] for dim in dims)):
        yield dict(zip(dims, index, strict=True))


def condition_text(ds: xr.Dataset, index: dict[str, int]) -> str:
    """Return the recorded values at an index of some dimensions of the grid as text: `45°, 500 µs`."""
    return ", ".join(filter(None, (value_text(ds, dim, k) for dim, k in index.items())))


def list_line_names(ds: xr.Dataset, axes: PlotAxes) -> list[str]:
    """Return the value of each line as text for the legend; "" if it was not recorded or for a single line."""
    return [value_text(ds, axes.lines, k) for k in range(ds.sizes[axes.lines])] if axes.lines else [""]


def set_abscissa(ax: Axes, ds: xr.Dataset, axes: PlotAxes) -> np.ndarray:
    """Label the abscissa, set its limits, and return its values in the displayed unit.

    Ticks are at the values if these are few and far enough apart for their numbers.
    """
    x, _, label = axis_values(ds, axes.abscissa)
    ax.set_xlabel(label)
    if len(x) <= MAX_TICKS and (len(x) < 2 or np.diff(x).min() > np.ptp(x) / TICK_SLOTS):
        ax.set_xticks(x, [f"{value:.4g}" for value in x])
    elif axes.abscissa == "repeat":
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    margin = 1.0
    if len(x) > 1:
        margin = 0.5 * float(np.diff(x).min()) if len(x) <= MAX_TICKS else 0.03 * float(np.ptp(x))
    ax.set_xlim(x.min() - margin, x.max() + margin)
    return x


def offset_lines(x: np.ndarray, count: int) -> np.ndarray:
    """Return a small shift along the abscissa for each of `count` lines, so that error bars do not overlap.

    `x` are the ascending values of the abscissa; the shifts [line] are in their unit.
    """
    distance = float(np.diff(x).min()) if len(x) > 1 else 1.0
    # All lines together take at most half of the smallest distance between points.
    step = min(0.1, 0.5 / max(count, 1)) * distance
    return step * (np.arange(count) - (count - 1) / 2)


def draw_error_bars(
    ax: Axes, x: np.ndarray, mean: np.ndarray, sd: np.ndarray, line: style.LineStyle, is_filled: bool = True
) -> ErrorbarContainer:
    """Draw `mean` ± `sd` [point] over `x`, joined by a thin line; return the artist for the legend.

    There are no error bars if no standard deviation is known. With `is_filled` the markers are filled, else white.
    """
    face = line.colour if is_filled else "white"
    look: dict[str, Any] = {"color": line.colour, "marker": line.marker, "markerfacecolor": face, "linewidth": 0.7}
    return ax.errorbar(x, mean, yerr=sd if np.isfinite(sd).any() else None, elinewidth=1.1, **look)


def frames_text(statistics: LineStatistics, axes: PlotAxes) -> str:
    """Return a sentence without full stop on the number of frames per point and the meaning of the error bars."""
    counts = statistics.frames[statistics.frames > 0]
    if counts.max() < 2:
        return "One frame a point, so there are no error bars"
    pooled = " and ".join("repeats" if dim == "repeat" else style.axis_name(dim) for dim in axes.pooled) or "frames"
    return f"Mean ± standard deviation (n − 1) over {pooled}, {range_text(counts)} frames a point"


def range_text(counts: Sequence[int] | np.ndarray) -> str:
    """Return the range of counts as text: `3`, or `2 to 3`."""
    low, high = int(min(counts)), int(max(counts))
    return f"{low}" if low == high else f"{low} to {high}"


def pick_evenly(count: int, limit: int) -> np.ndarray:
    """Return at most `limit` of the indices 0 to `count` − 1, evenly spaced and including both ends."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(int))
