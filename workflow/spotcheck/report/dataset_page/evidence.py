"""Tables of the verdict: effects with their evidence, upper limits, and the data sheet against the frames."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from spotcheck.discrepancy.words import condition_text, limit_text, over_noise_text, percent_text
from spotcheck.io.number_text import number_text, quantity_text, rounded_text
from spotcheck.model.effect import Effect
from spotcheck.model.effects import built_in, vocabulary
from spotcheck.report.dataset_page.summary import number_keys
from spotcheck.report.pages.citations import Citations

Row = dict[str, Any]


def tabulate_evidence(verdict: dict[str, Any], citations: Citations) -> dict[str, Any]:
    """Return the contents of evidence.html.

    Parameters
    ----------
    verdict : dict
        Content of verdict.json.
    citations : Citations
        Marks numbers with their sources.
    """
    # A run may exclude the learned shape from its vocabulary, but not from its verdict.
    known = {**built_in(), **vocabulary()}
    gap, keys = verdict["gap"], number_keys(verdict)
    strongest_first = sorted(enumerate(verdict["where"]), key=lambda place: -abs(place[1]["z"]))
    limited_first = sorted(verdict["limits"], key=lambda limit: not limit["words"])
    gap_numbers = [
        citations.cite(over_noise_text(gap[name]), f"verdict.gap.{name}") for name in ("before", "after", "noise_floor")
    ]
    return {
        "verdict": verdict,
        "sentence": [citations.cite_in(line, keys) for line in verdict["sentence"].splitlines()],
        "effects": [_effect_row(effect, known[effect["name"]], citations) for effect in verdict["effects"]],
        "gap": gap_numbers,
        "closed": _share_text(gap["closed"]),
        "shifts": _tabulate_shifts(verdict, citations) if verdict["effects"] else [],
        "places": [
            (place["words"], citations.cite(number_text(place["z"]), f"verdict.where.{k}.z"))
            for k, place in strongest_first
        ],
        "limits": [_limit_row(limit, known.get(limit["effect"]), citations) for limit in limited_first],
        "advice": [(advice, condition_text(advice["condition"])) for advice in verdict["advice"]],
    }


def _effect_row(entry: Mapping[str, Any], effect: Effect, citations: Citations) -> Row:
    """Return the row of an effect that the verdict names; `entry` is its part of verdict.json."""
    key, evidence = f"verdict.effects.{entry['name']}", entry["evidence"]
    values = [
        (name, citations.cite(quantity_text(value["value"], value["stderr"], value["unit"]), f"{key}.{name}"))
        for name, value in entry["parameters"].items()
    ]
    return {
        "name": entry["name"],
        "sentence": effect.sentence,
        "values": values,
        "vanishes_at": f"{effect.vanishes_at:g}" if np.isfinite(effect.vanishes_at) else "",
        "gain": citations.cite(number_text(evidence["gain"]), f"{key}.evidence.gain"),
        "z": citations.cite(number_text(evidence["z"]), f"{key}.evidence.z"),
        # A learned shape is fitted to all frames together, not tested on cells.
        "cells": "–" if evidence["consistency"] is None else evidence["consistency"]["cells"],
        "rivals": [name for name in entry["candidates"] if name != entry["name"]],
        "closed": citations.cite(_share_text(entry["gap_closed"]), f"{key}.gap_closed"),
    }


def _share_text(share: float | None) -> str:
    """Return a closed part of the gap, which noise may raise above 1, in per cent; a dash if unknown."""
    return "–" if share is None else percent_text(min(share, 1.0))


def _tabulate_shifts(verdict: Mapping[str, Any], citations: Citations) -> list[tuple[str, str, str]]:
    """Return p1 and p2 before and after the effects were added."""
    rows: list[tuple[str, str, str]] = []
    for name, shift in verdict["baseline_shift"].items():
        if shift["before"] is not None:
            key, error = f"verdict.baseline_shift.{name}", shift["stderr"]
            # Digits as the error of the later value has them.
            before = rounded_text(shift["before"], error) if error else number_text(shift["before"], 4)
            after = quantity_text(shift["after"], error, shift["unit"])
            before_text = citations.cite(f"{before} {shift['unit']}", f"{key}.before")
            rows.append((name, before_text, citations.cite(after, f"{key}.after")))
    return rows


def _limit_row(limit: Mapping[str, Any], effect: Effect | None, citations: Citations) -> Row:
    """Return the row of an effect that the verdict does not name."""
    key = f"verdict.limits.{limit['effect']}.{limit['parameter']}"
    ends = [end for end in ("low", "high") if limit[end] is not None]
    keys = {limit_text(limit[end], limit["unit"], effect): f"{key}.{end}" for end in ends}
    return {
        "effect": limit["effect"],
        "sentence": effect.sentence if effect else "",
        "limit": citations.cite_in(limit["words"] or "–", keys),
        "frames": f"{limit['frames']:,}" if limit["frames"] else "–",
        "remark": "; ".join(filter(None, (limit["why"], limit["more"]))),
    }


def tabulate_data_sheet(verdict: dict[str, Any] | None, citations: Citations) -> dict[str, Any] | None:
    """Return the numbers of the data sheet beside those of a fit to sheet and frames; None if none was fitted."""
    if not verdict or not verdict["sheet"]:
        return None
    rows = []
    for entry in verdict["sheet"]:
        key, unit = f"verdict.sheet.{entry['name']}", entry["unit"]
        shift = f"{entry['stated_errors']:.2g}".replace("-", "−")
        rows.append(
            {
                "name": entry["name"].replace("_", " "),
                "stated": citations.cite(quantity_text(entry["stated"], entry["stated_stderr"], unit), f"{key}.stated"),
                "fitted": citations.cite(quantity_text(entry["found"], entry["stderr"], unit), f"{key}.found"),
                "shift": citations.cite(shift, f"{key}.stated_errors"),
                "is_contradicted": entry["contradicts"],
            }
        )
    count = sum(row["is_contradicted"] for row in rows)
    return {"rows": rows, "hint": f"{count} of {len(rows)} contradicted" if count else "no contradiction"}
