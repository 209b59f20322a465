"""Figures about the rival worlds of the paper's frames, from the stored result data/rival_worlds.json.

A world is a forward model that was fitted to a part of the printed numbers (`spotcheck.paper.rivals`). The figures
answer three questions: is the law p1 ln t + p2 a spread of light, what else could it be, and what would settle it.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap

from spotcheck.model.propagation import beam_propagation
from spotcheck.paper.rivals.inference import DECISIVE_LOG_RATIO
from spotcheck.paper.rivals.predictions import SEPARATION, SHORT_EXPOSURES_S
from spotcheck.paper.rivals.summaries import MIDDLE_S
from spotcheck.paper.rivals.worlds import EXPOSURES_S, LASER_PX
from spotcheck.report.figures import style

# Content of rival_worlds.json by key, or that of one of its worlds, summaries or predictions.
Record = dict[str, Any]
# A world misses a number at p-values below `MISSED_P`. Limits of the colours, from low p-values to high ones.
MISSED_P = 0.05
P_LIMITS = (0.0, 0.01, MISSED_P, 1.0)
P_COLOURS = ("#E69F00", "#F7DFA8", "white")
# Ratios below this one are shares, which are written in per cent.
LARGEST_SHARE = 0.1
# Limits and ticks of the axis of light over that of a Lambertian surface [1].
GAIN_LIMITS, GAIN_TICKS = (1.0, 300.0), (1.0, 10.0, 100.0)
# Column of the printed values in the table of held-out numbers.
PRINTED_COLUMN = "print"
# Strokes and gaps of the lines of the worlds, in line widths.
DASHES = ((6, 2), (6, 2, 1.2, 2), (1.2, 1.6), (3, 1.5), (9, 2, 3, 2), (6, 1.5, 1, 1, 1, 1.5))


def draw_law(record: Record) -> style.Drawing:
    """Draw the fitted width over the exposure, as printed and as each world has it."""
    figure = style.new_figure(3.6)
    ax = figure.add_subplot()
    names = [summary["name"] for summary in record["summaries"]]
    printed = {summary["name"]: summary["printed"] for summary in record["summaries"]}
    measured_us = 1e6 * np.geomspace(EXPOSURES_S[0], EXPOSURES_S[-1], 50)

    def law_px(values: dict[str, float]) -> np.ndarray:
        """Return the fitted width [px] at the measured exposures: p1 ln t + p2 and the laser's own width."""
        p2 = values["broadening_500us"] - values["p1"] * np.log(MIDDLE_S)
        return beam_propagation(1e-6 * measured_us, values["p1"], p2) + LASER_PX

    handles: list[Any] = ax.plot(measured_us, law_px(printed), color="black", linewidth=5, alpha=0.25)
    labels = ["printed p1 ln t + p2"]
    lines = zip(style.line_styles(len(record["worlds"])), DASHES, strict=False)
    for (name, world), (line, dashes) in zip(record["worlds"].items(), lines, strict=True):
        means = dict(zip(names, world["mean"], strict=True))
        ax.plot(measured_us, law_px(means), color=line.colour, dashes=dashes)
        short = [_find_prediction(world, f"fitted width, exposure of {1e6 * t:.0f} µs") for t in SHORT_EXPOSURES_S]
        mean, sd = ([prediction[key] for prediction in short] for key in ("mean", "sd"))
        look = {"color": line.colour, "marker": line.marker, "dashes": dashes, "linewidth": 0.7}
        handles.append(ax.errorbar(1e6 * np.array(SHORT_EXPOSURES_S), mean, yerr=sd, **look))
        labels.append(name)
    ax.set_xscale("log")
    ax.axvspan(measured_us[0], measured_us[-1], facecolor=style.PRINTED, alpha=0.4, zorder=0.4)
    ticks = [1e6 * exposure_s for exposure_s in (*SHORT_EXPOSURES_S, *EXPOSURES_S)]
    ax.set_xticks(ticks, [f"{tick:.0f}" for tick in ticks])
    ax.minorticks_off()
    ax.set(xlabel="exposure time $t$ / µs", ylabel="fitted width / px", ylim=(0, None))
    style.add_legend(figure, handles, labels, 3)
    caption = (
        "Fitted width of the spot over the exposure. Grey: the measured range, with the printed p1 ln t + p2 and that"
        " of each world. Left of it: predictions, mean ± standard deviation over sites. Where the spot itself grows,"
        " the law goes on; a clipped spot of constant width no longer shrinks once no pixel is clipped."
    )
    return style.Drawing(figure, caption)


def draw_held_out(record: Record) -> style.Drawing:
    """Draw a table of held-out numbers: print and mean ± standard deviation of each world, coloured by p-value."""
    rows = [k for k, summary in enumerate(record["summaries"]) if not summary["is_fitted"]]
    worlds = record["worlds"]
    figure = style.new_figure(0.9 + 0.27 * len(rows))
    ax = figure.add_subplot()
    p_values = np.array([[world["p_values"][k] for world in worlds.values()] for k in rows])
    colours = ListedColormap(P_COLOURS)
    cells = np.column_stack([np.full(len(rows), 1.0), p_values])
    ax.pcolormesh(cells, cmap=colours, norm=BoundaryNorm(P_LIMITS, len(P_COLOURS)), edgecolors="0.85", linewidth=0.6)
    labels = []
    for i, k in enumerate(rows):
        summary = record["summaries"][k]
        sign = "< " if summary["is_limit"] else ""
        factor, label = _choose_row_unit(summary)
        labels.append(label)
        _write_cell(ax, 0, i, f"{sign}{factor * summary['printed']:.3g}", weight="bold")
        for j, world in enumerate(worlds.values()):
            _write_cell(ax, j + 1, i, f"{factor * world['mean'][k]:.3g} ± {factor * world['sd'][k]:.2g}")
    ax.set_yticks(np.arange(len(rows)) + 0.5, labels)
    ax.set_xticks(np.arange(len(worlds) + 1) + 0.5, [PRINTED_COLUMN, *(name.replace(" ", "\n") for name in worlds)])
    ax.tick_params(length=0, top=True, labeltop=True, bottom=False, labelbottom=False)
    ax.invert_yaxis()
    ax.grid(False)
    missed = ", ".join(f"{name} {int((p_values[:, j] < MISSED_P).sum())}" for j, name in enumerate(worlds))
    caption = (
        "Held-out numbers: print, and mean ± standard deviation of each world over realisations of the experiment."
        " Orange: a world misses the print (two-sided p below 0.01; pale: below 0.05)."
        f" Missed of {len(rows)}: {missed}."
    )
    return style.Drawing(figure, caption)


def draw_scores(record: Record) -> style.Drawing:
    """Draw the predictive log score and the photon gain of each world, and how often simulated sets are recognised."""
    worlds = record["worlds"]
    figure = style.new_figure(3.3)
    grid = figure.add_gridspec(1, 3, width_ratios=(1, 0.8, 1.5))
    score_ax = figure.add_subplot(grid[0])
    gain_ax = figure.add_subplot(grid[1], sharey=score_ax)
    table_ax = figure.add_subplot(grid[2])
    y = np.arange(len(worlds))
    scores = np.array([world["log_score"] for world in worlds.values()])
    score_ax.barh(y, scores - scores.max(), color=style.MEASURED, height=0.6)
    score_ax.axvline(-DECISIVE_LOG_RATIO, color="0.3", linestyle=style.DASHED)
    score_ax.set_yticks(y, list(worlds))
    lowest = min(-2 * DECISIVE_LOG_RATIO, 1.1 * (scores - scores.max()).min())
    score_ax.set(xlabel="log score − best", xlim=(lowest, 0.5))
    score_ax.invert_yaxis()
    gain_ax.plot([world["photon_gain"] for world in worlds.values()], y, "o", color=style.SIMULATED)
    gain_ax.set(xscale="log", xlabel="light / Lambertian", xlim=GAIN_LIMITS)
    gain_ax.set_xticks(GAIN_TICKS, [f"{tick:.0f}" for tick in GAIN_TICKS])
    gain_ax.minorticks_off()
    gain_ax.tick_params(labelleft=False)
    columns = [*worlds, "cannot tell"]
    counts = np.array([[record["recovery"][name][column] for column in columns] for name in worlds])
    _shade_table(table_ax, counts, columns, vmin=0, vmax=1.6 * max(counts.max(), 1))
    for (i, j), count in np.ndenumerate(counts):
        _write_cell(table_ax, j, i, str(count))
    table_ax.set(title=f"named, of {counts[0].sum()} sets of a world")
    preferred = record["preferred"]
    caption = (
        "Left: predictive log score of the held-out numbers, relative to the best world; dashed: a factor of"
        f" {np.exp(DECISIVE_LOG_RATIO):.0f} in likelihood, which decides. "
        + (f"The print prefers: {preferred}." if preferred else "The print does not decide between the best worlds.")
        + " Middle: light that the world needs at 900 µs, over that of a Lambertian surface of 2 % reflectance. Right:"
        " which world is named for simulated sets of each world (same rows as left)."
    )
    return style.Drawing(figure, caption)


def draw_experiments(record: Record) -> style.Drawing:
    """Draw what each world predicts for three experiments, and the frames that separate each pair of worlds."""
    worlds = record["worlds"]
    # Label of the axis of each experiment.
    labels = {
        "fitted width, exposure of 10 µs": "width / px\nat 10 µs",
        "largest reading, 900 µs behind a filter of 1 %": "largest reading / DN\nat 900 µs, 1 % filter",
        "radius at 20 % over radius at 80 % of the profile, exposure of 30 µs":
            "$r_{20\\,\\%}/r_{80\\,\\%}$\nat 30 µs",
    }  # fmt: skip
    figure = style.new_figure(3.1)
    grid = figure.add_gridspec(1, 4, width_ratios=(1, 1, 1, 1.4))
    y = np.arange(len(worlds))
    styles = style.line_styles(len(worlds))
    first = None
    for k, (experiment, label) in enumerate(labels.items()):
        ax = figure.add_subplot(grid[k], sharey=first)
        for row, world, line in zip(y, worlds.values(), styles, strict=True):
            prediction = _find_prediction(world, experiment)
            ax.errorbar(prediction["mean"], row, xerr=prediction["sd"], color=line.colour, marker=line.marker)
        ax.set_xlabel(label, fontsize=8)
        if first is None:
            first = ax
            ax.set_yticks(y, list(worlds))
            ax.set_ylim(len(worlds) - 0.5, -0.5)
        else:
            ax.tick_params(labelleft=False)
    table_ax = figure.add_subplot(grid[3])
    frames = np.array(record["frames_to_separate"])
    _shade_table(table_ax, np.log10(np.maximum(frames, 1)), list(worlds), vmax=4)
    for i, j in np.argwhere(~np.eye(len(worlds), dtype=bool)):
        _write_cell(table_ax, int(j), int(i), f"{frames[i, j]:.0f}" if np.isfinite(frames[i, j]) else "∞")
    table_ax.set_title("frames to separate two", fontsize=8.5)
    caption = (
        "Predictions of the worlds for short exposures and for a neutral-density filter, mean ± standard deviation of a"
        f" frame. Right: frames of each world whose means differ by {SEPARATION:.0f} standard errors in the best of the"
        " quantities predicted."
    )
    return style.Drawing(figure, caption)


# File name without suffix and drawing function of each figure, in the order of the questions.
DRAWINGS: Sequence[tuple[str, Callable[[Record], style.Drawing]]] = (
    ("rivals-law", draw_law),
    ("rivals-held-out", draw_held_out),
    ("rivals-scores", draw_scores),
    ("rivals-experiments", draw_experiments),
)


def _find_prediction(world: Record, experiment: str) -> Record:
    """Return the prediction of a world for an experiment, with the keys mean and sd."""
    return next(row for row in world["predictions"] if row["experiment"] == experiment)


def _choose_row_unit(summary: Record) -> tuple[float, str]:
    """Return a factor for the values of a summary, and its label: name and unit of the values times this factor.

    The keys of `summary` are the fields of `spotcheck.paper.rivals.summaries.Summary`.
    """
    name = summary["name"].replace("_sd", " sd").replace("_", " ")
    if summary["unit"] == "1" and summary["printed"] < LARGEST_SHARE:
        return 100.0, style.axis_label(name, "%")
    divisor, power_text = style.choose_power_of_ten(summary["printed"])
    return 1 / divisor, style.axis_label(name, power_text + summary["unit"] if summary["unit"] != "1" else "")


def _shade_table(ax: Axes, values: np.ndarray, columns: Sequence[str], **limits: Any) -> None:
    """Draw a table whose cells are shaded by their values [row, column]; `limits` are those of the shades."""
    ax.pcolormesh(values, cmap="Blues", edgecolors="0.85", linewidth=0.6, **limits)
    ax.set_yticks([])
    ax.set_xticks(np.arange(len(columns)) + 0.5, columns, rotation=60, ha="right", rotation_mode="anchor")
    ax.invert_yaxis()
    ax.grid(False)


def _write_cell(ax: Axes, column: int, row: int, text: str, **attributes: Any) -> None:
    """Write a text in the middle of a cell of a table that is drawn with cells of side 1."""
    ax.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=7.5, **attributes)
