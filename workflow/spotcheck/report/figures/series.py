"""From values on the grid to series over one axis: which dimension lies on the abscissa, and what is averaged."""

from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.ticker import MaxNLocator

from spotcheck.report.figures import style
from spotcheck.report.figures.results import Unavailable

UNITS = {"angle": "degree", "exposure": "s", "repeat": "1"}
# More values than this on the abscissa, and the axis chooses its own ticks.
TICKS = 10


class Design(NamedTuple):
    """Dimension on the abscissa, dimension of the lines (None: one line), and dimensions that are averaged over."""

    across: str
    lines: str | None
    pooled: tuple[str, ...]


class Points(NamedTuple):
    """Mean, standard deviation (n − 1; NaN below two frames) and number of frames, each [line, point]."""

    mean: np.ndarray
    sd: np.ndarray
    frames: np.ndarray


def design_of(ds: xr.Dataset, grid: tuple[str, ...]) -> Design:
    """Angle on the abscissa where there are several; else a declared condition, the exposure, or the repeat."""
    conditions = [d for d in grid if d not in UNITS]
    order = ("angle", *conditions, "exposure", "repeat")
    across = next((d for d in order if ds.sizes[d] > 1), "repeat")
    lines = "exposure" if across != "exposure" else None
    return Design(across, lines, tuple(d for d in grid if d not in (across, lines)))


def points(values: xr.DataArray, design: Design) -> Points:
    """Reduce values on the grid to lines; what is not finite does not count."""
    keep = [d for d in (design.lines, design.across) if d]
    array = values.transpose(*keep, *design.pooled).values.astype(float)
    array = array.reshape(*array.shape[: len(keep)], -1)
    array = array if design.lines else array[None]
    good = np.isfinite(array)
    count = good.sum(axis=-1)
    mean = np.where(good, array, 0.0).sum(axis=-1) / np.where(count, count, np.nan)
    square = np.where(good, array - mean[..., None], 0.0) ** 2
    sd = np.sqrt(square.sum(axis=-1) / np.where(count > 1, count - 1, np.nan))
    return Points(mean, sd, count)


def coordinate(ds: xr.Dataset, dim: str) -> tuple[np.ndarray, str, str]:
    """Values of a dimension in the printed unit, that unit, and the axis label; 0, 1, … where none was recorded."""
    if dim not in ds.coords:
        return np.arange(ds.sizes[dim], dtype=float), "", f"{style.axis_name(dim)} (number)"
    raw = ds[dim].values.astype(float)
    factor, unit = style.scale(raw, str(ds[dim].attrs.get("units", UNITS.get(dim, "1"))))
    return raw * factor, unit, style.label(style.axis_name(dim), unit)


def value_text(ds: xr.Dataset, dim: str, k: int) -> str:
    """One value of a dimension in words: `500 µs`, `45°`, `repeat 3`; empty where none was recorded."""
    if dim not in ds.coords:
        return ""
    values, unit, _ = coordinate(ds, dim)
    text = style.number(values[k], unit)
    return text if unit else f"{style.axis_name(dim)} {text}"


def line_names(ds: xr.Dataset, design: Design) -> list[str]:
    """What the legend calls each line: the exposure, or nothing when there is one line without a value."""
    if design.lines is None or design.lines not in ds.coords:
        return [""] * (1 if design.lines is None else ds.sizes[design.lines])
    return [value_text(ds, design.lines, k) for k in range(ds.sizes[design.lines])]


def abscissa(ax: Axes, ds: xr.Dataset, design: Design) -> np.ndarray:
    """Label the abscissa, tick it at the values themselves where they are few; return them."""
    x, _, text = coordinate(ds, design.across)
    ax.set_xlabel(text)
    if len(x) <= TICKS and (len(x) < 2 or np.diff(x).min() > np.ptp(x) / 14):
        ax.set_xticks(x, [f"{v:.4g}" for v in x])
    elif design.across == "repeat":
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    if len(x) > 1:
        margin = 0.5 * float(np.diff(x).min()) if len(x) <= TICKS else 0.03 * float(np.ptp(x))
        ax.set_xlim(x.min() - margin, x.max() + margin)
    else:
        ax.set_xlim(x[0] - 1, x[0] + 1)
    return x


def offsets(x: np.ndarray, count: int) -> np.ndarray:
    """Small shifts along the abscissa, one a line, so that error bars stand beside each other."""
    gap = float(np.diff(x).min()) if len(x) > 1 else 1.0
    step = min(0.1, 0.5 / max(count, 1)) * gap
    return step * (np.arange(count) - (count - 1) / 2)


def bars(
    ax: Axes, x: np.ndarray, mean: np.ndarray, sd: np.ndarray, line: style.Line, filled: bool = True
) -> ErrorbarContainer:
    """Markers with error bars where a standard deviation exists, joined by a thin line; the handle for a legend."""
    error = sd if np.isfinite(sd).any() else None
    return ax.errorbar(
        x,
        mean,
        yerr=error,
        color=line.colour,
        marker=line.marker,
        markerfacecolor=line.colour if filled else "white",
        linewidth=0.7,
        elinewidth=1.1,
    )


def need_values(found: Points, what: str) -> Points:
    """The points, or `Unavailable` when no frame gave a value."""
    if not found.frames.any():
        raise Unavailable(f"no usable spot gives {what}")
    return found


def frames_text(found: Points, design: Design) -> str:
    """Clause of a caption: how many frames stand behind a point and what the error bars are."""
    low, high = int(found.frames[found.frames > 0].min()), int(found.frames.max())
    if high < 2:
        return "One frame a point, so there are no error bars"
    pooled = [d for d in design.pooled]
    over = " and ".join(style.axis_name(d) if d != "repeat" else "repeats" for d in pooled) or "frames"
    many = f"{high}" if low == high else f"{low} to {high}"
    return f"Mean ± standard deviation (n − 1) over {over}, {many} frames a point"
