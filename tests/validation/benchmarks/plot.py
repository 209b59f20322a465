"""One picture of the race: time of a fit against its error, and time of a simulated frame."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from spotcheck.report.figures import style
from tests.validation.benchmarks.table import Point

# Okabe and Ito's colours, far apart in lightness too; each kind has its own marker.
LOOKS = {
    "ours": ("#D55E00", "*"),
    "likelihood": ("#0072B2", "o"),
    "least squares": ("#009E73", "s"),
    "moments": ("#CC79A7", "^"),
    "simulator": ("#0072B2", "o"),
}
# Labels stand apart by this factor in time, their rows at this error.
APART = 1.5
BELOW, ABOVE = 0.62, 2.6
# Between the methods that reach the bound and those at the optimum of least squares; and up to the latter's crowd.
EFFICIENT, CROWD = 1.1, 2.5
# Points this close in error may cover each other's labels.
NEAR = 3.0


def _apart(times: Sequence[float]) -> np.ndarray:
    """Places for labels of ascending times, each at least a factor `APART` from the next, as near as possible."""
    step = np.log(APART)
    wanted = np.log(times) - step * np.arange(len(times))
    # Isotonic regression: what would overlap is spread about its mean.
    blocks: list[list[float]] = []
    for value in wanted:
        blocks.append([value])
        while len(blocks) > 1 and np.mean(blocks[-2]) > np.mean(blocks[-1]):
            blocks[-2:] = [blocks[-2] + blocks[-1]]
    level = [np.mean(block) for block in blocks for _ in block]
    return np.exp(np.array(level) + step * np.arange(len(times)))


def _mark(axes: Axes, point: Point, y: float) -> None:
    colour, marker = LOOKS[point.kind]
    size = 11 if marker == "*" else 5.5
    axes.plot([point.low, point.high], [y, y], color=colour, linewidth=1.2, solid_capstyle="butt")
    axes.plot(point.middle, y, marker, color=colour, markersize=size, markeredgecolor="white", markeredgewidth=0.6)


def _labels(axes: Axes, points: Sequence[Point], above: bool) -> None:
    """Turned labels over or under a row of points, joined to them by thin lines."""
    ordered = sorted(points, key=lambda p: p.middle)
    row = ABOVE if above else BELOW
    for point, x in zip(ordered, _apart([p.middle for p in ordered]), strict=True):
        colour = LOOKS[point.kind][0]
        axes.plot([point.middle, x], [point.rms, row], color=colour, linewidth=0.6, alpha=0.7)
        axes.annotate(
            point.name,
            (x, row),
            (0, 2 if above else -2),
            textcoords="offset points",
            rotation=30 if above else -30,
            rotation_mode="anchor",
            ha="left",
            va="bottom" if above else "top",
            fontsize=8.5,
            color=colour,
            weight="bold" if point.kind == "ours" else "normal",
        )


def _outliers(axes: Axes, points: Sequence[Point]) -> None:
    """Labels over points that stand alone; of two neighbours, to either side."""
    for point in points:
        beside = [p for p in points if p is not point and 1 / NEAR < p.rms / point.rms < NEAR]
        side = "center" if not beside else "right" if beside[0].middle > point.middle else "left"
        at, colour = (point.middle, point.rms), LOOKS[point.kind][0]
        axes.annotate(point.name, at, (0, 6), textcoords="offset points", ha=side, fontsize=8.5, color=colour)


def _fits(axes: Axes, points: Sequence[Point]) -> None:
    for point in points:
        _mark(axes, point, point.rms)
    _labels(axes, [p for p in points if p.rms <= EFFICIENT], above=False)
    _labels(axes, [p for p in points if EFFICIENT < p.rms <= CROWD], above=True)
    _outliers(axes, [p for p in points if p.rms > CROWD])
    axes.axhline(1.0, color="0.4", linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
    axes.set(xscale="log", yscale="log", xlabel="time of a fit / ms", ylabel="rms error of the widths / bound")
    axes.set_xlim(0.45, 450)
    axes.set_ylim(0.07, 1000)
    axes.set_yticks([1, 10, 100, 1000], ["1", "10", "100", "1000"])
    axes.tick_params(axis="y", which="minor", left=False)
    axes.set_xticks([1, 10, 100], ["1", "10", "100"])
    for kind, (colour, marker) in LOOKS.items():
        if any(p.kind == kind for p in points):
            axes.plot([], [], marker, color=colour, label=kind, markersize=9 if marker == "*" else 5.5)
    axes.legend(loc="upper left", ncols=2)


def _frames(axes: Axes, points: Sequence[Point]) -> None:
    ordered = sorted(points, key=lambda p: -p.middle)
    for row, point in enumerate(ordered):
        _mark(axes, point, row)
        shown = f"{point.middle:.{1 if point.middle >= 1 else 2}f} ms"
        axes.annotate(shown, (point.high, row), (6, 0), textcoords="offset points", va="center")
    axes.set(xscale="log", xlabel="time of a simulated frame / ms")
    axes.set_yticks(range(len(ordered)), [p.name for p in ordered])
    axes.set_ylim(-0.7, len(ordered) - 0.3)
    axes.set_xlim(min(p.low for p in points) / 1.5, max(p.high for p in points) * 2)
    ticks = [t for t in (0.1, 1, 10, 100) if axes.get_xlim()[0] <= t <= axes.get_xlim()[1]]
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])


def draw(points: Sequence[Point], folder: Path) -> None:
    """Write `peers.png` and `peers.svg` of whatever was measured."""
    panels = [
        (name, draw) for name, draw in (("fit", _fits), ("frame", _frames)) if any(p.panel == name for p in points)
    ]
    if not panels:
        return
    heights = [{"fit": 4.4, "frame": 2.4}[name] for name, _ in panels]
    with style.house_style():
        figure = style.new_figure(sum(heights))
        axes = figure.subplots(len(panels), 1, height_ratios=heights, squeeze=False)[:, 0]
        for (name, fill), each in zip(panels, axes, strict=True):
            fill(each, [p for p in points if p.panel == name and np.isfinite(p.middle)])
        style.save_drawing(style.Drawing(figure, ""), folder, "peers")
