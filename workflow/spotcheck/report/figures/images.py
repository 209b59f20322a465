"""Fig. 8: a simulated and a measured frame, and their superposition.

The declared model is that of the instrument file. The extended model also has the effects that the verdict added. A
crop is the square part of a frame around its spot.
"""

from functools import partial

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.patches import Rectangle
from scipy import ndimage

from spotcheck.report.figures import style
from spotcheck.report.figures.entry import EXTENDED, PAIR, Category, Entry
from spotcheck.report.figures.frame_pairs import FramePair, find_pair
from spotcheck.report.figures.results import Results, Unavailable

# Half the side of the enlarged part of the crop, in fitted widths, and its smallest value [px].
ENLARGED_WIDTHS, MIN_HALF_SIDE = 3.5, 8
# A part that is wider than this fraction of the crop is not enlarged.
MAX_ENLARGED_FRACTION = 0.75
# Contour levels as fractions of the simulated maximum, and σ of the Gaussian filter that suppresses noise [px].
LEVELS = (0.2, 0.5, 0.8)
SMOOTH_PX = 1.5
# Start of the caption by the source of the frame, an argument of `draw_frame`.
SOURCE_TEXTS = {
    "Measured": "Measured frame",
    "Simulated": "Frame simulated by the declared model",
    "Extended": "Frame simulated by the extended model, with the effects of the verdict and a random site",
}


def _half_side(pair: FramePair) -> int:
    """Return half the side [px] of the part of the crop around both spots; it fits into the crop."""
    width = max(pair.measured.spot.major, pair.simulated.spot.major)
    return int(min(max(np.ceil(ENLARGED_WIDTHS * width), MIN_HALF_SIDE), min(pair.measured.image.shape) // 2 - 1))


def draw_frame(results: Results, source: str) -> style.Drawing:
    """Draw Fig. 8a (`source` "Simulated"), 8b ("Measured") or its extended counterpart ("Extended").

    The frame is one of the longest exposure. All figures have the same colour scale. The surroundings of the spot are
    enlarged if it is small. Raises `Unavailable` if there is no frame of the extended model.
    """
    pair = find_pair(results)
    frame = {"Measured": pair.measured, "Simulated": pair.simulated, "Extended": pair.extended}[source]
    if frame is None:
        raise Unavailable("the extended model has no frame with a fitted spot in this condition")
    image, spot = frame
    images = np.array([shown.image for shown in (pair.measured, pair.simulated, pair.extended) if shown])
    norm, half = Normalize(float(np.nanmin(images)), float(np.nanmax(images))), _half_side(pair)
    is_enlarged = half < MAX_ENLARGED_FRACTION * min(image.shape) / 2
    figure = style.new_figure(3.0 if is_enlarged else 4.2)
    panels = list(figure.subplots(1, 2)) if is_enlarged else [figure.add_subplot()]
    for ax in panels:
        artist = style.show_image(ax, image, style.IMAGE_MAP, norm)
        ax.set(xlabel="column of the crop / px", ylabel="row of the crop / px")
    if is_enlarged:
        left, top = round(spot.column) - half - 0.5, round(spot.row) - half - 0.5
        side = 2 * half + 1
        panels[0].add_patch(Rectangle((left, top), side, side, fill=False, edgecolor="white", linewidth=0.8))
        panels[1].set(xlim=(left, left + side), ylim=(top + side, top))
    figure.colorbar(artist, ax=panels, label="reading / DN", shrink=0.9, pad=0.02)
    caption = (
        f"{SOURCE_TEXTS[source]} ({pair.name}): the crop of {image.shape[1]} × {image.shape[0]} px centred on the light"
        f"{', and the marked part enlarged' if is_enlarged else ''}. Measured and simulated frames share one"
        " colour scale."
    )
    return style.Drawing(figure, caption)


def draw_superposition(results: Results) -> style.Drawing:
    """Draw Fig. 8c: contours of measured and simulated frames, and profiles through their fitted centres."""
    pair = find_pair(results)
    half = _half_side(pair)
    figure = style.new_figure(3.4)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.05, 1.0))
    overlay = figure.add_subplot(grid[:, 0])
    profiles = [figure.add_subplot(grid[k, 1]) for k in range(2)]
    # (colour, line style) by name in the legend, in the order of `frames`.
    looks = {"measured": (style.MEASURED, "solid"), "simulated": (style.SIMULATED, style.DASHED)}
    frames = [pair.measured, pair.simulated]
    if pair.extended:
        looks["extended model"] = (style.ACCENT, "dotted")
        frames.append(pair.extended)
    smooth_images = [ndimage.gaussian_filter(np.nan_to_num(image), SMOOTH_PX) for image, _ in frames]
    levels = [fraction * float(np.nanmax(smooth_images[1])) for fraction in LEVELS]
    handles = []
    for (image, spot), smooth_image, (colour, dashes) in zip(frames, smooth_images, looks.values(), strict=True):
        y, x = np.arange(image.shape[0]) - spot.row, np.arange(image.shape[1]) - spot.column
        overlay.contour(x, y, smooth_image, levels=levels, colors=[colour], linestyles=[dashes], linewidths=1.3)
        handles.append(profiles[0].plot(x, image[round(spot.row)], color=colour, linestyle=dashes)[0])
        profiles[1].plot(y, image[:, round(spot.column)], color=colour, linestyle=dashes)
    overlay.set(xlim=(-half, half), ylim=(half, -half), aspect="equal")
    overlay.set(xlabel="x from the fitted centre / px", ylabel="y from the fitted centre / px")
    for ax, axis in zip(profiles, ("x", "y"), strict=True):
        ax.set(xlim=(-half, half), xlabel=f"{axis} from the fitted centre / px", ylabel="reading / DN")
    style.add_legend(figure, handles, list(looks), len(looks))
    levels_text = ", ".join(f"{100 * level:.0f}" for level in LEVELS)
    caption = (
        f"Measured and simulated frames superposed on their fitted centres ({pair.name}). Left: contours at"
        f" {levels_text} % of the simulated maximum, after a Gaussian filter of {SMOOTH_PX:g} px that suppresses"
        " noise. Right: the row (top) and the column (bottom) through the centre, not filtered."
    )
    return style.Drawing(figure, caption)


FIGURES = (
    Entry("fig08a", "Simulated spot", Category.IMAGES, PAIR, partial(draw_frame, source="Simulated"), "Fig. 8a"),
    Entry("fig08b", "Measured spot", Category.IMAGES, PAIR, partial(draw_frame, source="Measured"), "Fig. 8b"),
    Entry("fig08c", "Measured and simulated spot superposed", Category.IMAGES, PAIR, draw_superposition, "Fig. 8c"),
    Entry("fig08d", "Spot of the extended model", Category.IMAGES, EXTENDED, partial(draw_frame, source="Extended")),
)
