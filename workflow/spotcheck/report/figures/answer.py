"""The verdict in one picture: a measured spot, the model without and with what was missing, and what each leaves."""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from spotcheck.discrepancy.words import percent_text, value_text
from spotcheck.io.plus_minus import two_digits
from spotcheck.report.figures import style
from spotcheck.report.figures.discrepancy import COLOUR_ENDS, plan_of, stages_in
from spotcheck.report.figures.entry import VERDICT, Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

MEASURED, BEFORE, AFTER = "measured", "before", "after"
# Colour, dashes and width of each line of the profile.
LOOKS = {
    MEASURED: (style.MEASURED, "solid", 2.6),
    BEFORE: (style.SIMULATED, (0, (4, 2)), 1.2),
    AFTER: ("black", "solid", 0.8),
}
# Half the side that is shown, in widths of the model.
ENLARGED = 3.0
NAMES = {MEASURED: "measured", BEFORE: "model", AFTER: "extended model"}


class Example(NamedTuple):
    """One condition: what it is called; measured reading, that of the models, and what these leave [DN], each [block
    row, block column]; where the blocks lie from the spot's centre, and their side [px]; half the side that is shown
    [px]."""

    name: str
    measured: np.ndarray
    models: dict[str, np.ndarray]
    residuals: dict[str, np.ndarray]
    x: np.ndarray
    y: np.ndarray
    side: float
    half: float


def draw(results: Results) -> style.Drawing:
    """The condition in which the model gains most from what was added; where nothing was, that of the largest
    residual."""
    found, verdict = example(results.get("discrepancy")), results.verdict()
    top = max(float(np.nanmax(image)) for image in (found.measured, *found.models.values()))
    end = max(float(np.nanpercentile(np.abs(image), COLOUR_ENDS)) for image in found.residuals.values())
    rows = len(found.models)
    figure = style.new(2.5 * rows if rows > 1 else 2.3, 1.15 * style.WIDTH)
    panels = figure.subplots(rows, 3, squeeze=False)
    light, left = Normalize(0.0, top), Normalize(-end, end)
    _image(panels[0, 0], found, found.measured, NAMES[MEASURED], light, style.IMAGE_MAP)
    for k, (stage, image) in enumerate(found.models.items()):
        _image(panels[0, 1 + k], found, image, NAMES[stage], light, style.IMAGE_MAP)
    # Beneath each model what it leaves; beside a single one.
    below = panels[1, 1:] if rows > 1 else panels[0, 2:]
    for ax, (stage, image) in zip(below, found.residuals.items(), strict=True):
        _image(ax, found, image, f"measured − {NAMES[stage]}", left, style.DIVERGING_MAP)
    if rows > 1:
        _profile(panels[1, 0], found)
        text = "\n".join(f"+ {own['name']}" for own in verdict["effects"])
        panels[0, 2].text(0.04, 0.04, text, transform=panels[0, 2].transAxes, color="white", fontsize=8)
        figure.colorbar(ScalarMappable(light, style.IMAGE_MAP), ax=list(panels[0]), label="reading / DN", pad=0.01)
    figure.colorbar(
        ScalarMappable(left, style.DIVERGING_MAP), ax=list(panels[-1]), label="residual / DN", extend="both", pad=0.01
    )
    return style.Drawing(figure, _caption(found, verdict, end))


def example(ds: xr.Dataset) -> Example:
    """The condition that shows most."""
    plan, stages = plan_of(ds), stages_in(ds)
    left = {stage: plan.table(ds, f"residual_{stage}") for stage in stages}
    known = {stage: np.nansum(image**2, axis=(2, 3)) for stage, image in left.items()}
    gain = known[BEFORE] - known.get(AFTER, 0.0)
    at = np.unravel_index(int(np.argmax(gain)), gain.shape)
    residuals = {stage: image[at] for stage, image in left.items()}
    if not all(np.isfinite(image).any() for image in residuals.values()):
        raise Unavailable("no condition has a residual")
    measured = plan.table(ds, "reading")[at]
    x0, y0, sigma = (float(plan.table(ds, name)[at]) for name in ("spot_x", "spot_y", "sigma"))
    x, y = ds["block_x"].values - x0, ds["block_y"].values - y0
    half = min(ENLARGED * sigma, float(np.abs([x[[0, -1]], y[[0, -1]]]).min()))
    side = float(x[1] - x[0]) if len(x) > 1 else 2 * half
    name = ", ".join(filter(None, (plan.rows[at[0]], plan.columns[at[1]])))
    return Example(name, measured, {k: measured - own for k, own in residuals.items()}, residuals, x, y, side, half)


def _image(ax: Axes, found: Example, image: np.ndarray, title: str, norm: Normalize, colours: str) -> None:
    step = found.side / 2
    extent = (found.x[0] - step, found.x[-1] + step, found.y[-1] + step, found.y[0] - step)
    ax.imshow(image, cmap=colours, norm=norm, extent=extent)
    ax.set(title=title, xlim=(-found.half, found.half), ylim=(found.half, -found.half), facecolor="0.85")
    ax.set(xlabel="x / px", ylabel="y / px")
    ax.label_outer()
    ax.grid(False)


def _profile(ax: Axes, found: Example) -> None:
    row = int(np.argmin(np.abs(found.y)))
    for name, image in {MEASURED: found.measured, **found.models}.items():
        colour, dashes, width = LOOKS[name]
        ax.plot(found.x, image[row], color=colour, linestyle=dashes, linewidth=width, label=NAMES[name])
    ax.legend(loc="upper left", fontsize=7, handlelength=1.4, borderaxespad=0.1)
    ax.set_box_aspect(1)
    # Room for the legend.
    highest = max(float(np.nanmax(image[row])) for image in (found.measured, *found.models.values()))
    ax.set(title="the row through the centre", xlim=(-found.half, found.half), ylim=(0, 1.4 * highest))
    ax.set(xlabel="x / px", ylabel="reading / DN")


def _caption(found: Example, verdict: dict[str, Any], end: float) -> str:
    out = [f"Spot{f' at {found.name}' if found.name else ''}: mean over its frames, in blocks of {found.side:g} px."]
    out.append(f"Residuals are on one scale, which ends at ±{two_digits(end)} DN.")
    out.append(f"Verdict: {verdict['status'].replace('_', ' ')}.")
    effects, gap = [_effect(own) for own in verdict["effects"]], verdict["gap"]
    if effects:
        out.append(f"Added to the model: {'; '.join(effects)}.")
    rivals = [own["name"] for effect in verdict["effects"] for own in effect["evidence"]["rivals"]]
    if rivals:
        out.append(f"The frames do not tell it from {' or '.join(rivals)}.")
    if effects and gap["closed"] is not None:
        out.append(f"That closes {percent_text(min(gap['closed'], 1.0))} of the gap on {gap['on']}.")
    return " ".join(out)


def _effect(own: dict[str, Any]) -> str:
    values = [f"{key} {value_text(p['value'], p['stderr'], p['unit'])}" for key, p in own["parameters"].items()]
    return f"{own['name']} ({', '.join(values)})" if values else str(own["name"])


FIGURES = (Entry("missing-answer", "What the model is missing", Category.MISSING, VERDICT, draw),)
