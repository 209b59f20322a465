"""Where measurement and model disagree, and how well each effect of the vocabulary explains it."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from spotcheck.figures import style
from spotcheck.figures.discrepancy import Plan, chosen, plan_of
from spotcheck.figures.entry import VERDICT, Category, Entry
from spotcheck.figures.results import Results, Unavailable

MOST_PANELS = 4
MOST_NAMES = 24
BLOCKS = {
    "variance": "noise, by light",
    "spectrum": "fine structure",
    "line": "lines",
    "frame": "frame to frame",
    "surround": "surroundings",
}
# How a candidate looks by its role: neither, holds, part of the best set that holds.
ROLES = {1: (style.ACCENT, "holds"), 2: (style.MEASURED, "part of the best set"), 0: ("0.65", "does not hold")}


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
    bar.set_ticks(both, labels=[style.power(abs(t)) if t >= 0 else f"−{style.power(-t)}" for t in both])
    bar.ax.minorticks_off()
    count = _bins(bottom, ds, limit)
    known = int(np.isfinite(radial).sum() + np.isfinite(azimuthal).sum())
    cells = int((np.abs(radial) > limit).sum() + (azimuthal > limit).sum())
    rows = (
        " Rows: " + " and ".join(style.axis_name(d) for d in plan.dims if d in ds.coords) + "."
        if any(plan.rows)
        else ""
    )
    percent = style.power(100 * float(ds.attrs["alpha"]))
    caption = (
        "Above: z of the mean residual by distance from the spot's centre, and below it of its strongest azimuthal"
        f" order (1 one-sided, 2 twofold, …); columns: exposure.{rows} Dots and orders stand where |z| > {limit:.2g},"
        f" which noise alone reaches anywhere in at most {percent} % of all data sets ({cells} of {known} cells do)."
        " Beneath: |z| of noise, fine structure, lines and scatter over all frames, the same threshold dashed"
        f" ({count} of {ds.sizes['bin']} stand out); triangles: more (up) or less (down) than expected."
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
        text = "•" if order is None else f"{order[i, k]}"
        ax.text(k, i, text, ha="center", va="center", fontsize=7, color="white" if deep else "black")


def _bins(part: Figure, ds: xr.Dataset, limit: float) -> int:
    """Stems of |z| of all that is not the mean; how many stand out."""
    ax = part.subplots()
    blocks = [str(b) for b in ds["bin_block"].values]
    labels, z = [str(b) for b in ds["bin_label"].values], ds["bin_z"].values.astype(float)
    places, at, heads = [], 0.0, []
    for k, block in enumerate(blocks):
        if k and block != blocks[k - 1]:
            at += 0.8
        places.append(at)
        at += 1.0
    x = np.array(places)
    size = np.abs(z)
    clear = size > limit
    for mask, colour in ((clear, style.SIMULATED), (~clear, "0.5")):
        ax.vlines(x[mask], 0, size[mask], color=colour, linewidth=1.6)
        for sign, marker in ((z >= 0, "^"), (z < 0, "v")):
            ax.plot(x[mask & sign], size[mask & sign], marker, color=colour, markersize=4.5)
    ax.axhline(limit, color="black", linewidth=0.9, linestyle=(0, (5, 3)))
    ax.set_yscale("symlog", linthresh=limit, linscale=1.2)
    ax.set_ylim(0, max(4 * limit, 3 * float(size.max(initial=1.0))))
    ticks = [0, 2, 4, *(10.0**n for n in range(1, 4) if 10.0**n < ax.get_ylim()[1])]
    ax.set_yticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    ax.set_xticks(x, labels, rotation=90, fontsize=7.5)
    ax.tick_params(axis="x", length=0)
    ax.grid(False, axis="x")
    ax.set_xlim(-0.8, at - 0.2)
    ax.set_ylabel("|z|")
    for block in dict.fromkeys(blocks):
        own = x[[b == block for b in blocks]]
        heads.append(own.mean())
        ax.text(
            own.mean(),
            0.99,
            BLOCKS.get(block, block),
            transform=ax.get_xaxis_transform(),
            ha="center",
            va="top",
            fontsize=8.5,
        )
    return int(clear.sum())


def evidence(results: Results) -> style.Drawing:
    """How far each effect alone, and each set that holds, closes the gap, and how far it falls behind the best."""
    ds = results.get("discrepancy")
    if "candidate" not in ds.coords:
        raise Unavailable("nothing disagreed enough for an effect to be tried")
    names = [str(n).replace(" + ", "\n+ ") for n in ds["candidate"].values]
    closed, behind = 100 * ds["candidate_closed"].values, ds["candidate_behind"].values
    role = ds["candidate_role"].values
    nothing, tied = float(ds["nothing_behind"]), float(ds["tied"])
    lines = np.array([1 + n.count("\n") for n in names])
    y = -(np.cumsum(lines) - lines / 2)
    whole = np.isfinite(closed).any()
    figure = style.new(1.0 + 0.17 * float(lines.sum()))
    axes = figure.subplots(1, 2 if whole else 1, sharey=True, squeeze=False)[0]
    colours = [ROLES[int(r)][0] for r in role]
    if whole:
        axes[0].barh(y, np.clip(closed, 0, 100), height=0.75, color=colours)
        axes[0].set(xlim=(0, 100), xlabel="gap in the mean images closed / %")
    ax = axes[-1]
    end = 2 * max(nothing, 10 * tied)
    at = np.clip(behind, 1.0, end)
    ax.hlines(y, 1.0, at, color=colours, linewidth=1.4)
    roles = [r for r in ROLES if (role == r).any()]
    for r in roles:
        ax.plot(at[role == r], y[role == r], "D" if r == 1 else "o", color=ROLES[r][0], markersize=4.5, clip_on=False)
    ax.axvline(tied, color="black", linewidth=0.9, linestyle=(0, (5, 3)))
    ax.axvline(max(nothing, 1.0), color="black", linewidth=0.9, linestyle=(0, (1, 1.5)))
    ax.set(xscale="log", xlim=(1.0, end * 1.3), xlabel="behind the best at first look / −2 ln L")
    place = {"transform": ax.get_xaxis_transform(), "fontsize": 8, "va": "bottom", "in_layout": False}
    ax.text(1.0, 1.005, "tied", ha="left", **place)
    ax.text(end * 1.3, 1.005, "nothing added", ha="right", **place)
    axes[0].set_yticks(y, names, fontsize=8)
    axes[0].set_ylim(y.min() - 0.8, 0.4)
    for tick, r in zip(axes[0].get_yticklabels(), role, strict=True):
        tick.set_fontweight("bold" if r == 1 else "normal")
    for own in axes:
        own.grid(False, axis="y")
        own.tick_params(axis="y", length=0)
    style.legend_above(figure, [Patch(color=ROLES[r][0]) for r in roles], [ROLES[r][1] for r in roles], len(roles))
    left = " Left: part of the excess χ² of the mean images that it closes. Right:" if whole else " Points:"
    caption = (
        "Every effect that the design can show, fitted alone beside p1, p2 and the rest, and every set that holds."
        f"{left} −2 ln L of means and noise together, with 2 for each free number, behind the best; left of the dashed"
        f" line ({tied:g}) two cannot be told apart, right of the dotted one an effect is worse than none. An effect"
        " holds if what it leaves is no more than chance or tolerance allow, seen pixel by pixel; blocks of pixels, as"
        " here, blur what is strong."
    )
    if not (role == 1).any():
        caption += " None holds."
    else:
        ahead = [n.replace("\n", " ") for n, b, r in zip(names, behind, role, strict=True) if r != 1 and b < behind[0]]
        if ahead:
            caption += f" Ahead at this first look, but failing pixel by pixel: {', '.join(ahead)}."
    return style.Drawing(figure, caption)


FIGURES = (
    Entry("missing-where", "Where simulation and measurement disagree", Category.MISSING, VERDICT, where),
    Entry("missing-evidence", "How well each effect explains it", Category.MISSING, VERDICT, evidence),
)
