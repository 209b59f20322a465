"""What is left when the registered simulation is taken from the measured frames: as images and as radial profiles."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from spotcheck import store
from spotcheck.figures import series, style
from spotcheck.figures.frames_of import Spot, crop, expected, spot
from spotcheck.figures.results import Results, Unavailable

MOST_PANELS = 48
VIEW = 4.5  # half the side of a panel, in fitted widths
COLOUR_ENDS = 99.8  # percentile of the absolute residual at which the colours end


class Panel(NamedTuple):
    """Mean residual [y, x] in DN of one condition, the spots that it was averaged over, and its name."""

    residual: np.ndarray
    spots: list[Spot]
    name: str


def _indices(results: Results) -> tuple[series.Design, tuple[str, ...], dict[str, int]]:
    crops = results.get("crops")
    dims = store.grid_dims(crops)
    return series.design_of(crops, dims), dims, {d: crops.sizes[d] for d in dims}


def _residuals(results: Results, fixed: dict[str, int], dims: tuple[str, ...], sizes: dict[str, int]):
    """Residual image, measured image, expected image and spot of every usable frame under the fixed indices."""
    crops, fits = results.get("crops"), results.get("fits")
    free = [d for d in dims if d not in fixed]
    for at in np.ndindex(*(sizes[d] for d in free)):
        index = fixed | dict(zip(free, at, strict=True))
        image, found = crop(crops, index), spot(crops, fits, index)
        if image is not None and found is not None:
            yield image, expected(results, index, found), found


def panels(results: Results) -> tuple[list[list[Panel | None]], series.Design]:
    """Panels [row over the abscissa's dimension][column over the exposure], None where no frame is usable."""
    design, dims, sizes = _indices(results)
    crops = results.get("crops")
    columns = design.lines
    count = sizes[design.across]
    rows = np.arange(count)
    most = max(1, MOST_PANELS // (sizes[columns] if columns else 1))
    if count > most:
        rows = np.unique(np.linspace(0, count - 1, most).round().astype(int))
    names = {d: series.coordinate(crops, d) for d in (design.across, columns) if d}
    out: list[list[Panel | None]] = []
    for i in rows:
        line: list[Panel | None] = []
        for j in range(sizes[columns] if columns else 1):
            fixed = {design.across: int(i)} | ({columns: j} if columns else {})
            total, number, spots = 0.0, 0.0, []
            for image, model, found in _residuals(results, fixed, dims, sizes):
                difference = image - model
                good = np.isfinite(difference)
                total = total + np.where(good, difference, 0.0)
                number = number + good
                spots.append(found)
            words = [style.number(names[d][0][k], names[d][1]) for d, k in fixed.items() if d in crops.coords]
            line.append(Panel(total / np.where(number, number, np.nan), spots, ", ".join(words)) if spots else None)
        out.append(line)
    if not any(panel for line in out for panel in line):
        raise Unavailable("no frame has a fitted spot")
    return out, design


def images(results: Results) -> style.Drawing:
    """Mean residual image of every condition on one diverging scale, with the spot's ellipses."""
    found, design = panels(results)
    flat = [panel for line in found for panel in line]
    columns = len(found[0]) if len(found[0]) > 1 else min(3, len(flat))
    rows = -(-len(flat) // columns)
    known = [panel for panel in flat if panel]
    end = max(float(np.nanpercentile(np.abs(p.residual), COLOUR_ENDS)) for p in known)
    widest = max(s.major for p in known for s in p.spots)
    half = min(VIEW * widest, min(known[0].residual.shape) / 2)
    side = (style.WIDTH - 1.1) / columns
    figure = style.new(min(side, 2.0) * rows + 0.7)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    shown = None
    for ax, panel in zip(axes.ravel(), [*flat, *[None] * (rows * columns - len(flat))], strict=True):
        ax.grid(False)
        if panel is None:
            ax.set_axis_off()
            continue
        shown = _panel(ax, panel, end, half)
    figure.supxlabel("x from the fitted centre / px", fontsize=9)
    figure.supylabel("y from the fitted centre / px", fontsize=9)
    figure.colorbar(shown, ax=list(axes.ravel()), label="measured − simulated / DN", extend="both", shrink=0.8)
    counts = [len(p.spots) for p in known]
    frames = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
    caption = (
        "Measured less simulated frame: the simulated mean image placed on the measured fitted centre, light-centred"
        f" crops, averaged over {frames} frame{'s' if max(counts) > 1 else ''} a panel ({sum(counts)} in all). Red:"
        " brighter than the model; blue: fainter. One scale for all"
        f" panels, its colours ending at ±{end:.3g} DN. Ellipses: 1 σ (solid) and 2 σ (dashed) of the fitted Gaussian."
    )
    return style.Drawing(figure, caption)


def _panel(ax: Axes, panel: Panel, end: float, half: float):
    row = float(np.mean([s.row for s in panel.spots]))
    column = float(np.mean([s.column for s in panel.spots]))
    high, wide = panel.residual.shape
    extent = (-0.5 - column, wide - 0.5 - column, high - 0.5 - row, -0.5 - row)
    shown = ax.imshow(panel.residual, cmap=style.DIVERGING_MAP, vmin=-end, vmax=end, extent=extent)
    power, turn = np.linalg.eigh(np.mean([s.covariance for s in panel.spots], axis=0))
    direction = np.degrees(np.arctan2(turn[1, 1], turn[0, 1]))
    for n, dashes in ((1, "solid"), (2, (0, (4, 2)))):
        size = 2 * n * np.sqrt(power)
        ellipse = Ellipse((0, 0), size[1], size[0], angle=direction, fill=False, edgecolor="0.1", linewidth=0.8)
        ellipse.set_linestyle(dashes)
        ax.add_patch(ellipse)
    ax.set(xlim=(-half, half), ylim=(half, -half))
    ax.set_title(panel.name, fontsize=8.5, pad=3)
    return shown
