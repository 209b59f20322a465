"""The comparison: one self-contained page of several datasets."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spotcheck.discrepancy.words import UNITS, list_text, percent_text, probability_text, value_text
from spotcheck.report.comparison.changes import FALSE_ALARM_RATE, MIN_TREND_POINTS, Change
from spotcheck.report.comparison.datasets import DatasetResults
from spotcheck.report.comparison.numbers import GROUPS, Measurement
from spotcheck.report.comparison.table import Comparison, Row, conditions_text, quantity_text
from spotcheck.report.pages import plots, write_page

# Rows of the table of what changed, and of the picture, which should fit on a screen; all of them are in comparison.nc.
MOST_CHANGED, MOST_DRAWN = 100, 20
# Height of a row of the picture, which holds a name above its points, and of what stands around the rows [rem].
ROW_REM, FRAME_REM = 2.1, 6.0
# Rows of a group's table, those that changed most first.
MOST_ROWS = 200
# Datasets that a sentence names.
MOST_NAMED = 4
SIGNS = {True: "▲", False: "▼"}


def write(found: Comparison, path: Path, code: str) -> None:
    """Write comparison.html; links lead from it to the datasets' own reports. `code` is the digest of what made it."""
    marked = _marked(found)
    content: dict[str, Any] = {
        "title": f"Comparison of {list_text([own.label for own in found.datasets])}",
        "sets": [_set(found, k, path) for k in range(len(found.datasets))],
        "lead": _lead(found, marked),
        "named": _named_differently(found.datasets),
        "false_alarms": f"{100 * FALSE_ALARM_RATE:g} %",
        "tested": found.tested_changes,
        "marked": [_changed_row(found, row, k) for row, k in marked[:MOST_CHANGED]],
        "more_marked": max(len(marked) - MOST_CHANGED, 0),
        "picture": _picture(found),
        "effects": _effects(found.datasets),
        "groups": list(_groups(found)),
        "over": _over(found),
        "many": len(found.datasets) >= MIN_TREND_POINTS,
        "tested_trends": found.tested_trends,
        "along": found.axis.name,
        "per": found.axis.unit,
        "alone": list(_alone(found)),
        "remarks": found.remarks,
        "code": code,
        **plots.ingredients(),
    }
    write_page(path, "comparison.html", **content)


def _marked(found: Comparison) -> list[tuple[Row, int]]:
    """Rows and places of all differences beyond chance, parameters before the frames' numbers."""
    return [(row, k) for row in found.rows for k, changed in enumerate(row.is_changed) if changed]


def _lead(found: Comparison, marked: Sequence[tuple[Row, int]]) -> str:
    """What a person would say aloud: the first thing that changed, and how much else did."""
    first = found.datasets[0].label
    if not marked:
        them = list_text([own.label for own in found.datasets[1:MOST_NAMED]])
        more = f" and {len(found.datasets) - MOST_NAMED} more" if len(found.datasets) > MOST_NAMED else ""
        return (
            f"{them}{more} differ{'s' if len(found.datasets) == 2 else ''} from {first} in nothing beyond the errors."
        )
    (row, k), since = marked[0], marked[0][0].first
    change = f"{quantity_text(row.name)} went from {number_text(row.numbers[since])} to {number_text(row.numbers[k])}"
    said = f"From {found.datasets[since].label} to {found.datasets[k].label} {change}."
    others = len({own.name for own, _ in marked}) - 1
    if not others:
        return f"{said} Nothing else changed beyond its errors."
    whose = "their" if others > 1 else "its"
    return f"{said} Of {len(found.rows)} quantities {others} more changed beyond {whose} errors."


def _named_differently(sets: Sequence[DatasetResults]) -> str:
    """A sentence on effects that only one of the first verdict and another one names; "" where there are none."""
    judged = [(own.label, {e["name"] for e in own.verdict["effects"]}) for own in sets if own.verdict]
    parts = []
    for label, names in judged[1:]:
        besides, gone = list_text(sorted(names - judged[0][1])), list_text(sorted(judged[0][1] - names))
        said = ([f"with {besides}"] if besides else []) + ([f"without {gone}"] if gone else [])
        parts += [f"{label} {' and '.join(said)}"] if said else []
    more = [f"and {len(parts) - MOST_NAMED} more"] if len(parts) > MOST_NAMED else []
    told = "; ".join(parts[:MOST_NAMED] + more)
    return f"The verdicts name other effects than that on {judged[0][0]}: {told}." if parts else ""


def number_text(own: Measurement) -> str:
    """A number with its error and unit; a dash where there is none."""
    return "–" if np.isnan(own.value) else value_text(own.value, own.stderr, own.units)


def change_text(own: Change, units: str) -> str:
    """A difference or slope with its sign, error and unit."""
    text = value_text(own.value, own.stderr, units)
    return text if text.startswith("−") else f"+{text}"


def _difference(own: Change, units: str) -> str:
    if np.isnan(own.value):
        return ""
    return "equal" if own.value == 0 and np.isnan(own.z) else change_text(own, units)


def z_text(z: float) -> str:
    """z with its sign, to a decimal where that says something."""
    if not np.isfinite(z):
        return "–"
    return (f"{z:+.1f}" if abs(z) < 10 else f"{z:+.0f}").replace("-", "−")


def _set(found: Comparison, k: int, path: Path) -> dict[str, Any]:
    own = found.datasets[k]
    report = own.folder / "report.html"
    differ = [row for row in found.rows if row.is_changed[k]]
    tested = sum(np.isfinite(row.changes[k].p_value) for row in found.rows)
    verdict = own.verdict
    # Where nothing was added there is no gap that could have closed.
    closed = verdict["gap"]["closed"] if verdict and verdict["effects"] else None
    return {
        "label": own.label,
        "title": own.title if own.title != own.label else "",
        "link": Path(os.path.relpath(report, path.parent)).as_posix() if report.is_file() else "",
        "frames": ", ".join(f"{count} {kind}" for kind, count in own.frames.items()),
        "taken": f"{own.mean_time:%Y-%m-%d}" if own.mean_time else "",
        "status": verdict["status"].replace("_", " ") if verdict else "no verdict",
        "sentence": verdict["sentence"].splitlines()[0] if verdict else "",
        "closed": "–" if closed is None else percent_text(min(closed, 1.0)),
        "changed": "the reference" if k == 0 else f"{len(differ)} of {tested} quantities",
    }


def _changed_row(found: Comparison, row: Row, k: int) -> dict[str, str]:
    change = row.changes[k]
    return {
        "what": quantity_text(row.name),
        "dataset": found.datasets[k].label,
        "before": number_text(row.numbers[row.first]),
        "after": number_text(row.numbers[k]),
        "difference": f"{SIGNS[change.value > 0]} {change_text(change, row.units)}",
        "z": z_text(change.z),
        "z_value": f"{abs(change.z):.6g}",
        "p": probability_text(change.p_value),
    }


def _picture(found: Comparison) -> dict[str, Any] | None:
    """z of all differences of the quantities that differ most: filled where beyond chance, else open."""
    rows = [row for row in found.rows if np.isfinite([own.z for own in row.changes]).any()]
    if not rows:
        return None
    rows = sorted(rows, key=lambda row: -np.nanmax(np.abs([own.z for own in row.changes])))[:MOST_DRAWN]
    points: dict[bool, dict[str, list]] = {mark: {"x": [], "y": [], "text": []} for mark in (True, False)}
    for row in rows:
        for k, own in enumerate(row.changes):
            if np.isfinite(own.z):
                into = points[row.is_changed[k]]
                into["x"].append(round(own.z, 3))
                into["y"].append(quantity_text(row.name))
                said = f"{number_text(row.numbers[k])}, {change_text(own, row.units)}, z = {z_text(own.z)}"
                into["text"].append(f"{found.datasets[k].label}: {said}")
    look = {
        True: {"symbol": "circle", "size": 11, "color": "var(--simulated)"},
        False: {"symbol": "circle-open", "size": 9, "color": "var(--measured)", "line": {"width": 2}},
    }
    names = {True: "changed beyond its errors", False: "within its errors"}
    data = [
        {
            "type": "scatter", "mode": "markers", "name": names[mark], "marker": look[mark], "cliponaxis": False,
            "hovertemplate": "%{y}<br>%{text}<extra></extra>", **own,
        }
        for mark, own in points.items()
        if own["x"]
    ]  # fmt: skip
    order = [quantity_text(row.name) for row in rows][::-1]
    layout = {
        "xaxis": {
            "title": {"text": "difference over its error, z"},
            "range": _span([z for own in points.values() for z in own["x"]]),
            "zerolinecolor": "var(--soft)",
            "zerolinewidth": 2,
        },
        "yaxis": {
            "categoryorder": "array",
            "categoryarray": order,
            "dtick": 1,
            "showticklabels": False,
            "range": [-0.5, len(rows) - 0.2],
            "fixedrange": True,
        },
        # Names stand above their points, so that they fit into a narrow window.
        "annotations": [
            {
                "text": name,
                "x": 0,
                "xref": "paper",
                "xanchor": "left",
                "y": name,
                "yanchor": "bottom",
                "showarrow": False,
            }
            for name in order
        ],
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"},
        "margin": {"l": 8, "r": 12, "t": 36, "b": 44},
        "hovermode": "closest",
        "showlegend": True,
    }
    strongest = ", ".join(quantity_text(row.name) for row in rows if any(row.is_changed)) or "none"
    return {
        "figure": plots.figure(data, layout),
        "alt": f"Differences from {found.datasets[0].label} over their errors. Beyond chance: {strongest}.",
        "height": f"{FRAME_REM + ROW_REM * len(rows):g}rem",
        "left": len(found.rows) - len(rows),
    }


def _span(values: Sequence[float]) -> list[float]:
    """An axis that holds the values and 0, with a margin."""
    low, high = min(0.0, *values), max(0.0, *values)
    margin = 0.05 * max(high - low, 1.0)
    return [low - margin, high + margin]


def _effects(sets: Sequence[DatasetResults]) -> list[tuple[str, list[str]]]:
    """Effects that any verdict names, and what each verdict says of them."""
    verdicts = [own.verdict for own in sets]
    names = dict.fromkeys(effect["name"] for own in verdicts if own for effect in own["effects"])
    return [(name, [_said_of(name, own) for own in verdicts]) for name in names]


def _said_of(name: str, verdict: dict[str, Any] | None) -> str:
    if verdict is None:
        return "no verdict"
    for effect in verdict["effects"]:
        if effect["name"] == name:
            rivals = [own for own in effect["candidates"] if own != name]
            text = f"named ({effect['form']})" if effect["form"] else "named"
            return f"{text}, or {list_text(rivals)}" if rivals else text
    for own in verdict["limits"]:
        if own["effect"] == name:
            return f"{own['why']}; {own['words']} (95 %)" if own["words"] else own["why"]
    why = [own["why"] for own in verdict["not_assessed"] if own["effect"] in (name, "all")]
    return f"not assessed: {why[0]}" if why else "not named"


def _groups(found: Comparison) -> Iterator[dict[str, Any]]:
    """Every quantity with its value in every dataset, by group."""
    for group in GROUPS:
        rows = [row for row in found.rows if row.name.group == group]
        if rows:
            shown = rows
            if len(rows) > MOST_ROWS:
                shown = sorted(rows, key=lambda row: -np.nan_to_num(np.abs([own.z for own in row.changes])).max())
            yield {
                "name": group,
                "count": len(rows),
                "changed": sum(any(row.is_changed) for row in rows),
                "left": max(len(rows) - MOST_ROWS, 0),
                "errors": sorted({own.error for row in rows for own in row.numbers if own.error}),
                "rows": [_row(found, row) for row in shown[:MOST_ROWS]],
            }


def _row(found: Comparison, row: Row) -> dict[str, Any]:
    cells = []
    for own, change, changed in zip(row.numbers, row.changes, row.is_changed, strict=True):
        tested = np.isfinite(change.z)
        cells.append(
            {
                "text": number_text(own),
                "why": f"error: {own.error}; variable {own.source}" if own.source else "",
                "difference": _difference(change, row.units),
                "z": z_text(change.z) if tested else "",
                "changed": changed,
                "sign": SIGNS[change.value > 0] if changed else "",
            }
        )
    slope = row.trend
    return {
        "what": row.name.quantity,
        "where": conditions_text(row.name.conditions),
        "cells": cells,
        "slope": change_text(slope, row.units) if np.isfinite(slope.z) else "–",
        "slope_z": z_text(slope.z) if np.isfinite(slope.z) else "",
        "rising": row.has_trend,
        "slope_sign": SIGNS[slope.value > 0] if row.has_trend else "",
    }


def _over(found: Comparison) -> str:
    """What the picture over the datasets shows of every quantity, as JSON: first those with a trend beyond chance, then
    those that changed."""
    rows = sorted(found.rows, key=lambda row: (not row.has_trend, not any(row.is_changed)))
    quantities = [
        {
            "name": quantity_text(row.name),
            "group": row.name.group,
            "mark": "trend: " if row.has_trend else "changed: " if any(row.is_changed) else "",
            "unit": UNITS.get(row.units, row.units),
            "y": [own.value for own in row.numbers],
            "e": [own.stderr for own in row.numbers],
            "text": [number_text(own) for own in row.numbers],
            "line": [row.intercept, row.trend.value] if np.isfinite(row.trend.value) else None,
            "said": _trend_text(found, row),
        }
        for row in rows
    ]
    labels = [own.label for own in found.datasets]
    content = {
        "along": found.axis.name,
        "places": found.axis.places,
        "labels": labels,
        "named": found.axis.unit == "dataset",
    }
    return plots.as_json(content | {"quantities": quantities})


def _trend_text(found: Comparison, row: Row) -> str:
    own = row.trend
    if not np.isfinite(own.value):
        return ""
    slope = f"{change_text(own, row.units)} per {found.axis.unit}"
    if not np.isfinite(own.z):
        return f"slope {slope}, without an error"
    return f"slope {slope}, z = {z_text(own.z)}: {'beyond' if row.has_trend else 'within'} its error"


def _alone(found: Comparison) -> Iterator[str]:
    """Sentences on what is in one dataset alone, or was skipped in one."""
    shared = {row.name for row in found.rows}
    for own in found.datasets:
        names = [name for name in own.numbers if name not in shared]
        whats = list(dict.fromkeys(name.quantity for name in names if not name.conditions))
        places = list(dict.fromkeys(conditions_text(name.conditions) for name in names if name.conditions))
        if whats:
            yield f"{own.label} alone has {list_text(whats)}"
        if places:
            yield f"{own.label} alone has spots at {list_text(places[:5])}" + (
                f", and {len(places) - 5} conditions more" if len(places) > 5 else ""
            )
        for stage, why in own.skipped.items():
            if any(stage not in other.skipped for other in found.datasets):
                yield f"{own.label} has no {stage}: {why}"
