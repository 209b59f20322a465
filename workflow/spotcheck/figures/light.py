"""The light's shape: declared, learned, and what lies between them."""

import numpy as np
import xarray as xr
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from spotcheck.dataset import Dataset
from spotcheck.figures import style
from spotcheck.figures.entry import Category, Entry
from spotcheck.figures.results import Results
from spotcheck.old_engine.model import chain
from spotcheck.old_engine.model.baseline import of_instrument

# Half the side that is shown [σ_g]: beyond it even a Gaussian with wings has no light to see.
SHOWN = 4.0
# The least light that is drawn [peak].
LEAST = 1e-4


def declared_shape(dataset: Dataset, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The declared shape at places in σ_g [row, column], its peak 1."""
    baseline = of_instrument(dataset.instrument, dataset.exposures)
    one = np.ones((1, 1, 1))
    view = chain.View(u[None, None, :], v[None, :, None], 0 * one, 0 * one, one, 0 * one, 0 * one, 0 * one, 0 * one,
                      1.0, 1.0, 0.0, 0.0, 1.0, 1.0)  # fmt: skip
    return chain.light(view, baseline, chain.Free(one, one), ())[0][0]


def learned_shape(ds: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Places u = v [σ_g] of light.nc that are shown, and there what the learned shape has beside the declared one
    [row, column]; of several lights that which is least as declared."""
    inside = np.abs(ds["u"].values) <= SHOWN
    every = ds["s"].values[:, inside][:, :, inside]
    return ds["u"].values[inside], every[int(np.argmax(np.abs(every).sum(axis=(1, 2))))]


def draw(results: Results) -> style.Drawing:
    """Both shapes, their difference, and the lines through the centre."""
    ds = results.get("light")
    u, s = learned_shape(ds)
    before = declared_shape(results.dataset, u, u)
    after, end = before + s, 100 * float(np.abs(s).max())
    figure = style.new(4.6, 1.05 * style.WIDTH)
    upper, lower = (own[0] for own in figure.subfigures(2, 1, squeeze=False, height_ratios=(1.25, 1.0)))
    panels = upper.subplots(1, 3, sharey=True)
    light, left = Normalize(0.0, float(max(before.max(), after.max()))), Normalize(-end, end)
    extent = (-SHOWN, SHOWN, SHOWN, -SHOWN)
    for ax, image, norm, colours, title in (
        (panels[0], before, light, style.IMAGE_MAP, "declared"),
        (panels[1], after, light, style.IMAGE_MAP, "learned"),
        (panels[2], 100 * s, left, style.DIVERGING_MAP, "learned − declared"),
    ):
        ax.imshow(image, cmap=colours, norm=norm, extent=extent)
        ax.set(title=title, xlabel="u / $\\sigma_g$")
        ax.grid(False)
    panels[0].set_ylabel("v / $\\sigma_g$")
    upper.colorbar(ScalarMappable(left, style.DIVERGING_MAP), ax=list(panels), label="% of the peak", aspect=18)
    middle = len(u) // 2
    lines = {"u": (after[middle], before[middle]), "v": (after[:, middle], before[:, middle])}
    for ax, (place, (learned, stated)) in zip(lower.subplots(1, 2, sharey=True), lines.items(), strict=True):
        ax.semilogy(u, np.maximum(learned, LEAST), color=style.MEASURED, label="learned")
        ax.semilogy(u, np.maximum(stated, LEAST), color=style.SIMULATED, linestyle=(0, (4, 2)), label="declared")
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
