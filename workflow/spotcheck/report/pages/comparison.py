"""The page that compares several datasets."""

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

# Most rows of the table of significant changes and of the plot of z, which should fit on a screen. comparison.nc has
# all of them.
MOST_CHANGES, MOST_DRAWN = 100, 20
# Most rows in the table of a group.
MOST_ROWS = 200
# Most datasets, and most conditions, that a sentence lists.
MOST_NAMED, MOST_CONDITIONS = 4, 5
# Height of a row of the plot of z, which has a name above its points, and of everything around the rows [rem].
ROW_REM, FRAME_REM = 2.1, 6.0
RISE, FALL = "▲", "▼"


def write_comparison_page(comparison: Comparison, path: Path, code: str) -> None:
    """Write the page, with links to the reports of the datasets.

    Parameters
    ----------
    comparison : Comparison
        The datasets, their shared numbers and the differences.
    path : Path
        Page to write.
    code : str
        Digest of the code that made the comparison.
    """
    changes = [(row, k) for row in comparison.rows for k, is_changed in enumerate(row.is_changed) if is_changed]
    content: dict[str, Any] = {
        "title": f"Comparison of {list_text([dataset.label for dataset in comparison.datasets])}",
        "datasets": [_describe_dataset(comparison, k, path) for k in range(len(comparison.datasets))],
        "summary": _summarize(comparison, changes),
        "other_effects": _compare_effects(comparison.datasets),
        "false_alarms": f"{100 * FALSE_ALARM_RATE:g} %",
        "tested": comparison.tested_changes,
        "changes": changes[:MOST_CHANGES],
        "omitted_changes": max(len(changes) - MOST_CHANGES, 0),
        "z_plot": _plot_z(comparison),
        "effects": _tabulate_effects(comparison.datasets),
        "groups": list(_tabulate_groups(comparison)),
        "quantities": _quantities_json(comparison),
        "has_trends": len(comparison.datasets) >= MIN_TREND_POINTS,
        "tested_trends": comparison.tested_trends,
        "along": comparison.axis.name,
        "per": comparison.axis.unit,
        "not_compared": [*comparison.remarks, *_list_unshared(comparison)],
        "code": code,
    }
    texts = (
        number_text,
        change_text,
        difference_text,
        z_text,
        direction,
        label_quantity,
        conditions_text,
        probability_text,
    )
    content |= {function.__name__: function for function in texts}
    write_page(path, "comparison.html", **plots.plotly_content(), **content)


def _summarize(comparison: Comparison, changes: Sequence[tuple[Row, int]]) -> str:
    """Return one or two sentences: the first significant change, and the number of others."""
    labels = [dataset.label for dataset in comparison.datasets]
    if not changes:
        more = f" and {len(labels) - MOST_NAMED} more" if len(labels) > MOST_NAMED else ""
        return f"No quantity of {list_text(labels[1:MOST_NAMED])}{more} differs significantly from {labels[0]}."
    row, k = changes[0]
    values = [f"{number_text(row.numbers[at])} in {labels[at]}" for at in (row.first, k)]
    change = f"{label_quantity(row.name)} changed from {values[0]} to {values[1]}."
    others = len({row.name for row, _ in changes}) - 1
    if not others:
        return f"{change} No other quantity changed significantly."
    return f"{change} {others} more of {len(comparison.rows)} quantities changed significantly."


def _compare_effects(datasets: Sequence[DatasetResults]) -> str:
    """Return a sentence on effects that the first verdict and another one do not share; "" if there are none."""
    named = [(d.label, {effect["name"] for effect in d.verdict["effects"]}) for d in datasets if d.verdict]
    parts = []
    for label, names in named[1:]:
        additional, lacking = list_text(sorted(names - named[0][1])), list_text(sorted(named[0][1] - names))
        differences = [f"{verb} {effects}" for verb, effects in (("adds", additional), ("lacks", lacking)) if effects]
        parts += [f"{label} {' and '.join(differences)}"] if differences else []
    more = [f"and {len(parts) - MOST_NAMED} more"] if len(parts) > MOST_NAMED else []
    listed = "; ".join(parts[:MOST_NAMED] + more)
    return f"Effects in the verdicts, relative to {named[0][0]}: {listed}." if parts else ""


def number_text(number: Measurement) -> str:
    """Return a number with its error and unit; a dash if it is absent."""
    return "–" if np.isnan(number.value) else quantity_text(number.value, number.stderr, number.units)


def change_text(change: Change, units: str) -> str:
    """Return a difference or slope with its sign, error and unit."""
    text = quantity_text(change.value, change.stderr, units)
    return text if text.startswith("−") else f"+{text}"


def difference_text(change: Change, units: str) -> str:
    """Return a difference, "equal" if it is 0 and has no error, "" if it is unknown."""
    if np.isnan(change.value):
        return ""
    return "equal" if change.value == 0 and np.isnan(change.z) else change_text(change, units)


def z_text(z: float) -> str:
    """Return z with its sign, from ±10 on without decimals; "" if it is unknown."""
    if not np.isfinite(z):
        return ""
    return (f"{z:+.1f}" if abs(z) < 10 else f"{z:+.0f}").replace("-", "−")


def direction(change: Change) -> str:
    """Return an arrow up for a positive difference or slope, or else an arrow down."""
    return RISE if change.value > 0 else FALL


def _describe_dataset(comparison: Comparison, k: int, path: Path) -> dict[str, Any]:
    """Return a row of the table of datasets; `path` is the page, to which links are relative."""
    dataset = comparison.datasets[k]
    report, verdict = dataset.folder / "report.html", dataset.verdict
    changed = sum(row.is_changed[k] for row in comparison.rows)
    tested = sum(np.isfinite(row.changes[k].p_value) for row in comparison.rows)
    # Without an added effect there is no closed gap.
    closed = verdict["gap"]["closed"] if verdict and verdict["effects"] else None
    return {
        "label": dataset.label,
        "title": dataset.title if dataset.title != dataset.label else "",
        "link": Path(os.path.relpath(report, path.parent)).as_posix() if report.is_file() else "",
        "frames": ", ".join(f"{count} {kind}" for kind, count in dataset.frames.items()),
        "date": f"{dataset.mean_time:%Y-%m-%d}" if dataset.mean_time else "",
        "status": verdict["status"].replace("_", " ") if verdict else "no verdict",
        "sentence": verdict["sentence"].splitlines()[0] if verdict else "",
        "closed": "–" if closed is None else percent_text(min(closed, 1.0)),
        "changed": "the reference" if k == 0 else f"{changed} of {tested} quantities",
    }


def _largest_z(row: Row) -> float:
    """Return the largest |z| of the differences of a row; 0 if none was tested."""
    return max((abs(change.z) for change in row.changes if np.isfinite(change.z)), default=0.0)


def _plot_z(comparison: Comparison) -> dict[str, Any] | None:
    """Return the plot of z of the quantities that differ most; None if no difference was tested."""
    tested = [row for row in comparison.rows if np.isfinite([change.z for change in row.changes]).any()]
    if not tested:
        return None
    rows = sorted(tested, key=_largest_z, reverse=True)[:MOST_DRAWN]
    points: dict[bool, list[tuple[float, str, str]]] = {True: [], False: []}
    for row in rows:
        for dataset, number, change, is_changed in zip(
            comparison.datasets, row.numbers, row.changes, row.is_changed, strict=True
        ):
            if np.isfinite(change.z):
                text = f"{number_text(number)}, {change_text(change, row.units)}, z = {z_text(change.z)}"
                points[is_changed].append((round(change.z, 3), label_quantity(row.name), f"{dataset.label}: {text}"))
    changed = ", ".join(label_quantity(row.name) for row in rows if any(row.is_changed)) or "none"
    return {
        "figure": plots.figure_json(_z_traces(points), _z_layout(rows, points)),
        "alt": f"Differences from {comparison.datasets[0].label} over their errors. Significant: {changed}.",
        "height": f"{FRAME_REM + ROW_REM * len(rows):g}rem",
        "omitted": len(comparison.rows) - len(rows),
    }


def _z_traces(points: dict[bool, list[tuple[float, str, str]]]) -> list[dict[str, Any]]:
    """Return the traces of the plot of z: significant points (z, row, hover text) are filled, others open."""
    styles = {
        True: {"symbol": "circle", "size": 11, "color": "var(--simulated)"},
        False: {"symbol": "circle-open", "size": 9, "color": "var(--measured)", "line": {"width": 2}},
    }
    traces = []
    for is_changed, members in points.items():
        if members:
            z, names, texts = zip(*members, strict=True)
            traces.append({
                "type": "scatter", "mode": "markers", "name": "significant" if is_changed else "not significant",
                "marker": styles[is_changed], "cliponaxis": False, "x": z, "y": names, "text": texts,
                "hovertemplate": "%{y}<br>%{text}<extra></extra>",
            })  # fmt: skip
    return traces


def _z_layout(rows: Sequence[Row], points: dict[bool, list[tuple[float, str, str]]]) -> dict[str, Any]:
    """Return the layout of the plot of z; the range of its axis has a margin and includes 0."""
    z = [0.0, *(point[0] for members in points.values() for point in members)]
    margin = 0.05 * max(max(z) - min(z), 1.0)
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
    """Return each effect that a verdict names, with its state in every verdict."""
    verdicts = [dataset.verdict for dataset in datasets]
    names = dict.fromkeys(effect["name"] for verdict in verdicts if verdict for effect in verdict["effects"])
    return [(name, [_effect_state(name, verdict) for verdict in verdicts]) for name in names]


def _effect_state(name: str, verdict: dict[str, Any] | None) -> str:
    """Return whether a verdict names an effect, and otherwise its upper limit or why there is none."""
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
    """Yield each group of quantities with their values in every dataset."""
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
    """Return the data of comparison.js: values of each quantity, significant trends first, then significant changes."""
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
    """Return the slope of a quantity over the datasets; "" if it is unknown."""
    trend = row.trend
    if not np.isfinite(trend.value):
        return ""
    slope = f"slope {change_text(trend, row.units)} per {comparison.axis.unit}"
    if not np.isfinite(trend.z):
        return f"{slope}, without an error"
    return f"{slope}, z = {z_text(trend.z)}: {'significant' if row.has_trend else 'not significant'}"


def _list_unshared(comparison: Comparison) -> Iterator[str]:
    """Yield sentences on quantities and conditions of one dataset only, and on stages that were skipped in one."""
    shared = {row.name for row in comparison.rows}
    for dataset in comparison.datasets:
        names = [name for name in dataset.numbers if name not in shared]
        quantities = list(dict.fromkeys(name.quantity for name in names if not name.conditions))
        conditions = list(dict.fromkeys(conditions_text(name.conditions) for name in names if name.conditions))
        if quantities:
            yield f"Only {dataset.label} has {list_text(quantities)}"
        if conditions:
            more = len(conditions) - MOST_CONDITIONS
            listed = list_text(conditions[:MOST_CONDITIONS])
            yield f"Only {dataset.label} has spots at {listed}" + (f", and {more} more conditions" if more > 0 else "")
        for stage, why in dataset.skipped.items():
            if any(stage not in other.skipped for other in comparison.datasets):
                yield f"{dataset.label} has no {stage}: {why}"
