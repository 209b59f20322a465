"""House style of the figures: sizes, colours, units on axes, and reproducible files."""

import io
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal, NamedTuple

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from spotcheck.io import store

WIDTH = 6.5  # inch, the width of a page's text
FORMATS = ("svg", "png")  # file formats, as suffixes
# Settings of Matplotlib for all figures.
HOUSE_STYLE = Path(__file__).with_name("house.mplstyle")
# Readable in grey print and with colour blindness: luminance is monotonic along the first map, and along each half of
# the second.
IMAGE_MAP, DIVERGING_MAP = "magma", "RdBu_r"
# Colours that differ in hue and in lightness (Okabe and Ito).
MEASURED, SIMULATED, ACCENT = "#0072B2", "#D55E00", "#009E73"
# Bands of printed values, behind the data.
PRINTED = "0.85"
LUMA = np.array([0.299, 0.587, 0.114])  # weights of red, green and blue in luma (ITU-R BT.601)
# Part of the colour map viridis for lines; lighter colours are hard to see on white.
LINE_COLOURS = (0.02, 0.80)
SINGLE_LUMA = 0.36  # luma of a single line
DASHED = (0, (5, 2))  # line style of simulated curves
MARKERS = "osD^vPX*"  # markers of a series of lines
# Values below this fraction of the largest are rounding errors of zero; the choice of a prefix ignores them.
ZERO_FRACTION = 1e-9
# SI prefixes by power of ten.
PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
# Largest value that is written without a power of ten.
MAX_PLAIN = 1e4
# Names on an axis of the dimensions of the grid of frames.
NAMES = {"angle": "fibre orientation γ", "exposure": "exposure time $t$", "repeat": "repeat"}


Extent = tuple[float, float, float, float]  # left, right, bottom and top edge of an image, in data coordinates


class Drawing(NamedTuple):
    """A figure with its caption."""

    figure: Figure  # figure without caption
    caption: str  # text below the figure


class LineStyle(NamedTuple):
    """Appearance of a line of measured values."""

    colour: Any  # Matplotlib colour
    marker: str  # Matplotlib marker


class DisplayUnit(NamedTuple):
    """A unit with SI prefix."""

    factor: float  # displayed value / value in the unit without prefix
    symbol: str  # symbol with prefix; "" for the unit 1


def house_style() -> AbstractContextManager[None]:
    """Return a context manager that applies `HOUSE_STYLE`; the user's matplotlibrc has no effect within it."""
    return matplotlib.style.context(HOUSE_STYLE, after_reset=True)


def new_figure(
    height: float, width: float = WIDTH, layout: Literal["constrained", "compressed"] = "constrained"
) -> Figure:
    """Return an empty figure; `height` and `width` are in inches.

    The layout "compressed" is for a grid of images: it closes the gaps that their fixed aspect ratio leaves.
    """
    return Figure(figsize=(width, height), layout=layout)


def show_image(
    ax: Axes, image: np.ndarray, cmap: str, norm: Normalize, extent: Extent | None = None, **properties: Any
) -> AxesImage:
    """Draw an image [row, column] without grid lines.

    Parameters
    ----------
    ax : Axes
        Axes to draw on.
    image : ndarray
        Values [row, column]; NaN is transparent.
    cmap : str
        Name of the colour map.
    norm : Normalize
        Scale of the colours.
    extent : tuple of float, optional
        Edges of the image; by default pixel centres are at integers.
    **properties
        Properties of the axes for `Axes.set`, such as `title`.

    Returns
    -------
    AxesImage
        The drawn image, for a colour bar.
    """
    artist = ax.imshow(image, cmap=cmap, norm=norm, extent=extent)
    ax.grid(False)
    ax.set(**properties)
    return artist


def line_styles(count: int) -> list[LineStyle]:
    """Return the styles of `count` ordered lines, from dark to light in equal steps of luma."""
    shades = matplotlib.colormaps["viridis"](np.linspace(*LINE_COLOURS, 200))
    luma = shades[:, :3] @ LUMA
    line_luma = np.linspace(luma[0], luma[-1], count) if count > 1 else np.array([SINGLE_LUMA])
    colours = shades[np.searchsorted(luma, line_luma).clip(0, len(shades) - 1)]
    return [LineStyle(colour, MARKERS[k % len(MARKERS)]) for k, colour in enumerate(colours)]


def choose_unit(values: Any, unit: str) -> DisplayUnit:
    """Return the unit with the SI prefix that makes the smallest absolute value at least 1.

    Parameters
    ----------
    values : array_like
        Values in `unit`, of any shape. NaN and rounding errors of zero are ignored; without other values there is no
        prefix.
    unit : str
        SI unit, or "degree", "1", "pixel" or "K", which have no prefix.
    """
    if unit in ("degree", "1", "pixel", "K"):
        return DisplayUnit(1.0, {"degree": "°", "pixel": "px", "1": ""}.get(unit, unit))
    sizes = np.abs(np.asarray(values, float))
    sizes = sizes[np.isfinite(sizes)]
    sizes = sizes[sizes > ZERO_FRACTION * sizes.max(initial=0.0)]
    # The factor keeps 1e-3 at the prefix m if rounding makes it slightly smaller.
    power = 0 if not sizes.size else int(np.clip(3 * np.floor(np.log10(sizes.min() * (1 + 1e-9)) / 3), -12, 6))
    return DisplayUnit(10.0**-power, PREFIXES[power] + unit)


def axis_label(name: str, unit: str) -> str:
    """Return the label of an axis, quantity / unit; only the quantity if the unit is ""."""
    return f"{name} / {unit}" if unit else name


def axis_name(dim: str) -> str:
    """Return the name on an axis of a dimension of the grid; the unit of a declared condition is removed: z for z_m."""
    return NAMES.get(dim, dim.rsplit("_", 1)[0].replace("_", " ") if "_" in dim else dim)


def format_value(value: float, unit: str) -> str:
    """Return a value with its unit as text, to four digits: `500 µs`, `45°`."""
    return f"{value:.4g}{'' if unit in ('', '°') else ' '}{unit}"


def choose_power_of_ten(largest: float) -> tuple[float, str]:
    """Return a divisor for values up to `largest`, and its text for an axis label.

    The text is mathematical text of Matplotlib with a trailing space: "$10^{6}$ ". It is "" for the divisor 1.
    """
    if not np.isfinite(largest) or abs(largest) < MAX_PLAIN:
        return 1.0, ""
    # A power of 1000 is used from two thirds of it on: 0.7 · 10⁶, not 700 · 10³.
    power = int(3 * np.floor(np.log10(abs(largest) * 1.5) / 3))
    return 10.0**power, f"$10^{{{power}}}$ "


def add_legend(figure: Figure, handles: list, labels: list[str], columns: int) -> None:
    """Add a legend above the axes, where it cannot cover data; `labels` are the texts of the `handles` (artists)."""
    figure.legend(handles, labels, loc="outside upper center", ncols=columns, handlelength=3.2, columnspacing=1.6)


def save_drawing(drawing: Drawing, folder: Path, name: str) -> None:
    """Write `<name>.svg` and `<name>.png` into a folder; each file is written completely or not at all."""
    # Without date and version of the software, equal figures give equal files.
    for suffix in FORMATS:
        stream = io.BytesIO()
        metadata = {"Date": None, "Creator": None} if suffix == "svg" else {"Software": None}
        drawing.figure.savefig(stream, format=suffix, metadata=metadata)
        with store.write_with_sidecar(folder / f"{name}.{suffix}") as scratch:
            scratch.write_bytes(stream.getvalue())
