"""The verdict on a dataset, version 4: the content of verdict.json, from a record of findings."""

from collections.abc import Mapping
from dataclasses import replace
from enum import Enum
from typing import Any

import numpy as np

from spotcheck.discrepancy.criteria import ALPHA, CLEAR_ERRORS, TOLERANCE
from spotcheck.discrepancy.findings import (
    Consistency,
    Detection,
    Findings,
    Gap,
    LawShift,
    LearnedLight,
    LevelFindings,
    NamedEffect,
    ParameterValue,
    SensorPull,
    Unexplained,
    UpperLimit,
)
from spotcheck.discrepancy.words import limit_text, size_text
from spotcheck.model.effects import built_in, vocabulary

VERSION = 4
# Least p-value that is written: no probability is 0.
LEAST_PROBABILITY = 1e-300
# The effect that a learned light shape stands for, also if a run's vocabulary leaves it out.
LEARNED_SHAPE = next(effect for effect in built_in().values() if not effect.stages)
# Reasons of verdicts without effects.
NO_TEST = "no test was possible"
NOT_CONVERGED = "the fits behind the effects did not converge"


class Status(Enum):
    """The verdict in one word."""

    CONSISTENT = "consistent"
    NAMED = "named"
    NAMED_MORE_REMAINS = "named_more_remains"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"
    NOT_ASSESSED = "not_assessed"
    NOT_CONVERGED = "not_converged"


def compose_verdict(
    findings: Findings, dataset_name: str, *, alpha: float = ALPHA, tolerance: float = TOLERANCE
) -> dict[str, Any]:
    """Return the content of verdict.json with an empty `sentence`; what is not known is None.

    Parameters
    ----------
    findings : Findings
        All that is concluded. Without a converged fit, only what follows from the declared model is taken.
    dataset_name : str
        Name of the dataset's folder.
    alpha : float
        Rate of false alarms of detection.
    tolerance : float
        Rms of the mean image that may stay unexplained [peak].
    """
    status = find_status(findings, alpha, tolerance)
    reason = findings.reason or {Status.NOT_ASSESSED: NO_TEST, Status.NOT_CONVERGED: NOT_CONVERGED}.get(status, "")
    if reason:
        findings = drop_fitted_values(findings)
    rows = [("all", why) for why in (reason, *findings.remarks) if why]
    document = {
        "schema": VERSION,
        "dataset": dataset_name,
        "status": status.value,
        "detection": describe_detection(findings.detection, findings.rms_of_peak, alpha),
        "where": [{"words": place.words, "z": float(place.z)} for place in findings.places],
        "effects": describe_effects(findings),
        "light": describe_light(findings.light) if findings.light else None,
        "sheet": [describe_pull(pull) for pull in findings.sensor],
        "limits": [describe_limit(limit) for limit in findings.limits],
        "baseline_shift": describe_law(findings.law),
        "unexplained": describe_unexplained(findings.unexplained, tolerance),
        "gap": describe_gap(findings.gap),
        "metrics": [
            {"name": metric.name, "unit": metric.unit}
            | {key: number(getattr(metric, key)) for key in ("measured", "declared", "extended")}
            for metric in findings.metrics
        ],
        "advice": [
            {"condition": dict(advice.condition), "separates": list(advice.separates), "frames": int(advice.frames)}
            for advice in findings.advice
        ],
        "not_assessed": [{"effect": name, "why": why} for name, why in (*rows, *findings.not_assessed)],
        "sentence": "",
    }
    return document | ({"levels": describe_levels(findings.levels)} if findings.levels else {})


def find_status(findings: Findings, alpha: float = ALPHA, tolerance: float = TOLERANCE) -> Status:
    """Return the status of findings; `alpha` and `tolerance` as in `compose_verdict`."""
    has_effects = bool(findings.effects) or findings.light is not None
    was_tested = findings.detection is not None or findings.unexplained is not None or has_effects
    if findings.reason:
        return Status.NOT_ASSESSED
    if not findings.has_converged:
        return Status.NOT_CONVERGED
    if not was_tested:
        return Status.NOT_ASSESSED
    is_exceeded = exceeds_tolerance(findings.unexplained, tolerance)
    if not has_effects:
        is_detected = findings.detection is not None and findings.detection.p_value < alpha
        return Status.UNKNOWN if is_detected or is_exceeded else Status.CONSISTENT
    if any(effect.rivals for effect in findings.effects):
        return Status.AMBIGUOUS
    return Status.NAMED_MORE_REMAINS if is_exceeded else Status.NAMED


def exceeds_tolerance(unexplained: Unexplained | None, tolerance: float) -> bool:
    """Return whether more is unexplained than the tolerance, beyond what the error of its square allows for."""
    if unexplained is None or not np.isfinite(unexplained.variance_error):
        return False
    return bool(unexplained.size**2 - CLEAR_ERRORS * unexplained.variance_error > tolerance**2)


def drop_fitted_values(findings: Findings) -> Findings:
    """Return the findings without values of fits that go beyond the declared model."""
    levels = findings.levels and replace(findings.levels, gain=findings.levels.straight_line)
    return replace(findings, effects=(), light=None, sensor=(), limits=(), law=LawShift(before=findings.law.before),
                   unexplained=None, gap=None, metrics=(), advice=(), levels=levels)  # fmt: skip


def describe_detection(detection: Detection | None, rms_of_peak: float, alpha: float) -> dict[str, Any]:
    """Return the key `detection`."""
    tests = detection.tests if detection else ()
    strongest = min(tests, key=lambda test: (test.p_value, -test.z), default=None)
    worst = strongest and {
        "part": strongest.name,
        "where": strongest.where,
        "statistic": number(strongest.statistic),
        "p_value": probability(strongest.p_value),
    }
    return {
        "p_value": probability(detection.p_value) if detection else None,
        "alpha": alpha,
        "parts": len(tests),
        "worst": worst,
        "rms_residual_percent_of_peak": number(100 * rms_of_peak),
    }


# Effects and the light


def describe_effects(findings: Findings) -> list[dict[str, Any]]:
    """Return the key `effects`: the learned light first, as it acts everywhere, then effects in their order."""
    light = [describe_shape(findings.light)] if findings.light else []
    return light + [describe_effect(effect) for effect in findings.effects]


def describe_effect(effect: NamedEffect) -> dict[str, Any]:
    """Return the row of an effect; its parameters stand in the order of the effect's, the strength first."""
    order = [parameter.name for parameter in effect.applied.effect.parameters]
    names = sorted(effect.values, key=lambda name: order.index(name) if name in order else len(order))
    return {
        "name": effect.name,
        "candidates": [effect.name, *sorted(effect.rivals, key=effect.rivals.__getitem__)],
        "form": str(effect.applied.variant.value),
        "parameters": {name: describe_value(effect.values[name]) for name in names},
        "gap_closed": number(effect.gap_closed),
        "evidence": describe_evidence(effect.name, effect.gain, effect.z, effect.consistency, effect.rivals),
    }


def describe_shape(light: LearnedLight) -> dict[str, Any]:
    """Return the row of a learned light shape: its power, and the azimuthal order that has most of it."""
    order = float(np.argmax(light.orders)) if any(light.orders) else np.nan
    z = light.power / light.stderr if light.stderr > 0 else np.nan
    values = ((light.power, light.stderr), (order, np.nan))
    return {
        "name": LEARNED_SHAPE.name,
        "candidates": [LEARNED_SHAPE.name],
        "form": "",
        "parameters": {
            parameter.name: describe_value(ParameterValue(*value, parameter.unit))
            for parameter, value in zip(LEARNED_SHAPE.parameters, values, strict=True)
        },
        "gap_closed": number(light.gap_closed),
        "evidence": describe_evidence(LEARNED_SHAPE.name, light.gain, z, None, {}),
    }


def describe_value(value: ParameterValue) -> dict[str, Any]:
    """Return value, standard error and unit; a direction lies from 0° to 360°."""
    reduced = value.value % 360 if value.unit == "deg" else value.value
    return {"value": number(reduced), "stderr": number(value.stderr), "unit": value.unit}


def describe_evidence(
    name: str, gain: float, z: float, consistency: Consistency | None, rivals: Mapping[str, float]
) -> dict[str, Any]:
    """Return the key `evidence` of an effect; `rivals` says how much larger −2 ln L is with each."""
    weights = weigh_candidates({name: 0.0, **rivals})
    return {
        "gain": number(gain),
        "z": number(z),
        "consistency": consistency
        and {
            "q": number(consistency.q),
            "cells": int(consistency.cells),
            "limit": number(consistency.limit),
            "holds": bool(consistency.is_consistent),
        },
        "weight": weights[name],
        "rivals": [
            {"name": rival, "behind": float(rivals[rival]), "weight": weights[rival]}
            for rival in sorted(rivals, key=rivals.__getitem__)
        ],
    }


def weigh_candidates(behind: Mapping[str, float]) -> dict[str, float]:
    """Return the probabilities of candidates that are equally likely before the frames are seen.

    They are in proportion to exp(−d/2), where d is how much larger −2 ln L is with a candidate; they sum to 1.
    """
    least = min(behind.values())
    shares = {name: float(np.exp((least - d) / 2)) for name, d in behind.items()}
    total = sum(shares.values())
    return {name: share / total for name, share in shares.items()}


def describe_light(light: LearnedLight) -> dict[str, Any]:
    """Return the key `light`."""
    return {
        "power": number(light.power),
        "stderr": number(light.stderr),
        "orders": [float(share) for share in light.orders],
        "axes": {
            "major": number(light.major),
            "minor": number(light.minor),
            "direction_deg": number(light.direction_deg % 360),
        },
        "lowest": number(light.lowest),
        "words": light.words,
    }


# Sensor, limits, residuals


def describe_pull(pull: SensorPull) -> dict[str, Any]:
    """Return a row of the key `sheet`; `z` is unknown if the frames add nothing to the data sheet."""
    return {
        "name": pull.name,
        "unit": pull.unit,
        "stated": float(pull.stated),
        "stated_stderr": float(pull.stated_stderr),
        "found": float(pull.fitted),
        "stderr": number(pull.stderr),
        "stated_errors": number(pull.shift),
        "z": number(pull.z) if pull.stderr < pull.stated_stderr else None,
        "contradicts": bool(abs(pull.shift) > CLEAR_ERRORS),
    }


def describe_limit(limit: UpperLimit) -> dict[str, Any]:
    """Return a row of the key `limits`."""
    effect = (built_in() | dict(vocabulary())).get(limit.effect)
    low, high = (limit_text(end, limit.unit, effect) if np.isfinite(end) else "" for end in (limit.low, limit.high))
    return {
        "effect": limit.effect,
        "parameter": limit.parameter,
        "low": number(limit.low),
        "high": number(limit.high),
        "unit": limit.unit,
        "words": size_text(effect, low, high) if effect else "",
        "why": limit.reason,
        "frames": limit.frames,
        "more": limit.remark,
    }


def describe_law(law: LawShift) -> dict[str, Any]:
    """Return the key `baseline_shift`."""
    return {
        name: {"before": number(before), "after": number(after), "stderr": number(stderr), "unit": "px"}
        for name, before, after, stderr in zip(("p1", "p2"), law.before, law.after, law.stderr, strict=True)
    }


def describe_unexplained(unexplained: Unexplained | None, tolerance: float) -> dict[str, Any]:
    """Return the key `unexplained`; `error` is that of the size towards larger ones, √(size² + error of it) − size."""
    size = error = z = share = p_value = None
    if unexplained is not None:
        share, p_value = number(unexplained.share), probability(unexplained.p_value)
        share = None if share is None else float(np.clip(share, 0.0, 1.0))
        if np.isfinite(unexplained.variance_error):
            size, z = number(unexplained.size), number(unexplained.z)
            error = number(np.sqrt(unexplained.size**2 + unexplained.variance_error) - unexplained.size)
    return {"size": size, "error": error, "z": z, "tolerance": tolerance, "share": share, "p_value": p_value}


def describe_gap(gap: Gap | None) -> dict[str, Any]:
    """Return the key `gap`."""
    keys = ("before", "after", "noise_floor", "closed", "rms_dn_before", "rms_dn_after", "gain")
    if gap is None:
        return dict.fromkeys((*keys, "on"))
    return {key: number(getattr(gap, key)) for key in keys} | {"on": gap.on}


def describe_levels(levels: LevelFindings) -> dict[str, Any]:
    """Return the key `levels`."""
    return {
        "number": int(levels.number),
        "gain_dn_per_e": {"value": float(levels.gain.value), "stderr": number(levels.gain.stderr)},
        "straight_line": {"value": float(levels.straight_line.value), "stderr": number(levels.straight_line.stderr)},
        "light_scatter": float(levels.light_scatter),
    }


def number(value: float | None) -> float | None:
    """Return a number of Python's own; None for NaN and infinity."""
    return None if value is None or not np.isfinite(value) else float(value)


def probability(value: float) -> float | None:
    """Return a p-value of at least `LEAST_PROBABILITY`; None for NaN."""
    return number(np.clip(value, LEAST_PROBABILITY, 1.0))
