"""Figures of the places at which measurement and model disagree, and of the evidence for each name."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure

from spotcheck.discrepancy.criteria import MIN_GAIN
from spotcheck.io.plus_minus import two_digits
from spotcheck.report.figures import style
from spotcheck.report.figures.discrepancy import Plan, chosen, plan_of
from spotcheck.report.figures.entry import VERDICT, Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

MOST_PANELS = 4
MOST_NAMES = 24
# Tests of detection that are named in the figure, the oddest first.
MOST_PARTS = 16
# Names beyond the effects that were found: rivals, and what could still be there.
FOUND, RIVAL = style.ACCENT, style.MEASURED


def where(results: Results) -> style.Drawing:
    """z of the mean by condition and ring, and of noise, fine structure, lines and scatter, against the threshold."""
    ds = results.get("discrepancy")
    plan = plan_of(ds)
    columns = chosen(len(plan.columns), MOST_PANELS)
    radial, azimuthal, order = (plan.table(ds, name) for name in ("z_radial", "z_azimuthal", "z_order"))
    if not np.isfinite(radial).any():
        raise Unavailable("no condition has a residual")
    limit = float(ds["z_threshold"])
    high = float(np.clip(0.17 * len(plan.rows) + 0.25, 0.5, 3.0))
    figure = style.new(2 * high + 4.1)
    parts = figure.subfigures(2, 1, squeeze=False, height_ratios=(2 * high + 1.4, 2.7))
    top, bottom = parts[0, 0], parts[1, 0]
    largest = float(np.nanmax(np.abs(np.concatenate([radial.ravel(), azimuthal.ravel()]))))
    norm = SymLogNorm(limit, vmin=-max(largest, 2 * limit), vmax=max(largest, 2 * limit))
    axes = top.subplots(2, len(columns), sharex=True, sharey=True, squeeze=False)
    for k, j in enumerate(columns):
        _rings(axes[0, k], ds, plan, radial[:, j], norm, limit, None)
        _rings(axes[1, k], ds, plan, azimuthal[:, j], norm, limit, order[:, j])
        axes[0, k].set_title(plan.columns[j])
    for ax, text in zip(axes[:, 0], ("ring mean", "azimuthal"), strict=True):
        ax.set_ylabel(text)
    top.supxlabel("distance from the spot's centre / $\\sigma_g$", fontsize=9)
    bar = top.colorbar(ScalarMappable(norm, style.DIVERGING_MAP), ax=list(axes.ravel()), aspect=22, label="z")
    ticks = [limit, *(10.0**n for n in range(1, 5) if 2 * limit < 10.0**n <= largest)]
    both = [*(-t for t in reversed(ticks)), 0, *ticks]
    bar.set_ticks(both, labels=[two_digits(abs(t)) if t >= 0 else f"−{two_digits(-t)}" for t in both])
    bar.ax.minorticks_off()
    count = _parts(bottom, ds, limit)
    known = int(np.isfinite(radial).sum() + np.isfinite(azimuthal).sum())
    cells = int((np.abs(radial) > limit).sum() + (azimuthal > limit).sum())
    rows = (
        " Rows: " + " and ".join(style.axis_name(d) for d in plan.dims if d in ds.coords) + "."
        if any(plan.rows)
        else ""
    )
    percent = two_digits(100 * float(ds.attrs["alpha"]))
    caption = (
        "Above: z of the mean residual by distance from the spot's centre, and below it of its strongest azimuthal"
        f" order (1 one-sided, 2 twofold, …); columns: exposure.{rows} Dots and orders stand where |z| > {limit:.2g},"
        f" which noise alone reaches anywhere in at most {percent} % of all data sets ({cells} of {known} cells do)."
        f" Beneath: the {min(MOST_PARTS, ds.sizes['part'])} oddest of {ds.sizes['part']} tests of the whole ({count}"
        " stand out)."
    )
    return style.Drawing(figure, caption)


def _rings(
    ax: Axes, ds: xr.Dataset, plan: Plan, z: np.ndarray, norm: SymLogNorm, limit: float, order: np.ndarray | None
) -> None:
    """One panel [row, ring]."""
    ax.grid(False)
    ax.set_facecolor("0.85")
    ax.imshow(z, cmap=style.DIVERGING_MAP, norm=norm, aspect="auto")
    low = ds["ring_low"].values
    ticks = np.arange(0, len(low), 1 if len(plan.columns) < MOST_PANELS else 2)
    ax.set_xticks(ticks - 0.5, [f"{low[k]:g}" for k in ticks], fontsize=7.5)
    few = chosen(len(plan.rows), 12)
    ax.set_yticks(few, [plan.rows[k] for k in few], fontsize=8)
    ax.tick_params(length=2)
    if len(plan.rows) > MOST_NAMES:
        return
    for i, k in np.argwhere(np.abs(np.nan_to_num(z)) > limit):
        deep = abs(norm(z[i, k]) - 0.5) > 0.3
        text = "•" if order is None else f"{order[i, k]:.0f}"
        ax.text(k, i, text, ha="center", va="center", fontsize=7, color="white" if deep else "black")


def _parts(part: Figure, ds: xr.Dataset, limit: float) -> int:
    """The tests of detection, the oddest on top; how many stand out."""
    ax = part.subplots()
    z, names = np.abs(ds["part_z"].values), [str(name) for name in ds["part"].values]
    few = np.argsort(-z)[:MOST_PARTS]
    y = -np.arange(len(few))
    clear = z[few] > limit
    ax.barh(
        y, np.maximum(z[few], 1.0), height=0.7, color=[style.SIMULATED if is_clear else "0.6" for is_clear in clear]
    )
    ax.axvline(limit, color="black", linewidth=0.9, linestyle=(0, (5, 3)))
    ax.set(xscale="log", xlim=(1.0, max(1.5 * limit, 2 * float(z[few].max(initial=1.0)))))
    ax.set_yticks(y, [names[k] for k in few], fontsize=7.5)
    ax.tick_params(axis="y", length=0)
    ax.grid(False, axis="y")
    ax.set_xlabel("|z|")
    return int((z > limit).sum())


def evidence(results: Results) -> style.Drawing:
    """Draw the drop of −2 ln L by each named effect and by its rivals, and the part of the gap that each closes."""
    verdict = results.verdict()
    if not verdict["effects"]:
        raise Unavailable("nothing was added to the model")
    rows: list[tuple[str, float | None, float | None, str]] = []
    for effect in verdict["effects"]:
        gain = effect["evidence"]["gain"]
        rows.append((effect["name"], gain, effect["gap_closed"], FOUND))
        for rival in effect["evidence"]["rivals"]:
            rows.append((f"or {rival['name']}", None if gain is None else gain - rival["behind"], None, RIVAL))
    y = -np.arange(len(rows))
    figure = style.new(1.1 + 0.28 * len(rows))
    left, right = figure.subplots(1, 2, sharey=True)
    for k, (_, gain, closed, colour) in enumerate(rows):
        if gain is not None and gain > 0:
            left.plot(gain, y[k], "o", color=colour)
            left.hlines(y[k], 1.0, gain, color=colour, linewidth=1.4)
        if closed is not None:
            right.barh(y[k], 100 * float(np.clip(closed, 0, 1)), height=0.6, color=colour)
    left.axvline(MIN_GAIN, color="black", linewidth=0.9, linestyle=(0, (5, 3)))
    left.set(xscale="log", xlim=(1.0, None), xlabel="gain in −2 ln L")
    right.set(xlim=(0, 100), xlabel="gap closed / %")
    left.set_yticks(y, [name for name, *_ in rows], fontsize=8)
    left.set_ylim(y.min() - 0.7, 0.7)
    for ax in (left, right):
        ax.grid(False, axis="y")
        ax.tick_params(axis="y", length=0)
    held_out = verdict["gap"]["on"]
    caption = (
        "Evidence for each named effect: −2 ln L of the searched frames drops by so much with it, all else fitted"
        f" again; less than {MIN_GAIN:g} (dashed) names nothing."
        + (f" Right: the part of the gap on {held_out} that it closes." if held_out else " No frame was held out.")
    )
    return style.Drawing(figure, caption)


FIGURES = (
    Entry("missing-where", "Where simulation and measurement disagree", Category.MISSING, VERDICT, where),
    Entry("missing-evidence", "What speaks for each name", Category.MISSING, VERDICT, evidence),
)
