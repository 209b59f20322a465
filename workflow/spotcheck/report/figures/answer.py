"""Verdict in one picture: a measured spot, the declared and the extended model, and their residuals.

The declared model is that of the instrument file. The extended model also has the effects and the light shape that the
verdict added; without additions there is none. The gap is the excess of the declared model's residuals over noise, on
held-out frames, which were not used to select the effects.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from spotcheck.discrepancy.pictures import AFTER, BEFORE
from spotcheck.discrepancy.words import percent_text
from spotcheck.io.number_text import quantity_text, two_digits
from spotcheck.report.figures import style
from spotcheck.report.figures.discrepancy import COLOUR_PERCENTILE, list_models, tabulate_conditions
from spotcheck.report.figures.entry import VERDICT, Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

MEASURED = "measured"
# Half the side of the shown part of the crop, in widths σ_g of the declared model.
HALF_SIDE_WIDTHS = 3.0


# Looks of the profiles of the measured reading and of the models, in the order in which they are drawn; the label is
# also the name in titles.
LOOKS: dict[str, dict[str, Any]] = {
    MEASURED: {"label": "measured", "color": style.MEASURED, "linewidth": 2.6},
    BEFORE: {"label": "model", "color": style.SIMULATED, "linestyle": (0, (4, 2)), "linewidth": 1.2},
    AFTER: {"label": "extended model", "color": "black", "linewidth": 0.8},
}


@dataclass(frozen=True)
class Example:
    """The condition to show, with its models.

    A block is a square of pixels over which discrepancy.nc averages. Images are [block row, block column] in DN and NaN
    without a usable pixel; models are named `BEFORE` (declared) and `AFTER` (extended).
    """

    name: str  # condition as text; "" if nothing was recorded
    measured: np.ndarray  # mean measured reading
    models: dict[str, np.ndarray]  # mean reading of each model, by name
    residuals: dict[str, np.ndarray]  # measured less model, by name
    x: np.ndarray  # columns of the centres of blocks from the spot's centre [px]
    y: np.ndarray  # rows of the centres of blocks from the spot's centre [px]
    block_side: float  # side of a block [px]
    half_side: float  # half the side of the shown part [px]

    @property
    def images(self) -> dict[str, np.ndarray]:
        """Measured reading and reading of each model, by the keys of `LOOKS`."""
        return {MEASURED: self.measured, **self.models}


def draw_answer(results: Results) -> style.Drawing:
    """Draw measured spot, models and residuals of the condition that `choose_example` returns."""
    example, verdict = choose_example(results.get("discrepancy")), results.verdict()
    highest = max(float(np.nanmax(image)) for image in example.images.values())
    limit = max(float(np.nanpercentile(np.abs(image), COLOUR_PERCENTILE)) for image in example.residuals.values())
    reading_norm, residual_norm = Normalize(0.0, highest), Normalize(-limit, limit)
    rows = len(example.models)
    figure = style.new_figure(2.5 * rows if rows > 1 else 2.3, 1.15 * style.WIDTH)
    panels = figure.subplots(rows, 3, squeeze=False)
    # With a single model, the last panel of the row shows its residual.
    for ax, (key, image) in zip(panels[0], example.images.items(), strict=False):
        _draw_image(ax, example, image, LOOKS[key]["label"], reading_norm, style.IMAGE_MAP)
    # Residuals are below their models, or beside a single model.
    residual_panels = panels[1, 1:] if rows > 1 else panels[0, 2:]
    for ax, (key, image) in zip(residual_panels, example.residuals.items(), strict=True):
        _draw_image(ax, example, image, "measured − " + LOOKS[key]["label"], residual_norm, style.DIVERGING_MAP)
    if rows > 1:
        _draw_profile(panels[1, 0], example)
        text = "\n".join(f"+ {effect['name']}" for effect in verdict["effects"])
        panels[0, 2].text(0.04, 0.04, text, transform=panels[0, 2].transAxes, color="white", fontsize=8)
        mapped = ScalarMappable(reading_norm, style.IMAGE_MAP)
        figure.colorbar(mapped, ax=list(panels[0]), label="reading / DN", pad=0.01)
    mapped = ScalarMappable(residual_norm, style.DIVERGING_MAP)
    figure.colorbar(mapped, ax=list(panels[-1]), label="residual / DN", extend="both", pad=0.01)
    return style.Drawing(figure, _write_caption(example, verdict, limit))


def choose_example(ds: xr.Dataset) -> Example:
    """Return the condition in which the extended model reduces the sum of squared residuals most.

    Without an extended model, return the condition with the largest sum. `ds` is the content of discrepancy.nc. Raises
    `Unavailable` if no condition has a residual.
    """
    table, models = tabulate_conditions(ds), list_models(ds)
    residuals = {model: table.read(ds, f"residual_{model}") for model in models}
    # Sum over the blocks of each condition [row of the table, column of the table].
    squares = {model: np.nansum(image**2, axis=(2, 3)) for model, image in residuals.items()}
    has_residual = np.all([np.isfinite(image).any(axis=(2, 3)) for image in residuals.values()], axis=0)
    if not has_residual.any():
        raise Unavailable("no condition has a residual")
    reduction = np.where(has_residual, squares[BEFORE] - squares.get(AFTER, 0.0), -np.inf)
    row, column = np.unravel_index(int(np.argmax(reduction)), reduction.shape)
    shown_residuals = {model: image[row, column] for model, image in residuals.items()}
    measured = table.read(ds, "reading")[row, column]
    x0, y0, sigma = (float(table.read(ds, name)[row, column]) for name in ("spot_x", "spot_y", "sigma"))
    x, y = ds["block_x"].values - x0, ds["block_y"].values - y0
    half_side = min(HALF_SIDE_WIDTHS * sigma, float(np.abs([x[[0, -1]], y[[0, -1]]]).min()))
    return Example(
        name=", ".join(filter(None, (table.rows[row], table.columns[column]))),
        measured=measured,
        models={model: measured - residual for model, residual in shown_residuals.items()},
        residuals=shown_residuals,
        x=x,
        y=y,
        block_side=float(x[1] - x[0]) if len(x) > 1 else 2 * half_side,
        half_side=half_side,
    )


def _draw_image(ax: Axes, example: Example, image: np.ndarray, title: str, norm: Normalize, cmap: str) -> None:
    """Draw an image of the example [block row, block column] over the distance from the spot's centre."""
    x, y, margin, half = example.x, example.y, example.block_side / 2, example.half_side
    extent = (x[0] - margin, x[-1] + margin, y[-1] + margin, y[0] - margin)
    style.show_image(ax, image, cmap, norm, extent, title=title, facecolor="0.85", xlabel="x / px", ylabel="y / px")
    ax.set(xlim=(-half, half), ylim=(half, -half))
    ax.label_outer()


def _draw_profile(ax: Axes, example: Example) -> None:
    """Draw measured and modelled reading along the row of blocks through the spot's centre."""
    row, half = int(np.argmin(np.abs(example.y))), example.half_side
    for key, image in example.images.items():
        ax.plot(example.x, image[row], **LOOKS[key])
    ax.legend(loc="upper left", fontsize=7, handlelength=1.4, borderaxespad=0.1)
    ax.set_box_aspect(1)
    # The ordinate leaves space for the legend.
    highest = max(float(np.nanmax(image[row])) for image in example.images.values())
    ax.set(title="the row through the centre", xlim=(-half, half), ylim=(0, 1.4 * highest))
    ax.set(xlabel="x / px", ylabel="reading / DN")


def _write_caption(example: Example, verdict: dict[str, Any], limit: float) -> str:
    """Return the caption; `verdict` is verdict.json, `limit` the absolute residual [DN] at which the colours end."""
    condition = f" at {example.name}" if example.name else ""
    sentences = [
        f"Spot{condition}: mean over its frames, in blocks of {example.block_side:g} px.",
        f"Residuals are on one scale, which ends at ±{two_digits(limit)} DN.",
        f"Verdict: {verdict['status'].replace('_', ' ')}.",
    ]
    effects, gap = verdict["effects"], verdict["gap"]
    if effects:
        sentences.append(f"Added to the model: {'; '.join(_effect_text(effect) for effect in effects)}.")
    # Rivals are other effects that explain the frames about as well as an added one.
    rivals = [rival["name"] for effect in effects for rival in effect["evidence"]["rivals"]]
    if rivals:
        sentences.append(f"The frames do not distinguish it from {' or '.join(rivals)}.")
    # An extended model may fit slightly better than the noise allows; the text stops at 100 %.
    if effects and gap["closed"] is not None:
        sentences.append(f"That closes {percent_text(min(gap['closed'], 1.0))} of the gap on {gap['on']}.")
    return " ".join(sentences)


def _effect_text(effect: dict[str, Any]) -> str:
    """Return the name of an effect of verdict.json, with its parameters in brackets if it has any."""
    parameters = ", ".join(
        f"{key} {quantity_text(parameter['value'], parameter['stderr'], parameter['unit'])}"
        for key, parameter in effect["parameters"].items()
    )
    return f"{effect['name']} ({parameters})" if parameters else str(effect["name"])


FIGURES = (Entry("missing-answer", "What the model is missing", Category.MISSING, VERDICT, draw_answer),)
