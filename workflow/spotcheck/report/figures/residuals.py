"""What is left when the registered simulation is taken from the measured frames: as images and as radial profiles."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patches import Ellipse

from spotcheck.io import store
from spotcheck.io.plus_minus import two_digits
from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.frames_of import Spot, residual_frames
from spotcheck.report.figures.results import Results, Unavailable

MOST_PANELS = 48
VIEW = 3.0  # half the side of a panel, in fitted widths
COLOUR_ENDS = 99.8  # percentile of the absolute residual at which the colours end


class Panel(NamedTuple):
    """Mean residual [y, x] in DN of one condition, the spots that it was averaged over, and the condition in words."""

    residual: np.ndarray
    spots: list[Spot]
    words: tuple[str, ...]


def panels(results: Results) -> list[list[Panel | None]]:
    """Panels [row over the abscissa's dimension][column over the exposure], None where no frame is usable."""
    crops = results.get("crops")
    design = series.design_of(crops, store.grid_dims(crops))
    if design.across == "repeat":  # what is averaged over anyway
        return _some([[_panel_of(results, {})]])
    columns = crops.sizes[design.lines] if design.lines else 1
    count, most = crops.sizes[design.across], max(1, MOST_PANELS // columns)
    rows = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
    out = []
    for i in rows:
        places = [{design.across: int(i)} | ({design.lines: j} if design.lines else {}) for j in range(columns)]
        out.append([_panel_of(results, fixed) for fixed in places])
    return _some(out)


def _some(found: list[list[Panel | None]]) -> list[list[Panel | None]]:
    """The panels, or `Unavailable` where none has a frame."""
    if not any(panel for line in found for panel in line):
        raise Unavailable("no frame has a fitted spot")
    return found


def _panel_of(results: Results, fixed: dict[str, int]) -> Panel | None:
    """Mean residual over every usable frame under the fixed indices."""
    crops = results.get("crops")
    shape = crops.sizes["y"], crops.sizes["x"]
    total, number, spots = np.zeros(shape), np.zeros(shape), []
    for image, model, found in residual_frames(results, fixed):
        difference = image - model
        good = np.isfinite(difference)
        total += np.where(good, difference, 0.0)
        number += good
        spots.append(found)
    if not spots:
        return None
    words = tuple(filter(None, (series.value_text(crops, dim, k) for dim, k in fixed.items())))
    return Panel(total / np.where(number, number, np.nan), spots, words)


def images(results: Results) -> style.Drawing:
    """Mean residual image of every condition on one diverging scale, with the spot's ellipses."""
    found = panels(results)
    flat = [panel for line in found for panel in line]
    columns = len(found[0]) if len(found[0]) > 1 else min(3, len(flat))
    rows = -(-len(flat) // columns)
    known = [panel for panel in flat if panel]
    end = max(float(np.nanpercentile(np.abs(p.residual), COLOUR_ENDS)) for p in known)
    widest = max(float(np.mean([s.major for s in p.spots])) for p in known)
    half = min(VIEW * widest, min(known[0].residual.shape) / 2)
    side = (style.WIDTH - 1.1) / columns
    figure = style.new_tight(min(side, 1.75 if rows > 1 else 3.0) * rows + 0.7)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for ax, panel in zip(axes.ravel(), [*flat, *[None] * (rows * columns - len(flat))], strict=True):
        ax.grid(False)
        if panel is None:
            ax.set_axis_off()
        else:
            _draw(ax, panel, end, half)
            if len(found[0]) == 1:
                ax.set_title(", ".join(panel.words), fontsize=8.5, pad=3)
    if len(found[0]) > 1:
        _head(axes, found)
    mapped = ScalarMappable(Normalize(-end, end), style.DIVERGING_MAP)
    shown = np.array([[ax.axison for ax in row] for row in axes])
    for ax in axes[-1][shown[-1]][shown[-1].sum() // 2 :][:1]:
        ax.set_xlabel("x from the fitted centre / px")
    for ax in axes[:, 0][shown[:, 0]][shown[:, 0].sum() // 2 :][:1]:
        ax.set_ylabel("y from the fitted centre / px")
    figure.colorbar(
        mapped, ax=list(axes.ravel()), label="measured − simulated / DN", extend="both", shrink=0.7, aspect=30
    )
    counts = [len(p.spots) for p in known]
    frames = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
    caption = (
        "Measured less simulated frame: the simulated mean image placed on the measured fitted centre, light-centred"
        f" crops, averaged over {frames} frame{'s' if max(counts) > 1 else ''} a panel ({sum(counts)} in all). Red:"
        " brighter than the model; blue: fainter. One scale for all"
        f" panels, its colours ending at ±{two_digits(end)} DN. Ellipses: 1 σ (solid) and 2 σ (dashed) of the fitted"
        " Gaussian."
    )
    return style.Drawing(figure, caption)


def _head(axes: np.ndarray, found: list[list[Panel | None]]) -> None:
    """Name the columns above the first row and the rows right of the last column."""
    for k, column in enumerate(zip(*found, strict=True)):
        words = next((p.words for p in column if p), ("",))
        place = {"transform": axes[0, k].transAxes, "ha": "center", "va": "bottom", "fontsize": 8.5}
        axes[0, k].text(0.5, 1.03, words[-1], **place)
    for k, row in enumerate(found):
        words = next((p.words for p in row if p), ("",))
        place = {"transform": axes[k, -1].transAxes, "rotation": -90, "ha": "left", "va": "center", "fontsize": 8.5}
        axes[k, -1].text(1.03, 0.5, words[0], **place)


def _draw(ax: Axes, panel: Panel, end: float, half: float) -> None:
    """One panel: the residual, and the ellipses of the mean covariance of its spots."""
    row = float(np.mean([s.row for s in panel.spots]))
    column = float(np.mean([s.column for s in panel.spots]))
    high, wide = panel.residual.shape
    extent = (-0.5 - column, wide - 0.5 - column, high - 0.5 - row, -0.5 - row)
    ax.imshow(panel.residual, cmap=style.DIVERGING_MAP, vmin=-end, vmax=end, extent=extent)
    power, turn = np.linalg.eigh(np.mean([s.covariance for s in panel.spots], axis=0))
    direction = np.degrees(np.arctan2(turn[1, 1], turn[0, 1]))
    for n, dashes in ((1, (0, (1, 0))), (2, (0, (4, 2)))):
        size = 2 * n * np.sqrt(power)
        looks = {"fill": False, "edgecolor": "0.1", "linewidth": 0.8, "linestyle": dashes}
        ax.add_patch(Ellipse((0, 0), size[1], size[0], angle=direction, **looks))
    ax.set(xlim=(-half, half), ylim=(half, -half))


FIGURES = (Entry("residuals", "Residual images", Category.RESIDUALS, ("crops", "fits", "simulated"), images),)
