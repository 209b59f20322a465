"""One measured spot, its simulation, and what is left: the picture that says what this is about."""

import numpy as np

from spotcheck.metrics.crop_metrics import shift_image
from spotcheck.report.figures import style
from spotcheck.report.figures.entry import PAIR, Category, Entry
from spotcheck.report.figures.frames_of import example
from spotcheck.report.figures.images import describe, half_side
from spotcheck.report.figures.results import Results


def draw(results: Results) -> style.Drawing:
    """Measured and simulated frame of the longest exposure, their difference, and the profiles along a row."""
    found = example(results, describe)
    half = half_side(found)
    at, other = found.measured_spot, found.simulated_spot
    moved = shift_image(found.simulated, at.row - other.row, at.column - other.column)
    difference = found.measured - moved
    highest = float(max(np.nanmax(found.measured), np.nanmax(moved)))
    figure = style.new(2.5, 1.45 * style.WIDTH)
    panels = figure.subplots(1, 4, width_ratios=(1, 1, 1, 1.15))
    reach = (-at.column, found.measured.shape[1] - at.column, found.measured.shape[0] - at.row, -at.row)
    for ax, image, title, low, colours in (
        (panels[0], found.measured, "measured", 0.0, style.IMAGE_MAP),
        (panels[1], moved, "simulated", 0.0, style.IMAGE_MAP),
        (panels[2], difference, "measured − simulated", -highest, style.DIVERGING_MAP),
    ):
        ax.imshow(image, cmap=colours, vmin=low, vmax=highest, extent=reach)
        ax.set(title=title, xlim=(-half, half), ylim=(half, -half), xlabel="x / px")
        ax.grid(False)
    panels[0].set_ylabel("y / px")
    row = round(at.row)
    x = np.arange(found.measured.shape[1]) - at.column
    panels[3].plot(x, found.measured[row], color=style.MEASURED, label="measured")
    panels[3].plot(x, moved[row], color=style.SIMULATED, linestyle=(0, (5, 2)), label="simulated")
    panels[3].set(title="the row through the centre", xlim=(-half, half), xlabel="x / px", ylabel="reading / DN")
    return style.Drawing(
        figure,
        f"One frame ({found.name}), one random frame of the simulation laid on its fitted centre, and their difference;"
        f" readings on one scale up to {highest:.0f} DN, the difference on ± {highest:.0f} DN. Right: the row through"
        " the fitted centre, blue and solid as measured, orange and dashed as simulated.",
    )


FIGURES = (Entry("overview", "At a glance", Category.GLANCE, PAIR, draw),)
