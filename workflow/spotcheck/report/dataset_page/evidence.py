"""Tables of the verdict: effects with their evidence, upper limits, and the data sheet against the frames.

The verdict (verdict.json) names the effects that the declared model of the frames lacks. The gap is the mean square of
block residuals over that of their noise [1], on held-out frames. A cell is a part of the data. The strength of an
effect is fitted to each cell alone, to test whether it is consistent. Marked text is HTML that shows the source of a
number on hover. Errors are standard errors.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from spotcheck.discrepancy.words import condition_text, limit_text, over_noise_text, percent_text
from spotcheck.io.number_text import number_text, quantity_text, rounded_text
from spotcheck.model.effect import Effect
from spotcheck.model.effects import built_in, vocabulary
from spotcheck.report.dataset_page.summary import number_keys
from spotcheck.report.pages.citations import Citations

Row = dict[str, Any]  # row of a table of evidence.html or sheet.html


def tabulate_evidence(verdict: dict[str, Any], citations: Citations) -> dict[str, Any]:
    """Return the variable `evidence` of evidence.html.

    It has the verdict itself (`verdict`), and its sentences and numbers as marked text: `sentence` (lines), `effects`
    and `limits` (rows), `gap` (before, after and noise floor), `closed` (share of the gap), `shifts` (rows of
    `_tabulate_shifts`), `places` (words and z of each place of a large residual) and `advice` (entry of the verdict and
    its condition in words).

    Parameters
    ----------
    verdict : dict
        Content of verdict.json.
    citations : Citations
        Marks numbers with their sources.
    """
    # The learned light shape may be in a verdict even if a run excludes it from its vocabulary.
    known_effects = {**built_in(), **vocabulary()}
    gap, keys = verdict["gap"], number_keys(verdict)
    # (index in the verdict, place): the source of a place's number is found by the index.
    strongest_first = sorted(enumerate(verdict["where"]), key=lambda item: -abs(item[1]["z"]))
    # Effects without a limit come last.
    limited_first = sorted(verdict["limits"], key=lambda limit: not limit["words"])
    return {
        "verdict": verdict,
        "sentence": [citations.cite_in(line, keys) for line in verdict["sentence"].splitlines()],
        "effects": [_effect_row(effect, known_effects[effect["name"]], citations) for effect in verdict["effects"]],
        "gap": [
            citations.cite(over_noise_text(gap[name]), f"verdict.gap.{name}")
            for name in ("before", "after", "noise_floor")
        ],
        "closed": _share_text(gap["closed"]),
        "shifts": _tabulate_shifts(verdict, citations) if verdict["effects"] else [],
        "places": [
            (place["words"], citations.cite(number_text(place["z"]), f"verdict.where.{k}.z"))
            for k, place in strongest_first
        ],
        "limits": [_limit_row(limit, known_effects.get(limit["effect"]), citations) for limit in limited_first],
        "advice": [(advice, condition_text(advice["condition"])) for advice in verdict["advice"]],
    }


def _effect_row(entry: Mapping[str, Any], effect: Effect, citations: Citations) -> Row:
    """Return the row of an effect that the verdict names; `entry` is its entry in `effects` of verdict.json.

    The evidence is `gain`, the drop of −2 ln L by the effect, and `z`, its strength over the standard error.
    """
    key, evidence = f"verdict.effects.{entry['name']}", entry["evidence"]
    return {
        "name": entry["name"],
        "sentence": effect.sentence,
        "values": [
            (name, citations.cite(quantity_text(value["value"], value["stderr"], value["unit"]), f"{key}.{name}"))
            for name, value in entry["parameters"].items()
        ],
        "vanishes_at": f"{effect.vanishes_at:g}" if np.isfinite(effect.vanishes_at) else "",
        "gain": citations.cite(number_text(evidence["gain"]), f"{key}.evidence.gain"),
        "z": citations.cite(number_text(evidence["z"]), f"{key}.evidence.z"),
        # A learned shape is fitted to all frames together, not tested on cells.
        "cells": "–" if evidence["consistency"] is None else evidence["consistency"]["cells"],
        "rivals": [name for name in entry["candidates"] if name != entry["name"]],
        "closed": citations.cite(_share_text(entry["gap_closed"]), f"{key}.gap_closed"),
    }


def _share_text(share: float | None) -> str:
    """Return the closed share of the gap in per cent; a dash if it is unknown (None).

    Noise may raise the share above 1; it is then written as 100 %.
    """
    return "–" if share is None else percent_text(min(share, 1.0))


def _tabulate_shifts(verdict: Mapping[str, Any], citations: Citations) -> list[tuple[str, str, str]]:
    """Return (name, value before, value after) of p1 and p2, fitted without and with the added effects, as marked text.

    The width of the spot at the exposure t is p1 ln t + p2 [px]. Unknown parameters are omitted.
    """
    rows: list[tuple[str, str, str]] = []
    for name, shift in verdict["baseline_shift"].items():
        if shift["before"] is not None:
            key, error = f"verdict.baseline_shift.{name}", shift["stderr"]
            # Only the value after has an error; the value before gets the same decimals.
            before = rounded_text(shift["before"], error) if error else number_text(shift["before"], digits=4)
            after = quantity_text(shift["after"], error, shift["unit"])
            marked_before = citations.cite(f"{before} {shift['unit']}", f"{key}.before")
            rows.append((name, marked_before, citations.cite(after, f"{key}.after")))
    return rows


def _limit_row(limit: Mapping[str, Any], effect: Effect | None, citations: Citations) -> Row:
    """Return the row of an effect that the verdict does not name, with the 95 % limit on its strength.

    `limit` is its entry in `limits` of verdict.json. Its `words` are the limit as text, `frames` is the number of
    further frames that would halve it, `why` and `more` are remarks. `effect` is None if the run does not know it.
    """
    key = f"verdict.limits.{limit['effect']}.{limit['parameter']}"
    # Known ends of the interval of strengths that the frames allow.
    ends = [end for end in ("low", "high") if limit[end] is not None]
    keys = {limit_text(limit[end], limit["unit"], effect): f"{key}.{end}" for end in ends}
    return {
        "effect": limit["effect"],
        "sentence": effect.sentence if effect else "",
        "limit": citations.cite_in(limit["words"] or "–", keys),
        "frames": f"{limit['frames']:,}" if limit["frames"] else "–",
        "remark": "; ".join(filter(None, (limit["why"], limit["more"]))),
    }


def compare_data_sheet(verdict: dict[str, Any]) -> dict[str, Any] | None:
    """Return the variable `sheet` of sheet.html: stated or measured numbers beside the same numbers as fitted.

    The fit combines both with the frames. `rows` are the entries of the verdict, `hint` is a text beside the heading.
    Returns None if no such number was fitted.
    """
    rows = verdict["sheet"]
    count = sum(entry["contradicts"] for entry in rows)
    hint = f"{count} of {len(rows)} contradicted" if count else "no contradiction"
    return {"rows": rows, "hint": hint} if rows else None
