"""The light's shape: declared, learned, and the difference."""

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from spotcheck.dataset.folder import Dataset
from spotcheck.model.baseline import of_instrument
from spotcheck.report.figures import style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.results import Results

# Half the side that is shown [σ_g]: beyond it even a Gaussian with wings has no light to see.
SHOWN = 4.0
# The least light that is drawn [peak].
LEAST = 1e-4


@dataclass(frozen=True)
class Shapes:
    """Declared and learned shape of a light on a grid, the peak of the declared one being 1."""

    places: np.ndarray  # u of the columns and v of the rows [σ_g]
    declared: np.ndarray  # declared shape [row, column]
    learned: np.ndarray  # learned shape [row, column]


def compare_shapes(ds: xr.Dataset, dataset: Dataset) -> Shapes:
    """Return the shapes of light.nc and of the instrument; of several lights, the one that is least as declared."""
    is_shown = np.abs(ds["u"].values) <= SHOWN
    places = ds["u"].values[is_shown]
    lights = ds["s"].values[:, is_shown][:, :, is_shown]
    u, v = places[None, :], places[:, None]
    baseline = of_instrument(dataset.instrument, dataset.exposures)
    # A learned shape replaces a profile of the instrument.
    plain, declared = (model.spot(u, v, 1.0, 1.0) for model in (replace(baseline, learned=None), baseline))
    differences = plain + lights - declared
    return Shapes(places, declared, declared + differences[int(np.abs(differences).sum(axis=(1, 2)).argmax())])


def draw(results: Results) -> style.Drawing:
    """Draw both shapes, their difference, and the lines through the centre."""
    ds = results.get("light")
    shapes = compare_shapes(ds, results.dataset)
    u, before, after = shapes.places, shapes.declared, shapes.learned
    difference = 100 * (after - before)
    end = float(np.abs(difference).max())
    figure = style.new(4.6, 1.05 * style.WIDTH)
    upper, lower = (part[0] for part in figure.subfigures(2, 1, squeeze=False, height_ratios=(1.25, 1.0)))
    panels = upper.subplots(1, 3, sharey=True)
    light, left = Normalize(0.0, float(max(before.max(), after.max()))), Normalize(-end, end)
    extent = (-SHOWN, SHOWN, SHOWN, -SHOWN)
    for ax, image, norm, colours, title in (
        (panels[0], before, light, style.IMAGE_MAP, "declared"),
        (panels[1], after, light, style.IMAGE_MAP, "learned"),
        (panels[2], difference, left, style.DIVERGING_MAP, "learned − declared"),
    ):
        ax.imshow(image, cmap=colours, norm=norm, extent=extent)
        ax.set(title=title, xlabel="u / $\\sigma_g$")
        ax.grid(False)
    panels[0].set_ylabel("v / $\\sigma_g$")
    upper.colorbar(ScalarMappable(left, style.DIVERGING_MAP), ax=list(panels), label="% of the peak", aspect=18)
    middle = len(u) // 2
    lines = {"u": (after[middle], before[middle]), "v": (after[:, middle], before[:, middle])}
    for ax, (place, (learned, declared)) in zip(lower.subplots(1, 2, sharey=True), lines.items(), strict=True):
        ax.semilogy(u, np.maximum(learned, LEAST), color=style.MEASURED, label="learned")
        ax.semilogy(u, np.maximum(declared, LEAST), color=style.SIMULATED, linestyle=(0, (4, 2)), label="declared")
        ax.set(xlabel=f"{place} / $\\sigma_g$", ylim=(LEAST, 2.0))
        if place == "u":
            ax.set_ylabel("light / peak")
            ax.legend(loc="upper right")
    lights = ds.sizes["light"]
    whose = "the same in every frame" if lights == 1 else f"that of {lights} poses which is least as declared"
    caption = (
        f"The light's shape in widths σ_g of the declared one, {whose}: {ds.attrs['described']}. Below: along the row"
        " and along the column through the centre."
    )
    return style.Drawing(figure, caption)


FIGURES = (Entry("missing-light", "The light's shape", Category.MISSING, ("light",), draw),)
