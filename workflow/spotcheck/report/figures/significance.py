"""Significance of residuals by condition, ring and test, and evidence for each named effect.

z is a residual or a test statistic in standard deviations of noise. The verdict names an effect if adding it to the
model explains the residuals. Its rivals are effects that explain them about as well. The gap is the excess of the
residuals of the declared model (that of the instrument file) over noise, on held-out frames. A ring is a range of
distances from the spot's centre. The azimuthal order m is the number of periods of the residual around the ring.
"""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure

from spotcheck.discrepancy.criteria import MIN_GAIN
from spotcheck.io.number_text import two_digits
from spotcheck.report.figures import series, style
from spotcheck.report.figures.discrepancy import ConditionTable, tabulate_conditions
from spotcheck.report.figures.entry import VERDICT, Category, Entry
from spotcheck.report.figures.results import Results, Unavailable

# Largest number of exposures that are shown.
MAX_COLUMNS = 4
# Largest number of conditions with marks at significant rings, and of conditions with names.
MAX_MARKED_ROWS, MAX_NAMED_ROWS = 24, 12
# Largest number of tests that are shown, the most significant first.
MAX_TESTS = 16
# Look of the line at a threshold.
THRESHOLD: dict[str, Any] = {"color": "black", "linewidth": 0.9, "linestyle": (0, (5, 3))}


def draw_significance(results: Results) -> style.Drawing:
    """Draw z of the residual by condition and ring around the spot, and of the tests of all frames together.

    The panels of rings show z of the mean residual of a ring, and z of its strongest azimuthal order. Raises
    `Unavailable` if no condition has a residual.
    """
    ds = results.get("discrepancy")
    table = tabulate_conditions(ds)
    columns = series.pick_evenly(len(table.columns), MAX_COLUMNS)
    radial, azimuthal, order = (table.read(ds, name) for name in ("z_radial", "z_azimuthal", "z_order"))
    if not np.isfinite(radial).any():
        raise Unavailable("no condition has a residual")
    threshold = float(ds["z_threshold"])
    largest = float(np.nanmax(np.abs([radial, azimuthal])))
    # Colours are linear in z up to the threshold and logarithmic above it; they extend to twice the threshold at least.
    norm = SymLogNorm(threshold, vmin=-max(largest, 2 * threshold), vmax=max(largest, 2 * threshold))
    # Height of a row of panels [inch].
    rings_height = float(np.clip(0.17 * len(table.rows) + 0.25, 0.5, 3.0))
    figure = style.new_figure(2 * rings_height + 4.1)
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(2 * rings_height + 1.4, 2.7))[:, 0]
    axes = upper.subplots(2, len(columns), sharex=True, sharey=True, squeeze=False)
    for (radial_ax, azimuthal_ax), column in zip(axes.T, columns, strict=True):
        _draw_rings(radial_ax, ds, table, radial[:, column], norm, None)
        _draw_rings(azimuthal_ax, ds, table, azimuthal[:, column], norm, order[:, column])
        radial_ax.set_title(table.columns[column])
    for ax, text in zip(axes[:, 0], ("ring mean", "azimuthal"), strict=True):
        ax.set_ylabel(text)
    upper.supxlabel("distance from the spot's centre / $\\sigma_g$", fontsize=9)
    _draw_colour_bar(upper, axes, norm, largest)
    significant_tests = _draw_tests(lower, ds, threshold)
    cells = int(np.isfinite(radial).sum() + np.isfinite(azimuthal).sum())
    significant_cells = int((np.abs(radial) > threshold).sum() + (azimuthal > threshold).sum())
    row_names = " and ".join(style.axis_name(dim) for dim in table.dims if dim in ds.coords)
    percent = two_digits(100 * float(ds.attrs["alpha"]))
    caption = (
        "Above: z of the mean residual by distance from the spot's centre, and below it of its strongest azimuthal"
        f" order (1 one-sided, 2 twofold, …); columns: exposure.{f' Rows: {row_names}.' if any(table.rows) else ''}"
        f" Dots and orders mark |z| > {threshold:.2g}; noise alone exceeds this anywhere in at most {percent} % of all"
        f" data sets ({significant_cells} of {cells} cells do). Bottom: the {min(MAX_TESTS, ds.sizes['part'])} most"
        f" significant of {ds.sizes['part']} tests of all frames together ({significant_tests} exceed the threshold)."
    )
    return style.Drawing(figure, caption)


def _draw_rings(
    ax: Axes, ds: xr.Dataset, table: ConditionTable, z: np.ndarray, norm: SymLogNorm, order: np.ndarray | None
) -> None:
    """Draw z [condition, ring] as colours, and mark significant rings.

    A mark is the azimuthal `order` [condition, ring], or a dot if `order` is None. The conditions are the rows of
    `table`, and `ds` is the content of discrepancy.nc.
    """
    style.show_image(ax, z, style.DIVERGING_MAP, norm, facecolor="0.85", aspect="auto")
    ring_low = ds["ring_low"].values
    ticks = np.arange(0, len(ring_low), 1 if len(table.columns) < MAX_COLUMNS else 2)
    ax.set_xticks(ticks - 0.5, [f"{ring_low[k]:g}" for k in ticks], fontsize=7.5)
    named_rows = series.pick_evenly(len(table.rows), MAX_NAMED_ROWS)
    ax.set_yticks(named_rows, [table.rows[k] for k in named_rows], fontsize=8)
    ax.tick_params(length=2)
    if len(table.rows) > MAX_MARKED_ROWS:
        return
    for i, k in np.argwhere(np.abs(np.nan_to_num(z)) > float(ds["z_threshold"])):
        is_background_dark = abs(norm(z[i, k]) - 0.5) > 0.3
        text = "•" if order is None else f"{order[i, k]:.0f}"
        ax.text(k, i, text, ha="center", va="center", fontsize=7, color="white" if is_background_dark else "black")


def _draw_colour_bar(figure: Figure, axes: np.ndarray, norm: SymLogNorm, largest: float) -> None:
    """Draw the colour bar of z with ticks at 0, ± the threshold and ± powers of ten up to the `largest` |z|.

    `axes` are the axes of the maps [row, column], beside which the bar is drawn.
    """
    threshold = norm.linthresh
    positive = [threshold, *(10.0**power for power in range(1, 5) if 2 * threshold < 10.0**power <= largest)]
    labels = [two_digits(tick) for tick in positive]
    bar = figure.colorbar(ScalarMappable(norm, style.DIVERGING_MAP), ax=list(axes.ravel()), aspect=22, label="z")
    ticks = [*(-tick for tick in reversed(positive)), 0, *positive]
    bar.set_ticks(ticks, labels=[*(f"−{label}" for label in reversed(labels)), two_digits(0), *labels])
    bar.ax.minorticks_off()


def _draw_tests(figure: Figure, ds: xr.Dataset, threshold: float) -> int:
    """Draw |z| of the most significant tests of all frames; return how many of all tests exceed the threshold.

    `ds` is the content of discrepancy.nc, where a test is called `part`.
    """
    ax = figure.subplots()
    z, names = np.abs(ds["part_z"].values), ds["part"].values
    strongest = np.argsort(-z)[:MAX_TESTS]
    y = -np.arange(len(strongest))
    colours = [style.SIMULATED if z[k] > threshold else "0.6" for k in strongest]
    ax.barh(y, np.maximum(z[strongest], 1.0), height=0.7, color=colours)
    ax.axvline(threshold, **THRESHOLD)
    ax.set(xscale="log", xlim=(1.0, max(1.5 * threshold, 2 * float(z[strongest].max(initial=1.0)))))
    ax.set_yticks(y, [str(names[k]) for k in strongest], fontsize=7.5)
    ax.tick_params(axis="y", length=0)
    ax.grid(False, axis="y")
    ax.set_xlabel("|z|")
    return int((z > threshold).sum())


class _Candidate(NamedTuple):
    """A named effect or a rival of it."""

    name: str  # name in the figure; that of a rival begins with "or"
    gain: float | None  # decrease of −2 ln L; None if unknown
    gap_closed: float | None  # fraction of the gap that the effect closes; None for rivals, and if unknown
    colour: str  # colour of the point


def draw_evidence(results: Results) -> style.Drawing:
    """Draw the decrease of −2 ln L by each named effect and its rivals, and the fraction of the gap that it closes.

    Raises `Unavailable` if the verdict names no effect.
    """
    verdict = results.verdict()
    if not verdict["effects"]:
        raise Unavailable("nothing was added to the model")
    candidates = []
    for effect in verdict["effects"]:
        gain = effect["evidence"]["gain"]
        candidates.append(_Candidate(effect["name"], gain, effect["gap_closed"], style.ACCENT))
        for rival in effect["evidence"]["rivals"]:
            # `behind` is how much less a rival decreases −2 ln L than the effect.
            rival_gain = None if gain is None else gain - rival["behind"]
            candidates.append(_Candidate(f"or {rival['name']}", rival_gain, None, style.MEASURED))
    y = -np.arange(len(candidates))
    figure = style.new_figure(1.1 + 0.28 * len(candidates))
    left, right = figure.subplots(1, 2, sharey=True)
    for height, candidate in zip(y, candidates, strict=True):
        # A logarithmic axis cannot show a gain of 0 or less.
        if candidate.gain is not None and candidate.gain > 0:
            left.plot(candidate.gain, height, "o", color=candidate.colour)
            left.hlines(height, 1.0, candidate.gain, color=candidate.colour, linewidth=1.4)
        if candidate.gap_closed is not None:
            right.barh(height, 100 * float(np.clip(candidate.gap_closed, 0, 1)), height=0.6, color=candidate.colour)
    left.axvline(MIN_GAIN, **THRESHOLD)
    left.set_yticks(y, [candidate.name for candidate in candidates], fontsize=8)
    left.set(xscale="log", xlim=(1.0, None), ylim=(y.min() - 0.7, 0.7), xlabel="gain in −2 ln L")
    right.set(xlim=(0, 100), xlabel="gap closed / %")
    for ax in (left, right):
        ax.grid(False, axis="y")
        ax.tick_params(axis="y", length=0)
    # Text that names the held-out frames on which the gap was measured; None if no frame was held out.
    held_out = verdict["gap"]["on"]
    caption = (
        "Evidence for each named effect: decrease of −2 ln L of the searched frames by the effect, with all other"
        f" parameters refitted; an effect is named only above {MIN_GAIN:g} (dashed)."
        + (f" Right: the part of the gap on {held_out} that it closes." if held_out else " No frame was held out.")
    )
    return style.Drawing(figure, caption)


FIGURES = (
    Entry("missing-where", "Where simulation and measurement disagree", Category.MISSING, VERDICT, draw_significance),
    Entry("missing-evidence", "Evidence for each named effect", Category.MISSING, VERDICT, draw_evidence),
)
