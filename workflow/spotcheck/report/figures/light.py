"""Shape of the light: declared, learned, and their difference.

The declared shape is that of the instrument file. The learned one was fitted to the frames because the declared one did
not explain them. Shapes are functions of u and v: column and row from the spot's centre in widths σ_g of the declared
shape. A pose is an orientation of the sample; each pose may have its own learned shape.
"""

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from spotcheck.dataset.folder import Dataset
from spotcheck.model.baseline import build_baseline
from spotcheck.report.figures import style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results

# Half the side of the shown part [σ_g]; outside of it even a Gaussian with wings has no visible light.
HALF_SIDE = 4.0
# Smallest light on the logarithmic ordinate, as a fraction of the peak.
MIN_LIGHT = 1e-4


@dataclass(frozen=True)
class Shapes:
    """Declared and learned shape of a light on a square grid, as fractions of the peak of the declared Gaussian."""

    places: np.ndarray  # u of the columns, which are also the v of the rows [point] in σ_g
    declared: np.ndarray  # declared shape [row, column]
    learned: np.ndarray  # learned shape [row, column]


def compare_shapes(ds: xr.Dataset, dataset: Dataset) -> Shapes:
    """Return the learned shape of light.nc and the declared one of the dataset's instrument file.

    If there is a learned shape for each of several poses, the one that differs most is returned.
    """
    is_shown = np.abs(ds["u"].values) <= HALF_SIDE
    places = ds["u"].values[is_shown]
    lights = ds["s"].values[:, is_shown][:, :, is_shown]  # learned shapes [light, row, column]
    u, v = places[None, :], places[:, None]
    baseline = build_baseline(dataset.instrument, dataset.exposures)
    # light.nc stores what is added to the Gaussian or top hat. The declared shape may have a profile instead.
    plain_shape, declared = (model.spot(u, v, 1.0, 1.0) for model in (replace(baseline, learned=None), baseline))
    differences = plain_shape + lights - declared
    largest = int(np.abs(differences).sum(axis=(1, 2)).argmax())
    return Shapes(places, declared, declared + differences[largest])


def draw_shapes(results: Results) -> style.Drawing:
    """Draw declared and learned shape of the light, their difference, and profiles through the centre."""
    ds = results.get("light")
    shapes = compare_shapes(ds, results.dataset)
    u, declared, learned = shapes.places, shapes.declared, shapes.learned
    difference = 100 * (learned - declared)
    limit = float(np.abs(difference).max())
    light_norm = Normalize(0.0, float(max(declared.max(), learned.max())))
    difference_norm = Normalize(-limit, limit)
    figure = style.new_figure(4.6, 1.05 * style.WIDTH)
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.25, 1.0))[:, 0]
    panels = upper.subplots(1, 3, sharey=True)
    extent = (-HALF_SIDE, HALF_SIDE, HALF_SIDE, -HALF_SIDE)
    style.show_image(panels[0], declared, style.IMAGE_MAP, light_norm, extent, title="declared")
    style.show_image(panels[1], learned, style.IMAGE_MAP, light_norm, extent, title="learned")
    style.show_image(panels[2], difference, style.DIVERGING_MAP, difference_norm, extent, title="learned − declared")
    for ax in panels:
        ax.set_xlabel("u / $\\sigma_g$")
    panels[0].set_ylabel("v / $\\sigma_g$")
    mapped = ScalarMappable(difference_norm, style.DIVERGING_MAP)
    upper.colorbar(mapped, ax=list(panels), label="% of the peak", aspect=18)
    middle = len(u) // 2
    left, right = lower.subplots(1, 2, sharey=True)
    declared_look = {"color": style.SIMULATED, "linestyle": (0, (4, 2)), "label": "declared"}
    # Profiles along the row and along the column through the centre; the grid is the same for both.
    for ax, name, line in ((left, "u", (middle, slice(None))), (right, "v", (slice(None), middle))):
        ax.semilogy(u, np.maximum(learned[line], MIN_LIGHT), color=style.MEASURED, label="learned")
        ax.semilogy(u, np.maximum(declared[line], MIN_LIGHT), **declared_look)
        ax.set(xlabel=f"{name} / $\\sigma_g$", ylim=(MIN_LIGHT, 2.0))
    left.set_ylabel("light / peak")
    left.legend(loc="upper right")
    count = ds.sizes["light"]
    frames = "the same in every frame" if count == 1 else f"that of the pose, of {count}, which differs most"
    caption = (
        f"The light's shape in widths σ_g of the declared one, {frames}: {ds.attrs['described']}. Below: along the row"
        " and along the column through the centre."
    )
    return style.Drawing(figure, caption)


FIGURES = (Entry("missing-light", "The light's shape", Category.MISSING, ("light",), draw_shapes),)
