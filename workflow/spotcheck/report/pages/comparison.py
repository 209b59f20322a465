"""The page that compares several datasets.

A change is the difference of a number from the first dataset that has it; z is the normal deviate with the p-value of
the test against no change. A trend is the slope of a number over the dates or the order of the datasets. The verdict of
a dataset names the effects that the model of its frames lacks. A row is a quantity that datasets share (`table.Row`).
"""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spotcheck.discrepancy.words import list_text, percent_text, probability_text
from spotcheck.io.number_text import UNITS, quantity_text
from spotcheck.report.comparison.changes import FALSE_ALARM_RATE, MIN_TREND_POINTS, Change
from spotcheck.report.comparison.datasets import DatasetResults
from spotcheck.report.comparison.numbers import GROUPS, Measurement
from spotcheck.report.comparison.table import Comparison, Row, conditions_text, label_quantity
from spotcheck.report.pages import plots, write_page

# Most rows of the table of significant changes, and of the plot of z, which should fit on a screen. comparison.nc has
# all of them.
MOST_CHANGES, MOST_DRAWN = 100, 20
# Most rows in the table of a group.
MOST_ROWS = 200
# Most datasets and most conditions that a sentence lists.
MOST_NAMED, MOST_CONDITIONS = 4, 5
# Heights in the plot of z [rem]: of a row, which has its name above its points, and of all margins together.
ROW_REM, FRAME_REM = 2.1, 6.0
RISE, FALL = "▲", "▼"
# Margin of the abscissa of the plot of z at each end, as a share of its range.
Z_MARGIN = 0.05
# From this |z| on, z is written without decimals.
LARGE_Z = 10

Point = tuple[float, str, str]  # point of the plot of z: z, name of its row, text on hover


def write_comparison_page(comparison: Comparison, path: Path, code: str) -> None:
    """Write comparison.html, with links to the reports of the datasets.

    Parameters
    ----------
    comparison : Comparison
        The datasets, their shared numbers, the differences and the trends.
    path : Path
        Page to write.
    code : str
        Digest of the code that made the comparison.
    """
    # Each significant change as its row and the index of its dataset.
    changes = [(row, k) for row in comparison.rows for k, is_changed in enumerate(row.is_changed) if is_changed]
    content: dict[str, Any] = {
        "comparison": comparison,
        "title": f"Comparison of {list_text([dataset.label for dataset in comparison.datasets])}",
        "datasets": [_describe_dataset(comparison, k, path) for k in range(len(comparison.datasets))],
        "summary": _summarize(comparison, changes),
        "other_effects": _compare_effects(comparison.datasets),
        "false_alarms": f"{100 * FALSE_ALARM_RATE:g} %",
        "changes": changes[:MOST_CHANGES],
        "omitted_changes": max(len(changes) - MOST_CHANGES, 0),
        "z_plot": _plot_z(comparison),
        "effects": _tabulate_effects(comparison.datasets),
        "groups": list(_tabulate_groups(comparison)),
        "quantities": _quantities_json(comparison),
        "has_trends": len(comparison.datasets) >= MIN_TREND_POINTS,
        "not_compared": [*comparison.remarks, *_list_unshared(comparison)],
        "code": code,
    }
    # Functions that the template calls by their names.
    formatters = [number_text, change_text, difference_text, z_text, direction]
    formatters += [label_quantity, conditions_text, probability_text]
    content |= {function.__name__: function for function in formatters}
    write_page(path, "comparison.html", **plots.plotly_content(), **content)


def _summarize(comparison: Comparison, changes: Sequence[tuple[Row, int]]) -> str:
    """Return one or two sentences: the first significant change, and the number of other changed quantities.

    `changes` are pairs of a row and the index of the dataset that changed.
    """
    labels = [dataset.label for dataset in comparison.datasets]
    if not changes:
        more = f" and {len(labels) - MOST_NAMED} more" if len(labels) > MOST_NAMED else ""
        return f"No quantity of {list_text(labels[1:MOST_NAMED])}{more} differs significantly from {labels[0]}."
    row, k = changes[0]
    values = [f"{number_text(row.numbers[index])} in {labels[index]}" for index in (row.first, k)]
    change = f"{label_quantity(row.name)} changed from {values[0]} to {values[1]}."
    other_count = len({row.name for row, _ in changes}) - 1
    if not other_count:
        return f"{change} No other quantity changed significantly."
    return f"{change} {other_count} more of {len(comparison.rows)} quantities changed significantly."


def _compare_effects(datasets: Sequence[DatasetResults]) -> str:
    """Return a sentence on effects that the first verdict and another one do not share; "" if there are none."""
    effects = [(d.label, {effect["name"] for effect in d.verdict["effects"]}) for d in datasets if d.verdict]
    clauses = []
    for label, names in effects[1:]:
        additional, lacking = list_text(sorted(names - effects[0][1])), list_text(sorted(effects[0][1] - names))
        differences = [f"{verb} {listed}" for verb, listed in (("adds", additional), ("lacks", lacking)) if listed]
        clauses += [f"{label} {' and '.join(differences)}"] if differences else []
    more = [f"and {len(clauses) - MOST_NAMED} more"] if len(clauses) > MOST_NAMED else []
    listed_clauses = "; ".join(clauses[:MOST_NAMED] + more)
    return f"Effects in the verdicts, relative to {effects[0][0]}: {listed_clauses}." if clauses else ""


def number_text(number: Measurement) -> str:
    """Return a number with its error and unit; a dash if it is absent."""
    return "–" if np.isnan(number.value) else quantity_text(number.value, number.stderr, number.units)


def change_text(change: Change, units: str) -> str:
    """Return a difference or slope with its sign, error and unit: `+0.12 ± 0.03 px`."""
    text = quantity_text(change.value, change.stderr, units)
    return text if text.startswith("−") else f"+{text}"


def difference_text(change: Change, units: str) -> str:
    """Return a difference as `change_text` does; "equal" if it is 0 without an error, "" if it is unknown."""
    if np.isnan(change.value):
        return ""
    return "equal" if change.value == 0 and np.isnan(change.z) else change_text(change, units)


def z_text(z: float) -> str:
    """Return z with its sign, with one decimal below `LARGE_Z`; "" if it is unknown."""
    if not np.isfinite(z):
        return ""
    return (f"{z:+.1f}" if abs(z) < LARGE_Z else f"{z:+.0f}").replace("-", "−")


def direction(change: Change) -> str:
    """Return an arrow: up for a positive difference or slope, else down."""
    return RISE if change.value > 0 else FALL


def _describe_dataset(comparison: Comparison, k: int, path: Path) -> dict[str, Any]:
    """Return the texts of the dataset with index `k` in the table of datasets, by the names that the template uses.

    The link to its report is relative to the page at `path`.
    """
    dataset = comparison.datasets[k]
    report, verdict = dataset.folder / "report.html", dataset.verdict
    changed = sum(row.is_changed[k] for row in comparison.rows)
    tested = sum(np.isfinite(row.changes[k].p_value) for row in comparison.rows)
    # Share of the gap between model and frames that the added effects close; None without an added effect.
    closed = verdict["gap"]["closed"] if verdict and verdict["effects"] else None
    return {
        "label": dataset.label,
        "title": dataset.title if dataset.title != dataset.label else "",
        "link": Path(os.path.relpath(report, path.parent)).as_posix() if report.is_file() else "",
        "frames": ", ".join(f"{count} {kind}" for kind, count in dataset.frames.items()),
        "date": f"{dataset.mean_time:%Y-%m-%d}" if dataset.mean_time else "",
        "status": verdict["status"].replace("_", " ") if verdict else "no verdict",
        "sentence": verdict["sentence"].splitlines()[0] if verdict else "",
        # Noise may raise the closed share above 1.
        "closed": "–" if closed is None else percent_text(min(closed, 1.0)),
        "changed": "the reference" if k == 0 else f"{changed} of {tested} quantities",
    }


def _largest_z(row: Row) -> float:
    """Return the largest |z| of the differences of a row; 0 if none was tested."""
    return max((abs(change.z) for change in row.changes if np.isfinite(change.z)), default=0.0)


def _plot_z(comparison: Comparison) -> dict[str, Any] | None:
    """Return the plot of z for the quantities with the largest |z|; None if no difference was tested.

    The keys are `figure` (Plotly figure as JSON), `alt` (text in place of the figure), `height` (CSS length) and
    `omitted` (number of quantities that are not shown).
    """
    tested = [row for row in comparison.rows if np.isfinite([change.z for change in row.changes]).any()]
    if not tested:
        return None
    rows = sorted(tested, key=_largest_z, reverse=True)[:MOST_DRAWN]
    # Points by whether their change is significant.
    points: dict[bool, list[Point]] = {True: [], False: []}
    for row in rows:
        for dataset, number, change, is_changed in zip(
            comparison.datasets, row.numbers, row.changes, row.is_changed, strict=True
        ):
            if np.isfinite(change.z):
                text = f"{number_text(number)}, {change_text(change, row.units)}, z = {z_text(change.z)}"
                points[is_changed].append((round(change.z, 3), label_quantity(row.name), f"{dataset.label}: {text}"))
    changed = ", ".join(label_quantity(row.name) for row in rows if any(row.is_changed)) or "none"
    return {
        "figure": plots.figure_json(_build_z_traces(points), _build_z_layout(rows, points)),
        "alt": f"Differences from {comparison.datasets[0].label} over their errors. Significant: {changed}.",
        "height": f"{FRAME_REM + ROW_REM * len(rows):g}rem",
        "omitted": len(comparison.rows) - len(rows),
    }


def _build_z_traces(points: dict[bool, list[Point]]) -> list[dict[str, Any]]:
    """Return the Plotly traces of the plot of z: significant points (True) are filled, others open."""
    styles = {
        True: {"symbol": "circle", "size": 11, "color": "var(--simulated)"},
        False: {"symbol": "circle-open", "size": 9, "color": "var(--measured)", "line": {"width": 2}},
    }
    traces = []
    for is_changed, points_of_trace in points.items():
        if points_of_trace:
            z, names, texts = zip(*points_of_trace, strict=True)
            traces.append({
                "type": "scatter", "mode": "markers", "name": "significant" if is_changed else "not significant",
                "marker": styles[is_changed], "cliponaxis": False, "x": z, "y": names, "text": texts,
                "hovertemplate": "%{y}<br>%{text}<extra></extra>",
            })  # fmt: skip
    return traces


def _build_z_layout(rows: Sequence[Row], points: dict[bool, list[Point]]) -> dict[str, Any]:
    """Return the Plotly layout of the plot of z; the range of the abscissa has a margin and includes 0."""
    z = [0.0, *(point[0] for points_of_trace in points.values() for point in points_of_trace)]
    margin = Z_MARGIN * max(max(z) - min(z), 1.0)
    # The first category of Plotly is at the bottom.
    order = [label_quantity(row.name) for row in rows][::-1]
    # Names are placed above their points, so that they fit into a narrow window.
    names = [
        {"text": name, "x": 0, "xref": "paper", "xanchor": "left", "y": name, "yanchor": "bottom", "showarrow": False}
        for name in order
    ]
    return {
        "xaxis": {"title": {"text": "difference over its error, z"}, "range": [min(z) - margin, max(z) + margin]}
        | {"zerolinecolor": "var(--soft)", "zerolinewidth": 2},
        "yaxis": {"categoryorder": "array", "categoryarray": order, "range": [-0.5, len(rows) - 0.2]}
        | {"dtick": 1, "showticklabels": False, "fixedrange": True},
        "annotations": names,
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"},
        "margin": {"l": 8, "r": 12, "t": 36, "b": 44},
        "hovermode": "closest",
        "showlegend": True,
    }


def _tabulate_effects(datasets: Sequence[DatasetResults]) -> list[tuple[str, list[str]]]:
    """Return a row for each effect that a verdict names: its name, and its state in the verdict of each dataset."""
    verdicts = [dataset.verdict for dataset in datasets]
    names = dict.fromkeys(effect["name"] for verdict in verdicts if verdict for effect in verdict["effects"])
    return [(name, [_effect_state(name, verdict) for verdict in verdicts]) for name in names]


def _effect_state(name: str, verdict: dict[str, Any] | None) -> str:
    """Return in words whether a verdict names an effect, and otherwise its upper limit or why there is none."""
    if verdict is None:
        return "no verdict"
    for effect in verdict["effects"]:
        if effect["name"] == name:
            rivals = [candidate for candidate in effect["candidates"] if candidate != name]
            text = f"named ({effect['form']})" if effect["form"] else "named"
            return f"{text}, or {list_text(rivals)}" if rivals else text
    for limit in verdict["limits"]:
        if limit["effect"] == name:
            return f"{limit['why']}; {limit['words']} (95 %)" if limit["words"] else limit["why"]
    reasons = [entry["why"] for entry in verdict["not_assessed"] if entry["effect"] in (name, "all")]
    return f"not assessed: {reasons[0]}" if reasons else "not named"


def _tabulate_groups(comparison: Comparison) -> Iterator[dict[str, Any]]:
    """Yield the content of the table of each group of quantities, by the names that the template uses.

    A group with more than `MOST_ROWS` rows is reduced to the rows with the largest |z|.
    """
    for group in GROUPS:
        rows = [row for row in comparison.rows if row.name.group == group]
        if rows:
            shown = sorted(rows, key=_largest_z, reverse=True)[:MOST_ROWS] if len(rows) > MOST_ROWS else rows
            yield {
                "name": group,
                "count": len(rows),
                "changed": sum(any(row.is_changed) for row in rows),
                "omitted": len(rows) - len(shown),
                "errors": sorted({number.error for row in rows for number in row.numbers if number.error}),
                "rows": shown,
            }


def _quantities_json(comparison: Comparison) -> str:
    """Return the data of comparison.js as JSON: the values of each quantity and its trend.

    Quantities with significant trends come first, then those with significant changes.
    """
    rows = sorted(comparison.rows, key=lambda row: (not row.has_trend, not any(row.is_changed)))
    quantities = [
        {
            "name": label_quantity(row.name),
            "group": row.name.group,
            "prefix": "trend: " if row.has_trend else "changed: " if any(row.is_changed) else "",
            "unit": UNITS.get(row.units, row.units),
            "values": [number.value for number in row.numbers],
            "errors": [number.stderr for number in row.numbers],
            "texts": [number_text(number) for number in row.numbers],
            "line": [row.intercept, row.trend.value] if np.isfinite(row.trend.value) else None,
            "trend": _trend_text(comparison, row),
        }
        for row in rows
    ]
    content = {
        "along": comparison.axis.name,
        "places": comparison.axis.places,
        "labels": [dataset.label for dataset in comparison.datasets],
        "has_named_ticks": comparison.axis.unit == "dataset",
        "quantities": quantities,
    }
    return plots.embed_json(content)


def _trend_text(comparison: Comparison, row: Row) -> str:
    """Return the slope of a quantity over the datasets, with its z and significance; "" if it is unknown."""
    trend = row.trend
    if not np.isfinite(trend.value):
        return ""
    slope = f"slope {change_text(trend, row.units)} per {comparison.axis.unit}"
    if not np.isfinite(trend.z):
        return f"{slope}, without an error"
    return f"{slope}, z = {z_text(trend.z)}: {'significant' if row.has_trend else 'not significant'}"


def _list_unshared(comparison: Comparison) -> Iterator[str]:
    """Yield sentences without full stop on quantities, conditions and stages that other datasets do not share."""
    shared = {row.name for row in comparison.rows}
    for dataset in comparison.datasets:
        names = [name for name in dataset.numbers if name not in shared]
        quantities = list(dict.fromkeys(name.quantity for name in names if not name.conditions))
        conditions = list(dict.fromkeys(conditions_text(name.conditions) for name in names if name.conditions))
        if quantities:
            yield f"Only {dataset.label} has {list_text(quantities)}"
        if conditions:
            omitted = len(conditions) - MOST_CONDITIONS
            more = f", and {omitted} more conditions" if omitted > 0 else ""
            yield f"Only {dataset.label} has spots at {list_text(conditions[:MOST_CONDITIONS])}{more}"
        for stage, why in dataset.skipped.items():
            if any(stage not in other.skipped for other in comparison.datasets):
                yield f"{dataset.label} has no {stage}: {why}"
