"""Residual images: measured frame less mean simulation, averaged over the frames of each condition.

The simulation is shifted so that its centre lies on the fitted centre of each measured spot.
"""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patches import Ellipse

from spotcheck.io import store
from spotcheck.io.number_text import two_digits
from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import FRAMES, Category, Entry
from spotcheck.report.figures.frame_pairs import FittedSpot, iterate_frames
from spotcheck.report.figures.results import Results, Unavailable

# Largest number of panels, and of columns if panels do not form a table.
MAX_PANELS, MAX_COLUMNS = 48, 3
# Half the side of a panel, in the largest fitted width of all conditions.
HALF_SIDE_WIDTHS = 3.0
# Percentile of the absolute residual at which the colours end.
COLOUR_PERCENTILE = 99.8
SMALL = 8.5  # font size of the names of rows and columns [pt]


class Panel(NamedTuple):
    """Mean residual of one condition."""

    residual: np.ndarray  # measured less simulated reading [y, x] in DN; NaN where all frames are masked
    spots: list[FittedSpot]  # spots of the averaged frames
    names: tuple[str, ...]  # value of the abscissa and exposure as text, without those that were not recorded


def average_residuals(results: Results) -> list[list[Panel | None]]:
    """Return a table of panels [row][column]; each is averaged over all dimensions of the grid but two.

    Rows are the values of the first of angle, declared conditions and exposure that has more than one value. Columns
    are the exposures unless these are the rows. Without any such dimension there is one panel. A panel is None if its
    condition has no usable frame. Raises `Unavailable` if no condition has one.
    """
    crops = results.get("crops")
    axes = series.choose_axes(crops, store.grid_dims(crops))
    if axes.abscissa == "repeat":
        panels = [[_average_residual(results, {})]]
    else:
        columns = [{axes.lines: k} for k in range(crops.sizes[axes.lines])] if axes.lines else [{}]
        rows = series.pick_evenly(crops.sizes[axes.abscissa], max(1, MAX_PANELS // len(columns)))
        panels = [
            [_average_residual(results, {axes.abscissa: int(row)} | column) for column in columns] for row in rows
        ]
    if not any(panel for row in panels for panel in row):
        raise Unavailable("no frame has a fitted spot")
    return panels


def _average_residual(results: Results, index: dict[str, int]) -> Panel | None:
    """Return the mean residual of all usable frames at an index of some dimensions of the grid; None without one."""
    crops = results.get("crops")
    shape = crops.sizes["y"], crops.sizes["x"]
    # Sum of the residuals, and number of frames with a finite one, of each pixel.
    total, count, spots = np.zeros(shape), np.zeros(shape), []
    for frame, predicted in iterate_frames(results, index):
        residual = frame.image - predicted
        is_finite = np.isfinite(residual)
        total += np.where(is_finite, residual, 0.0)
        count += is_finite
        spots.append(frame.spot)
    if not spots:
        return None
    names = tuple(filter(None, (series.value_text(crops, dim, k) for dim, k in index.items())))
    return Panel(total / np.where(count, count, np.nan), spots, names)


def draw_residuals(results: Results) -> style.Drawing:
    """Draw the mean residual image of each condition on one diverging scale, with ellipses of the fitted Gaussian.

    Raises `Unavailable` if no frame is usable.
    """
    table = average_residuals(results)
    panels = [panel for row in table for panel in row]
    # A single column of conditions is wrapped into rows.
    is_table = len(table[0]) > 1
    columns = len(table[0]) if is_table else min(MAX_COLUMNS, len(panels))
    rows = -(-len(panels) // columns)  # rounded up
    usable_panels = [panel for panel in panels if panel]
    limit = max(float(np.nanpercentile(np.abs(panel.residual), COLOUR_PERCENTILE)) for panel in usable_panels)
    largest_width = max(float(np.mean([spot.major for spot in panel.spots])) for panel in usable_panels)
    half_side = min(HALF_SIDE_WIDTHS * largest_width, min(usable_panels[0].residual.shape) / 2)
    norm = Normalize(-limit, limit)
    side = (style.WIDTH - 1.1) / columns
    figure = style.new_figure(min(side, 1.75 if rows > 1 else 3.0) * rows + 0.7, layout="compressed")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for k, ax in enumerate(axes.ravel()):
        panel = panels[k] if k < len(panels) else None
        if panel is None:
            ax.set_axis_off()
        else:
            _draw_panel(ax, panel, norm, half_side)
            if not is_table:
                ax.set_title(", ".join(panel.names), fontsize=SMALL, pad=3)
    if is_table:
        _name_rows_and_columns(axes, table)
    # One label in the middle of each edge.
    for edge, axis in ((axes[-1], "x"), (axes[:, 0], "y")):
        if visible := [ax for ax in edge if ax.axison]:
            visible[len(visible) // 2].set(**{f"{axis}label": f"{axis} from the fitted centre / px"})
    bar: dict[str, Any] = {"label": "measured − simulated / DN", "extend": "both", "shrink": 0.7, "aspect": 30}
    figure.colorbar(ScalarMappable(norm, style.DIVERGING_MAP), ax=list(axes.ravel()), **bar)
    counts = [len(panel.spots) for panel in usable_panels]
    caption = (
        "Measured less simulated frame: the simulated mean image centred on the measured fitted centre, light-centred"
        f" crops, averaged over {series.range_text(counts)} frame{'s' if max(counts) > 1 else ''} a panel"
        f" ({sum(counts)} in all). Red: brighter than the model; blue: fainter. One scale for all panels, its colours"
        f" ending at ±{two_digits(limit)} DN. Ellipses: 1 σ (solid) and 2 σ (dashed) of the fitted Gaussian."
    )
    return style.Drawing(figure, caption)


def _name_rows_and_columns(axes: np.ndarray, table: list[list[Panel | None]]) -> None:
    """Write the names of the columns above the first row, and those of the rows beside the last column.

    A name is that of the first panel with frames in its row or column; "" if there is none. `axes` and `table` are
    [row][column].
    """
    for ax, column in zip(axes[0], zip(*table, strict=True), strict=True):
        name = next((panel.names[-1] for panel in column if panel and panel.names), "")
        ax.text(0.5, 1.03, name, transform=ax.transAxes, ha="center", va="bottom", fontsize=SMALL)
    for ax, row in zip(axes[:, -1], table, strict=True):
        name = next((panel.names[0] for panel in row if panel and panel.names), "")
        ax.text(1.03, 0.5, name, transform=ax.transAxes, rotation=-90, ha="left", va="center", fontsize=SMALL)


def _draw_panel(ax: Axes, panel: Panel, norm: Normalize, half_side: float) -> None:
    """Draw a residual around the mean centre of its spots, with the 1 σ and 2 σ ellipses of their mean covariance.

    `half_side` is half the side of the shown part [px].
    """
    row, column = np.mean([(spot.row, spot.column) for spot in panel.spots], axis=0)
    rows, columns = panel.residual.shape
    # Edges of the image; the centres of pixels are at integers.
    extent = (-0.5 - column, columns - 0.5 - column, rows - 0.5 - row, -0.5 - row)
    style.show_image(ax, panel.residual, style.DIVERGING_MAP, norm, extent)
    variances, directions = np.linalg.eigh(np.mean([spot.covariance for spot in panel.spots], axis=0))
    angle = np.degrees(np.arctan2(directions[1, 1], directions[0, 1]))
    for factor, dashes in ((1, (0, (1, 0))), (2, (0, (4, 2)))):
        short, long = 2 * factor * np.sqrt(variances)  # whole axes of the ellipse [px]
        look = {"fill": False, "edgecolor": "0.1", "linewidth": 0.8, "linestyle": dashes}
        ax.add_patch(Ellipse((0, 0), long, short, angle=angle, **look))
    ax.set(xlim=(-half_side, half_side), ylim=(half_side, -half_side))


FIGURES = (Entry("residuals", "Residual images", Category.RESIDUALS, FRAMES, draw_residuals),)
