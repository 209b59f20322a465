"""Overview: one measured spot, a frame simulated by the declared model, and their difference."""

import numpy as np
from matplotlib.colors import Normalize

from spotcheck.metrics.crop_metrics import shift_image
from spotcheck.report.figures import style
from spotcheck.report.figures.entry import PAIR, Category, Entry
from spotcheck.report.figures.frame_pairs import find_pair
from spotcheck.report.figures.images import half_side
from spotcheck.report.figures.results import Results


def draw_overview(results: Results) -> style.Drawing:
    """Draw measured and simulated frame of the longest exposure, their difference, and profiles along a row."""
    pair = find_pair(results)
    (measured, spot), (simulated, simulated_spot) = pair.measured, pair.simulated
    # The simulated image is shifted so that both fitted centres coincide.
    registered = shift_image(simulated, spot.row - simulated_spot.row, spot.column - simulated_spot.column)
    half = half_side(pair)
    highest = float(max(np.nanmax(measured), np.nanmax(registered)))
    reading_norm, difference_norm = Normalize(0.0, highest), Normalize(-highest, highest)
    figure = style.new_figure(2.5, 1.45 * style.WIDTH)
    panels = figure.subplots(1, 4, width_ratios=(1, 1, 1, 1.15))
    extent = style.centred_extent(measured.shape, spot.row, spot.column)
    style.show_image(panels[0], measured, style.IMAGE_MAP, reading_norm, extent, title="measured")
    style.show_image(panels[1], registered, style.IMAGE_MAP, reading_norm, extent, title="simulated")
    difference, title = measured - registered, "measured − simulated"
    style.show_image(panels[2], difference, style.DIVERGING_MAP, difference_norm, extent, title=title)
    for ax in panels[:3]:
        ax.set(xlabel="x / px", xlim=(-half, half), ylim=(half, -half))
    panels[0].set_ylabel("y / px")
    row, x = round(spot.row), np.arange(measured.shape[1]) - spot.column
    panels[3].plot(x, measured[row], color=style.MEASURED, label="measured")
    panels[3].plot(x, registered[row], color=style.SIMULATED, linestyle=style.DASHED, label="simulated")
    panels[3].set(title="the row through the centre", xlim=(-half, half), xlabel="x / px", ylabel="reading / DN")
    return style.Drawing(
        figure,
        f"One frame ({pair.name}), one random simulated frame registered on its fitted centre, and their difference;"
        f" readings on one scale up to {highest:.0f} DN, the difference on ± {highest:.0f} DN. Right: the row through"
        " the fitted centre, blue and solid as measured, orange and dashed as simulated.",
    )


FIGURES = (Entry("overview", "At a glance", Category.GLANCE, PAIR, draw_overview),)
