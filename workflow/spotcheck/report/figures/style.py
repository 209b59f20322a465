"""House style of the figures: sizes, colours, units on axes, and reproducible files."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from spotcheck.io import store

WIDTH = 6.5  # inch, the width of a page's text
DPI = 150
FORMATS = ("svg", "png")
RC: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.labelsize": 9,
    "axes.titlesize": 9,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.linewidth": 0.8,
    "lines.linewidth": 1.3,
    "lines.markersize": 5,
    "errorbar.capsize": 3,
    "image.interpolation": "nearest",
    "image.origin": "upper",
    "svg.hashsalt": "spotcheck",
    "svg.fonttype": "path",
    "savefig.dpi": DPI,
    "savefig.facecolor": "white",
}
# Readable in grey print and with colour blindness: luminance is monotonic along the first map, and along each half of
# the second.
IMAGE_MAP, DIVERGING_MAP = "magma", "RdBu_r"
# Colours that differ in hue and in lightness (Okabe and Ito).
MEASURED, SIMULATED, ACCENT = "#0072B2", "#D55E00", "#009E73"
LUMA = np.array([0.299, 0.587, 0.114])  # weights of red, green and blue in luma (ITU-R BT.601)
DASHED = (0, (5, 2))  # line style of simulated curves
MARKERS = "osD^vPX*"
DASHES: tuple[tuple[float, ...], ...] = (
    (6, 2),
    (6, 2, 1.2, 2),
    (1.2, 1.6),
    (3, 1.5),
    (9, 2, 3, 2),
    (6, 1.5, 1, 1, 1, 1.5),
)
# Values below this fraction of the largest are rounding errors of zero, and choose no prefix.
ZERO_FRACTION = 1e-9
# SI prefixes by power of ten.
PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
# Names of grid dimensions on an axis.
NAMES = {"angle": "fibre orientation γ", "exposure": "exposure time $t$", "repeat": "repeat"}


class Drawing(NamedTuple):
    """A figure with its caption."""

    figure: Figure  # the figure
    caption: str  # text below the figure


class LineStyle(NamedTuple):
    """Appearance of a series of measured values and of its simulated counterpart."""

    colour: Any  # colour of both
    marker: str  # marker of both
    dashes: tuple[float, ...]  # dashes of the simulated counterpart


class DisplayUnit(NamedTuple):
    """A unit with SI prefix."""

    factor: float  # displayed value / value in the SI unit
    symbol: str  # symbol of the unit


@contextmanager
def house_style() -> Iterator[None]:
    """Apply the house style, independent of the user's matplotlibrc."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(RC)
        yield


def new_figure(height: float, width: float = WIDTH) -> Figure:
    """Return an empty figure of a height and width [inch] with constrained layout."""
    return Figure(figsize=(width, height), layout="constrained")


def new_image_grid(height: float) -> Figure:
    """Return an empty figure of a height [inch] for a grid of images, without gaps due to their fixed aspect ratio."""
    return Figure(figsize=(WIDTH, height), layout="compressed")


def show_image(
    ax: Axes,
    image: np.ndarray,
    cmap: str,
    norm: Normalize,
    extent: tuple[float, float, float, float] | None = None,
    **properties: Any,
) -> AxesImage:
    """Draw an image [row, column] without grid lines.

    Parameters
    ----------
    ax : Axes
        Axes to draw on.
    image : ndarray
        Image; NaN is transparent.
    cmap : str
        Name of the colour map.
    norm : Normalize
        Scale of the colours.
    extent : tuple of float, optional
        Left, right, bottom and top edge; by default pixel centres are at integers.
    **properties
        Properties of the axes, such as `title`.
    """
    shown = ax.imshow(image, cmap=cmap, norm=norm, extent=extent)
    ax.grid(False)
    ax.set(**properties)
    return shown


def centred_extent(shape: tuple[int, ...], row: float, column: float) -> tuple[float, float, float, float]:
    """Return the extent of an image [row, column] in px relative to a centre; pixel centres are at integers."""
    return -0.5 - column, shape[1] - 0.5 - column, shape[0] - 0.5 - row, -0.5 - row


def line_styles(count: int) -> list[LineStyle]:
    """Return styles for `count` ordered series, from dark to light in equal steps of luma."""
    shades = matplotlib.colormaps["viridis"](np.linspace(0.02, 0.80, 200))
    luma = shades[:, :3] @ LUMA
    steps = np.linspace(luma[0], luma[-1], count) if count > 1 else np.array([0.36])
    colours = shades[np.searchsorted(luma, steps).clip(0, len(shades) - 1)]
    return [LineStyle(colour, MARKERS[k % len(MARKERS)], DASHES[k % len(DASHES)]) for k, colour in enumerate(colours)]


def choose_unit(values: Any, unit: str) -> DisplayUnit:
    """Return the unit with the prefix that makes the smallest value at least 1; degrees and px have no prefix."""
    if unit in ("degree", "1", "pixel", "K"):
        return DisplayUnit(1.0, {"degree": "°", "pixel": "px", "1": ""}.get(unit, unit))
    size = np.abs(np.asarray(values, float))
    size = size[np.isfinite(size)]
    size = size[size > ZERO_FRACTION * size.max(initial=0.0)]
    power = 0 if not size.size else int(np.clip(3 * np.floor(np.log10(size.min() * (1 + 1e-9)) / 3), -12, 6))
    return DisplayUnit(10.0**-power, PREFIXES[power] + unit)


def axis_label(name: str, unit: str) -> str:
    """Return the label of an axis: quantity / unit."""
    return f"{name} / {unit}" if unit else name


def axis_name(dim: str) -> str:
    """Return the name of a grid dimension on an axis; a declared condition loses the suffix of its unit."""
    return NAMES.get(dim, dim.rsplit("_", 1)[0].replace("_", " ") if "_" in dim else dim)


def format_value(value: float, unit: str) -> str:
    """Return a value with its unit: `500 µs`, `45°`."""
    return f"{value:.4g}{'' if unit in ('', '°') else ' '}{unit}"


def choose_power_of_ten(largest: float) -> tuple[float, str]:
    """Return the divisor for large values and its text: (1e6, "10⁶ ") for millions, (1, "") below 10 000."""
    if not np.isfinite(largest) or abs(largest) < 1e4:
        return 1.0, ""
    power = int(3 * np.floor(np.log10(abs(largest) * 1.5) / 3))
    return 10.0**power, f"$10^{{{power}}}$ "


def add_legend(figure: Figure, handles: list, labels: list[str], columns: int) -> None:
    """Add a legend above the axes, where it cannot cover data."""
    figure.legend(handles, labels, loc="outside upper center", ncols=columns, handlelength=3.2, columnspacing=1.6)


def save_drawing(drawing: Drawing, folder: Path, name: str) -> None:
    """Write `<name>.svg` and `<name>.png`, whole or not at all, without date and version of the software."""
    for suffix in FORMATS:
        stream = io.BytesIO()
        metadata = {"Date": None, "Creator": None} if suffix == "svg" else {"Software": None}
        drawing.figure.savefig(stream, format=suffix, metadata=metadata)
        with store.write_with_sidecar(folder / f"{name}.{suffix}") as scratch:
            scratch.write_bytes(stream.getvalue())
