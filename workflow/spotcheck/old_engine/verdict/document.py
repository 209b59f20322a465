"""verdict.json, version 3: what is concluded of a set of frames, as numbers and words that a program reads."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from spotcheck.old_engine import criteria
from spotcheck.old_engine.conclude.detect import Detection
from spotcheck.old_engine.conclude.judgement import Gap, Judgement, Levels, Light, Limit
from spotcheck.old_engine.conclude.unexplained import Unexplained
from spotcheck.old_engine.evidence.parts import SMALLEST
from spotcheck.old_engine.model.effect import COMPONENTS, Place, Present
from spotcheck.old_engine.model.effects import built_in, vocabulary
from spotcheck.old_engine.model.sensor import ROUNDING_VARIANCE
from spotcheck.old_engine.nuisance.sheet import Against
from spotcheck.old_engine.search.forward import Found
from spotcheck.old_engine.search.holds import Holding
from spotcheck.old_engine.verdict.words import limit_text

VERSION = 3
# What a learned shape is called among effects, whatever a run's vocabulary is.
LIGHT = next(effect.name for effect in built_in().values() if effect.place is Place.SHAPE)
# Units of the sheet's numbers.
SHEET_UNITS = {"gain_dn_per_e": "DN/e-", "read_noise_e": "e-", "black_level_dn": "DN"}
NOT_FORETOLD = "found in the frames that were searched, but frames kept apart are not told better with it"
NO_TEST = "no test was possible"
GAP_KEYS = ("before", "after", "noise_floor", "closed", "rms_dn_before", "rms_dn_after", "gain")


def document(
    judgement: Judgement,
    dataset_name: str,
    *,
    alpha: float = criteria.ALPHA.value,
    tolerance: float = criteria.LEFT.value,
    light_words: str = "",
    beware: str = "",
) -> dict[str, Any]:
    """verdict.json without its sentence; what is not known is None.

    `alpha`: rate of false alarms of detection. `tolerance`: what may be left without mattering [peak, rms].
    `light_words`: what a person is told of a learned shape ("6 % of its power lies elsewhere, most in four lobes").
    `beware`: what the dataset holds that no verdict rests on.
    """
    effects = effects_of(judgement)
    status = status_of(judgement, effects, alpha, tolerance)
    why_not = judgement.why_not or (NO_TEST if status == "not_assessed" else "")
    why_not = "; ".join(remark for remark in (why_not, beware) if remark)
    return {
        "schema": VERSION,
        "dataset": dataset_name,
        "status": status,
        "detection": detection_block(judgement, alpha),
        "where": [{"words": own.words, "z": float(own.z)} for own in judgement.where],
        "effects": effects,
        "light": light_block(judgement.light, light_words) if judgement.light else None,
        "sheet": [sheet_row(own) for own in judgement.sheet],
        "limits": limit_rows(judgement),
        "baseline_shift": {name: shift_row(judgement, k) for k, name in enumerate(("p1", "p2"))},
        "unexplained": unexplained_block(judgement, tolerance),
        "gap": gap_block(judgement.gap),
        "advice": [{"condition": dict(own.condition), "separates": list(own.separates), "frames": int(own.frames)}
                   for own in judgement.advice],
        "not_assessed": [{"effect": name, "why": why} for name, why in
                         ([("all", why_not)] if why_not else []) + list(judgement.not_assessed)],
        "sentence": "",
    } | ({"levels": levels_block(judgement.levels)} if judgement.levels else {})  # fmt: skip


def status_of(judgement: Judgement, effects: list[dict[str, Any]], alpha: float, tolerance: float) -> str:
    """The verdict in a word."""
    if judgement.why_not or (judgement.detection is None and judgement.unexplained is None and not effects):
        return "not_assessed"
    remains = more_remains(judgement.unexplained, tolerance)
    if not effects:
        odd = judgement.detection is not None and judgement.detection.p_value < alpha
        return "unknown" if odd or remains else "consistent"
    if any(len(own["candidates"]) > 1 for own in effects):
        return "ambiguous"
    return "named_more_remains" if remains else "named"


def more_remains(left: Unexplained | None, tolerance: float) -> bool:
    """Whether more is left than the tolerance, beyond what its error may feign."""
    if left is None or not np.isfinite(left.error):
        return False
    return bool(left.size**2 - criteria.STATED.value * left.error > tolerance**2)


def detection_block(judgement: Judgement, alpha: float) -> dict[str, Any]:
    """The test for any disagreement with the declared model."""
    found = judgement.detection
    worst = None
    if found is not None and found.parts:
        own = found.worst
        worst = {"part": own.name, "where": own.where, "statistic": number(own.statistic),
                 "p_value": _probability(own.p_value)}  # fmt: skip
    step = judgement.fits.frames[0].step if judgement.fits is not None else 1
    return {
        "p_value": _probability_of(found),
        "alpha": alpha,
        "parts": len(found.parts) if found is not None else 0,
        "worst": worst,
        "rms_residual_percent_of_peak": number(None if judgement.off is None else 100 * judgement.off),
    } | ({"every_px": step} if step > 1 else {})


def effects_of(judgement: Judgement) -> list[dict[str, Any]]:
    """All that is named, what closes most first: effects that also tell frames kept apart, and the learned shape."""
    closed = judgement.gap.by_effect if judgement.gap else {}
    rows = [
        effect_row(own, judgement, number(closed.get(own.own.effect.name)))
        for own in judgement.found
        if own.own.effect.name not in judgement.beyond
    ]
    if judgement.light is None:
        return rows
    light = light_row(judgement.light, number(judgement.gap.by_light) if judgement.gap else None)
    # What no frames were kept for closes nobody knows what: the light, which is everywhere, comes first.
    by = np.inf if light["gap_closed"] is None else light["gap_closed"]
    at = sum(own["gap_closed"] is not None and own["gap_closed"] > by for own in rows)
    return [*rows[:at], light, *rows[at:]]


def effect_row(own: Found, judgement: Judgement, closed: float | None) -> dict[str, Any]:
    """An effect that was found, by its own evidence."""
    name = own.own.effect.name
    errors = judgement.errors.get(name, (own.holding.error,))
    return {
        "name": name,
        "candidates": [name, *sorted(own.rivals, key=lambda rival: own.rivals[rival])],
        "form": own.own.form,
        "parameters": parameters_of(own.own, errors, judgement.black_level_dn),
        "gap_closed": closed,
        "evidence": evidence_block(name, own.gain, own.holding.z2**0.5, own.holding, own.rivals),
    }


def light_row(light: Light, closed: float | None) -> dict[str, Any]:
    """The learned shape as an effect: how much of the light lies elsewhere, and in which azimuthal order most of it."""
    z = light.power / light.error if light.error > 0 else np.nan
    order = float(np.argmax(light.orders)) if any(light.orders) else None
    return {
        "name": LIGHT,
        "candidates": [LIGHT],
        "form": "",
        "parameters": {"power": {"value": float(light.power), "stderr": number(light.error), "unit": "1"},
                       "order": {"value": order, "stderr": None, "unit": "1"}},
        "gap_closed": closed,
        "evidence": evidence_block(LIGHT, light.gain, z, None, {}),
    }  # fmt: skip


def evidence_block(
    name: str, gain: float, z: float, holding: Holding | None, rivals: Mapping[str, float]
) -> dict[str, Any]:
    """What speaks for a name, and its weight among its rivals, all as likely before the frames are seen."""
    weight, nearest = weights_of(name, rivals), sorted(rivals, key=lambda own: rivals[own])
    consistency = None
    if holding is not None:
        consistency = {"q": number(holding.q), "cells": int(holding.cells), "excess": number(holding.excess),
                       "holds": bool(holding.holds)}  # fmt: skip
    return {
        "gain": number(gain),
        "z": number(z),
        "consistency": consistency,
        "weight": weight[name],
        "rivals": [{"name": own, "behind": float(rivals[own]), "weight": weight[own]} for own in nearest],
    }


def weights_of(name: str, rivals: Mapping[str, float]) -> dict[str, float]:
    """Shares of an effect and its rivals, which add up to 1: exp(−d/2) for one that is d behind in −2 ln L."""
    behind = {name: 0.0, **rivals}
    least = min(behind.values())
    share = {own: float(np.exp((least - d) / 2)) for own, d in behind.items()}
    total = sum(share.values())
    return {own: value / total for own, value in share.items()}


def parameters_of(own: Present, errors: tuple[float, ...], black_level_dn: float) -> dict[str, dict[str, Any]]:
    """Values, standard errors and units of an effect's parameters; constants of its form are left out."""
    effect, values = own.effect, list(own.values)
    every: list[float | None] = [*errors, *[None] * (len(values) - len(errors))]
    if own.form in effect.rounded:
        # What readings show as a whole number lies anywhere about that.
        values[0] = round(values[0] + black_level_dn) - black_level_dn
        every[0] = float(np.hypot(number(every[0]) or 0.0, np.sqrt(ROUNDING_VARIANCE)))
    # A variance component tells of its first parameters alone.
    told = COMPONENTS.get(effect.component, len(values))
    rows = list(zip(effect.parameters, values, every, strict=True))[:told]
    # A fit may leave a direction some turns on.
    return {
        p.name: {"value": number(v % 360 if p.unit == "deg" else v), "stderr": number(e), "unit": p.unit}
        for p, v, e in rows
        if not p.inner
    }


def light_block(light: Light, words: str) -> dict[str, Any]:
    """What the learned shape has beside the declared one."""
    major, minor, direction = light.axes
    return {
        "power": number(light.power),
        "stderr": number(light.error),
        "orders": [float(own) for own in light.orders],
        "axes": {"major": number(major), "minor": number(minor), "direction_deg": number(direction % 360)},
        "lowest": number(light.lowest),
        "words": words,
    }


def sheet_row(own: Against) -> dict[str, Any]:
    """A number of the data sheet, and whether frames contradict it."""
    return {
        "name": own.name,
        "unit": SHEET_UNITS.get(own.name, "1"),
        "stated": float(own.stated),
        "stated_stderr": float(own.stated_stderr),
        "found": float(own.value),
        "stderr": number(own.stderr),
        "stated_errors": number(own.stated_errors),
        "z": number(own.z),
        "contradicts": bool(abs(own.stated_errors) > criteria.STATED.value),
    }


def limit_rows(judgement: Judgement) -> list[dict[str, Any]]:
    """What is not known of effects that are not named."""
    rows = [limit_row(own, judgement) for own in judgement.limits]
    known = {own.effect for own in judgement.limits}
    for own in judgement.found:
        effect = own.own.effect
        if effect.name in judgement.beyond and effect.name not in known:
            strength = effect.parameters[0]
            rows.append(limit_row(Limit(effect.name, strength.name, strength.unit, NOT_FORETOLD), judgement))
    return rows


def limit_row(own: Limit, judgement: Judgement) -> dict[str, Any]:
    """What an effect that is not named may still be, and how many frames more, of all conditions alike, would halve
    that."""
    effect = vocabulary().get(own.effect)
    ends = [limit_text(end, own.unit, effect) if np.isfinite(end) else "" for end in (own.low, own.high)]
    frames = len(judgement.fits.shots) if judgement.fits else judgement.levels.frames if judgement.levels else 0
    return {
        "effect": own.effect,
        "parameter": own.parameter,
        "low": number(own.low),
        "high": number(own.high),
        "unit": own.unit,
        "words": effect.size_text(*ends) if effect else "",
        "why": own.why,
        "frames": int(np.ceil((own.times - 1) * frames)) if frames and np.isfinite(own.times) else None,
        "more": own.more,
    }


def shift_row(judgement: Judgement, k: int) -> dict[str, Any]:
    """p1 or p2 before and after effects were added."""
    before, after, errors = (number(own[k]) if own is not None else None for own in judgement.shift)
    return {"before": before, "after": after, "stderr": errors, "unit": "px"}


def unexplained_block(judgement: Judgement, tolerance: float) -> dict[str, Any]:
    """What is left beside all that is named. The power's error is given as that of its root, towards more."""
    left, gap = judgement.unexplained, judgement.gap
    share = None if gap is None or number(gap.closed) is None else float(np.clip(1 - gap.closed, 0.0, 1.0))
    size = error = z = None
    if left is not None and np.isfinite(left.error):
        size, z = float(left.size), number(left.z)
        error = float(np.sqrt(left.size**2 + left.error) - left.size)
    return {"size": size, "error": error, "z": z, "tolerance": tolerance, "share": share,
            "p_value": _probability_of(judgement.rest)}  # fmt: skip


def gap_block(gap: Gap | None) -> dict[str, Any]:
    """How far frames that had no part in it are from the model, before and after."""
    if gap is None:
        return dict.fromkeys(GAP_KEYS) | {"on": None}
    return {key: number(getattr(gap, key)) for key in GAP_KEYS} | {"on": gap.on}


def levels_block(own: Levels) -> dict[str, Any]:
    """What levels of flats tell of the gain, and of their light."""
    return {
        "number": own.number,
        "gain_dn_per_e": {"value": float(own.gain), "stderr": number(own.gain_error)},
        "straight_line": {"value": float(own.line), "stderr": number(own.line_error)},
        "light_scatter": float(own.scatter),
    }


def number(value: float | None) -> float | None:
    """A number of Python's own; None for one that is none."""
    return None if value is None or not np.isfinite(value) else float(value)


def _probability_of(found: Detection | None) -> float | None:
    return None if found is None else _probability(found.p_value)


def _probability(value: float) -> float | None:
    """No probability is 0: below some size it is not told."""
    return number(np.clip(value, SMALLEST, 1.0))
