"""House style of the figures: sizes, colours, units on axes, and files that are equal byte for byte."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure

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
# Luminance grows along both maps, so that they survive grey printing and every colour blindness.
IMAGE_MAP, DIVERGING_MAP = "magma", "RdBu_r"
# Two colours apart in hue and in lightness (Okabe and Ito): measured and simulated where only these two meet.
MEASURED, SIMULATED, ACCENT = "#0072B2", "#D55E00", "#009E73"
LUMA = np.array([0.299, 0.587, 0.114])  # what a grey printer makes of red, green and blue
MARKERS = "osD^vPX*"
DASHES: tuple[tuple[float, ...], ...] = (
    (6, 2),
    (6, 2, 1.2, 2),
    (1.2, 1.6),
    (3, 1.5),
    (9, 2, 3, 2),
    (6, 1.5, 1, 1, 1, 1.5),
)
PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
NAMES = {"angle": "fibre orientation γ", "exposure": "exposure time $t$", "repeat": "repeat"}


class Drawing(NamedTuple):
    """A figure and what stands under it."""

    figure: Figure
    caption: str


class Line(NamedTuple):
    """How one series looks: colour, marker, and the dashes of its simulated counterpart."""

    colour: Any
    marker: str
    dashes: tuple[float, ...]


class Scale(NamedTuple):
    """Factor from SI to the printed unit, and that unit."""

    factor: float
    unit: str


@contextmanager
def applied() -> Iterator[None]:
    """The house style, whatever the user's matplotlibrc says."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(RC)
        yield


def new(height: float, width: float = WIDTH) -> Figure:
    """An empty figure [inch] whose parts make room for each other."""
    return Figure(figsize=(width, height), layout="constrained")


def new_tight(height: float) -> Figure:
    """An empty figure [inch] for images in a grid: their fixed shape leaves no gaps between them."""
    return Figure(figsize=(WIDTH, height), layout="compressed")


def lines(count: int) -> list[Line]:
    """Looks of `count` ordered series: from dark to light in equal steps of grey, each with its marker and dashes."""
    shades = matplotlib.colormaps["viridis"](np.linspace(0.02, 0.80, 200))
    grey = shades[:, :3] @ LUMA
    steps = np.linspace(grey[0], grey[-1], count) if count > 1 else np.array([0.36])
    colours = shades[np.searchsorted(grey, steps).clip(0, len(shades) - 1)]
    return [Line(c, MARKERS[k % len(MARKERS)], DASHES[k % len(DASHES)]) for k, c in enumerate(colours)]


def scale(values: Any, unit: str) -> Scale:
    """Prefix of an SI unit under which the smallest value is at least 1; degrees and pure numbers keep theirs."""
    if unit in ("degree", "1", "pixel", "K"):
        return Scale(1.0, {"degree": "°", "pixel": "px", "1": ""}.get(unit, unit))
    size = np.abs(np.asarray(values, float))
    size = size[np.isfinite(size) & (size > 0)]
    power = 0 if not size.size else int(np.clip(3 * np.floor(np.log10(size.min() * (1 + 1e-9)) / 3), -12, 6))
    return Scale(10.0**-power, PREFIXES[power] + unit)


def label(name: str, unit: str) -> str:
    """Text of an axis: quantity / unit."""
    return f"{name} / {unit}" if unit else name


def axis_name(dim: str) -> str:
    """What a dimension of the grid is called on an axis: a condition loses its unit's suffix."""
    return NAMES.get(dim, dim.rsplit("_", 1)[0].replace("_", " ") if "_" in dim else dim)


def number(value: float, unit: str) -> str:
    """A value with its unit, without trailing zeros: `500 µs`, `45°`."""
    return f"{value:.4g}{'' if unit in ('', '°') else ' '}{unit}"


def tens(largest: float) -> tuple[float, str]:
    """Divisor and text for large plain numbers: (1e6, "10⁶ ") for millions, (1, "") below 10 000."""
    if not np.isfinite(largest) or abs(largest) < 1e4:
        return 1.0, ""
    power = int(3 * np.floor(np.log10(abs(largest) * 1.5) / 3))
    return 10.0**power, f"$10^{{{power}}}$ "


def legend_above(figure: Figure, handles: list, labels: list[str], columns: int) -> None:
    """A legend over the axes, where it cannot cover data."""
    figure.legend(handles, labels, loc="outside upper center", ncols=columns, handlelength=3.2, columnspacing=1.6)


def save(drawing: Drawing, folder: Path, name: str) -> None:
    """Write `<name>.svg` and `<name>.png`, each whole or not at all, without date or version inside."""
    for kind in FORMATS:
        stream = io.BytesIO()
        metadata = {"Date": None, "Creator": None} if kind == "svg" else {"Software": None}
        drawing.figure.savefig(stream, format=kind, metadata=metadata)
        with store.write_with_sidecar(folder / f"{name}.{kind}") as scratch:
            scratch.write_bytes(stream.getvalue())
