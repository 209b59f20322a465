"""Fig. 8: one simulated and one measured frame, and both laid over each other."""

import numpy as np
import xarray as xr
from matplotlib.patches import Rectangle
from scipy import ndimage

from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import PAIR, Category, Entry
from spotcheck.report.figures.frames_of import Example, Spot, example
from spotcheck.report.figures.results import Results

# Half the side of the enlarged part, in fitted widths.
ENLARGED = 3.5
# A part larger than this fraction of the crop is not drawn again beside it.
WORTH_ENLARGING = 0.75
LEVELS = (0.2, 0.5, 0.8)
SMOOTH_PX = 1.5


def simulated(results: Results) -> style.Drawing:
    """Fig. 8a: the simulated frame of the longest exposure."""
    found = example(results, describe)
    return _image(results, found, found.simulated, found.simulated_spot, "Simulated")


def measured(results: Results) -> style.Drawing:
    """Fig. 8b: the measured frame of the same cell, on the same scale."""
    found = example(results, describe)
    return _image(results, found, found.measured, found.measured_spot, "Measured")


def describe(ds: xr.Dataset, index: dict[str, int]) -> str:
    """A cell in words: every recorded axis with its value."""
    parts = []
    for dim, k in index.items():
        if dim in ds.coords:
            values, unit, _ = series.coordinate(ds, dim)
            parts.append(f"{style.axis_name(dim)} {style.number(values[k], unit)}".replace("$", ""))
    return ", ".join(parts)


def half_side(found: Example) -> int:
    """Half the side of the enlarged part [px]: some fitted widths, never more than the crop has."""
    widest = max(found.measured_spot.major, found.simulated_spot.major)
    return int(min(max(np.ceil(ENLARGED * widest), 8), min(found.measured.shape) // 2 - 1))


def _image(results: Results, found: Example, image: np.ndarray, spot: Spot, source: str) -> style.Drawing:
    highest = float(max(np.nanmax(found.measured), np.nanmax(found.simulated)))
    lowest = float(min(np.nanmin(found.measured), np.nanmin(found.simulated)))
    half = half_side(found)
    centre = round(spot.column), round(spot.row)
    enlarged = half < WORTH_ENLARGING * min(image.shape) / 2
    figure = style.new(3.0 if enlarged else 4.2)
    panels = list(figure.subplots(1, 2)) if enlarged else [figure.add_subplot()]
    for ax in panels:
        shown = ax.imshow(image, cmap=style.IMAGE_MAP, vmin=lowest, vmax=highest)
        ax.grid(False)
        ax.set_xlabel("column of the crop / px")
        ax.set_ylabel("row of the crop / px")
    if enlarged:
        corner = (centre[0] - half - 0.5, centre[1] - half - 0.5)
        frame = Rectangle(corner, 2 * half + 1, 2 * half + 1, fill=False, edgecolor="white", linewidth=0.8)
        panels[0].add_patch(frame)
        panels[1].set_xlim(centre[0] - half - 0.5, centre[0] + half + 0.5)
        panels[1].set_ylim(centre[1] + half + 0.5, centre[1] - half - 0.5)
    figure.colorbar(shown, ax=panels, label="reading / DN", shrink=0.9, pad=0.02)
    caption = (
        f"{source} frame ({found.name}): the crop of {image.shape[1]} × {image.shape[0]} px centred on the light"
        f"{', and the marked part enlarged' if enlarged else ''}. Measured and simulated frame share one colour scale."
    )
    clause = (
        "The paper shows 900 µs as well, and finds the simulated plateau close to the real one, the real flanks steeper"
        " and the real plateau crossed by horizontal lines."
    )
    return style.Drawing(figure, caption + results.beside_paper(clause))


def superposition(results: Results) -> style.Drawing:
    """Fig. 8c: contours of both frames and the profiles through their fitted centres."""
    found = example(results, describe)
    half = half_side(found)
    figure = style.new(3.4)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.05, 1.0))
    overlay = figure.add_subplot(grid[:, 0])
    profiles = [figure.add_subplot(grid[k, 1]) for k in range(2)]
    highest = float(np.nanmax(ndimage.gaussian_filter(np.nan_to_num(found.simulated), SMOOTH_PX)))
    pairs = (
        (found.measured, found.measured_spot, style.MEASURED, "solid"),
        (found.simulated, found.simulated_spot, style.SIMULATED, (0, (5, 2))),
    )
    handles = []
    for image, spot, colour, dashes in pairs:
        y, x = (np.arange(n) - c for n, c in zip(image.shape, (spot.row, spot.column), strict=True))
        smooth = ndimage.gaussian_filter(np.nan_to_num(image), SMOOTH_PX)
        levels = [part * highest for part in LEVELS]
        overlay.contour(x, y, smooth, levels=levels, colors=[colour], linestyles=[dashes], linewidths=1.3)
        row, column = round(spot.row), round(spot.column)
        handles.append(profiles[0].plot(x, image[row], color=colour, linestyle=dashes)[0])
        profiles[1].plot(y, image[:, column], color=colour, linestyle=dashes)
    overlay.set(xlim=(-half, half), ylim=(half, -half), aspect="equal")
    overlay.set(xlabel="x from the fitted centre / px", ylabel="y from the fitted centre / px")
    for ax, axis in zip(profiles, ("x", "y"), strict=True):
        ax.set_xlim(-half, half)
        ax.set(xlabel=f"{axis} from the fitted centre / px", ylabel="reading / DN")
    style.legend_above(figure, handles, ["measured", "simulated"], 2)
    levels_text = ", ".join(f"{100 * level:.0f}" for level in LEVELS)
    caption = (
        f"Measured and simulated frame laid over each other on their fitted centres ({found.name}). Left: contours at"
        f" {levels_text} % of the simulated maximum, after a Gaussian of {SMOOTH_PX:g} px that keeps noise out of the"
        " lines. Right: the row (top) and the column (bottom) through the centre, not smoothed."
    )
    clause = "The paper reads the same overlay by eye: plateaus agree, the measured edge falls more steeply."
    return style.Drawing(figure, caption + results.beside_paper(clause))


FIGURES = (
    Entry("fig08a", "Simulated spot", Category.IMAGES, PAIR, simulated, "Fig. 8a"),
    Entry("fig08b", "Measured spot", Category.IMAGES, PAIR, measured, "Fig. 8b"),
    Entry("fig08c", "Measured and simulated spot superposed", Category.IMAGES, PAIR, superposition, "Fig. 8c"),
)
