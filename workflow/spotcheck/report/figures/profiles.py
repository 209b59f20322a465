"""Radial profiles of measured and simulated frames, and what is left between them."""

from typing import NamedTuple

import numpy as np

from spotcheck.io import store
from spotcheck.report.figures import series, style
from spotcheck.report.figures.entry import Category, Entry
from spotcheck.report.figures.frames_of import Spot, residual_frames
from spotcheck.report.figures.results import Results, Unavailable

VIEW = 4.5  # radius shown, in fitted widths
MOST_PANELS = 12


class Profile(NamedTuple):
    """Mean of rings one pixel wide [radius] in DN: mean and scatter over frames, measured, simulated, residual."""

    radius: np.ndarray
    measured: np.ndarray
    simulated: np.ndarray
    residual: np.ndarray
    scatter: np.ndarray
    frames: int
    name: str


def rings(image: np.ndarray, at: Spot, count: int) -> np.ndarray:
    """Mean [DN] of the pixels in rings of 1 px around a centre, `count` of them; NaN where a ring is empty."""
    y, x = np.indices(image.shape)
    ring = np.hypot(y - at.row, x - at.column).astype(int)
    good = np.isfinite(image) & (ring < count)
    number = np.bincount(ring[good], minlength=count)
    return np.bincount(ring[good], image[good], minlength=count) / np.where(number, number, np.nan)


def profiles(results: Results) -> list[Profile]:
    """One profile an exposure (and a declared condition, where there is one), over all its frames."""
    crops = results.get("crops")
    kept = [d for d in store.grid_dims(crops) if d == "exposure" or d not in series.UNITS]
    out = []
    for at in np.ndindex(*(crops.sizes[d] for d in kept)):
        fixed = dict(zip(kept, at, strict=True))
        rows = []
        for image, model, found in residual_frames(results, fixed):
            count = min(image.shape) // 2
            rows.append([rings(image, found, count), rings(model, found, count)])
        if not rows:
            continue
        stack = np.array(rows)
        difference = stack[:, 0] - stack[:, 1]
        words = filter(None, (series.value_text(crops, dim, k) for dim, k in fixed.items()))
        scatter = difference.std(axis=0, ddof=1) if len(rows) > 1 else np.full(stack.shape[2], np.nan)
        mean = stack.mean(axis=0)
        radius = np.arange(stack.shape[2]) + 0.5
        out.append(Profile(radius, mean[0], mean[1], difference.mean(axis=0), scatter, len(rows), ", ".join(words)))
    if not out:
        raise Unavailable("no frame has a fitted spot")
    return out


def draw(results: Results) -> style.Drawing:
    """Profiles above, residual with its scatter beneath, one column a condition."""
    found = profiles(results)
    if len(found) > MOST_PANELS:
        found = [found[k] for k in np.unique(np.linspace(0, len(found) - 1, MOST_PANELS).round().astype(int))]
    columns = min(3, len(found))
    rows = -(-len(found) // columns)
    figure = style.new(0.5 + 2.6 * rows)
    axes = figure.subplots(2 * rows, columns, sharex=True, sharey=False, squeeze=False, height_ratios=(1.6, 1) * rows)
    tops, bottoms = axes[0::2].ravel(), axes[1::2].ravel()
    highest = max(float(np.nanmax(np.maximum(p.measured, p.simulated))) for p in found)
    deepest = max(float(np.nanmax(np.abs(p.residual) + np.nan_to_num(p.scatter))) for p in found)
    reach = _reach(found, highest)
    handles: list = []
    for top, bottom, own in zip(tops, bottoms, found, strict=False):
        (line,) = top.plot(own.radius, own.measured, color=style.MEASURED)
        (dashed,) = top.plot(own.radius, own.simulated, color=style.SIMULATED, linestyle=(0, (5, 2)))
        (left,) = bottom.plot(own.radius, own.residual, color="0.1")
        handles = [line, dashed, left]
        if own.frames > 1:
            for ax, centre in ((top, own.measured), (bottom, own.residual)):
                band = ax.fill_between(
                    own.radius, centre - own.scatter, centre + own.scatter, color="0.6", alpha=0.5, linewidth=0
                )
            handles.append(band)
        bottom.axhline(0, color="0.4", linewidth=0.8)
        top.set(ylim=(-0.04 * highest, 1.06 * highest), xlim=(0, reach))
        bottom.set_ylim(-1.08 * deepest, 1.08 * deepest)
        top.set_title(own.name, pad=3)
    for ax in (*tops[len(found) :], *bottoms[len(found) :]):
        ax.set_axis_off()
    for k in range(len(found)):
        tops[k].tick_params(labelbottom=False)
        if k % columns:
            tops[k].tick_params(labelleft=False)
            bottoms[k].tick_params(labelleft=False)
        else:
            tops[k].set_ylabel("reading / DN")
            bottoms[k].set_ylabel("residual / DN")
        if k + columns >= len(found):
            bottoms[k].tick_params(labelbottom=True)
            bottoms[k].set_xlabel("radius / px")
    labels = ["measured", "simulated", "measured − simulated", "± 1 sd over frames"][: len(handles)]
    style.legend_above(figure, handles, labels, len(handles))
    counts = [p.frames for p in found]
    frames = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
    caption = (
        "Mean reading in rings of 1 px around the fitted centre, measured and simulated (the mean image placed on the"
        f" measured centre), light-centred crops, {frames} frame{'s' if max(counts) > 1 else ''} a panel; beneath,"
        " measured less simulated."
    )
    if max(counts) > 1:
        caption += " Grey: one standard deviation of the residual over frames, not its standard error."
    return style.Drawing(figure, caption)


def _reach(found: list[Profile], highest: float) -> float:
    """Radius [px] beyond which no profile holds a hundredth of the highest reading above its own border."""
    last = 4.0
    for own in found:
        for curve in (own.measured, own.simulated):
            bright = np.flatnonzero(curve - np.nanmin(curve) > 0.01 * highest)
            last = max(last, own.radius[bright[-1]] if bright.size else 0.0)
    return min(1.25 * last, float(found[0].radius[-1]))


FIGURES = (
    Entry(
        "residual-profiles",
        "Radial profiles and their residual",
        Category.RESIDUALS,
        ("crops", "fits", "simulated"),
        draw,
    ),
)
