"""The verdict on a dataset: the content of verdict.json (version 4), from a record of findings.

Numbers that are not known are NaN in findings and None in the verdict. A gain is the drop of −2 ln L by an effect.
Rivals of an effect are other effects that explain the data about as well. A learned light shape is a free one, fitted
beside the declared shape, which the verdict lists like an effect.
"""

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
# Least p-value that is written, since no probability is 0.
LEAST_PROBABILITY = 1e-300
# The entry of the vocabulary for a learned light shape: the only one without a formula. It counts also if the
# vocabulary of a run leaves it out.
LEARNED_SHAPE = next(effect for effect in built_in().values() if not effect.stages)
# Reasons for verdicts without effects.
NO_TEST = "no test was possible"
NOT_CONVERGED = "the fits behind the effects did not converge"


class Status(Enum):
    """The verdict in one word."""

    CONSISTENT = "consistent"  # no disagreement was found
    NAMED = "named"  # effects explain the disagreement
    NAMED_MORE_REMAINS = "named_more_remains"  # effects explain a part; the rest exceeds the tolerance
    AMBIGUOUS = "ambiguous"  # an effect has rivals
    UNKNOWN = "unknown"  # there is a disagreement, and no effect explains it
    NOT_ASSESSED = "not_assessed"  # no test was possible
    NOT_CONVERGED = "not_converged"  # the fits behind the effects did not converge


def compose_verdict(
    findings: Findings, dataset_name: str, *, alpha: float = ALPHA, tolerance: float = TOLERANCE
) -> dict[str, Any]:
    """Return the content of verdict.json with an empty `sentence`.

    Parameters
    ----------
    findings : Findings
        All that is concluded of the dataset. If the fits did not converge, only values of the declared model are used.
    dataset_name : str
        Name of the dataset's folder.
    alpha : float
        Rate of false alarms of detection.
    tolerance : float
        Rms of the mean image that may remain unexplained [peak of the spot].
    """
    status = find_status(findings, alpha, tolerance)
    reason = findings.reason or {Status.NOT_ASSESSED: NO_TEST, Status.NOT_CONVERGED: NOT_CONVERGED}.get(status, "")
    if reason:
        findings = drop_fitted_values(findings)
    general_rows = [("all", why) for why in (reason, *findings.remarks) if why]
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
        "not_assessed": [{"effect": name, "why": why} for name, why in (*general_rows, *findings.not_assessed)],
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
    """Return whether the unexplained rms exceeds the tolerance by `CLEAR_ERRORS` standard errors of its square.

    The result is False without an estimate or an error. `tolerance` is in the unit of the size [peak].
    """
    if unexplained is None or not np.isfinite(unexplained.variance_error):
        return False
    return bool(unexplained.size**2 - CLEAR_ERRORS * unexplained.variance_error > tolerance**2)


def drop_fitted_values(findings: Findings) -> Findings:
    """Return the findings without effects and other values of the extended model; those of the declared one remain."""
    levels = findings.levels and replace(findings.levels, gain=findings.levels.straight_line)
    return replace(findings, effects=(), light=None, sensor=(), limits=(), law=LawShift(before=findings.law.before),
                   unexplained=None, gap=None, metrics=(), advice=(), levels=levels)  # fmt: skip


def describe_detection(detection: Detection | None, rms_of_peak: float, alpha: float) -> dict[str, Any]:
    """Return the value of the key `detection`.

    `detection` is None if nothing was tested. `rms_of_peak` is the rms of the mean residual [peak], NaN if unknown.
    """
    tests = detection.tests if detection else ()
    # p-values may be 0 by underflow: then the largest z decides.
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
    """Return the value of the key `effects`: a learned light shape first, then the effects in their order."""
    light_rows = [describe_shape(findings.light)] if findings.light else []
    return light_rows + [describe_effect(effect) for effect in findings.effects]


def describe_effect(effect: NamedEffect) -> dict[str, Any]:
    """Return the row of an effect in `effects`; its parameters have the order of the vocabulary, the strength first."""
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
    """Return the row of a learned light shape in `effects`: its power, and the azimuthal order with most of it."""
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
    """Return value, standard error and unit of a parameter; directions are reduced to 0° … 360°."""
    reported = value.value % 360 if value.unit == "deg" else value.value
    return {"value": number(reported), "stderr": number(value.stderr), "unit": value.unit}


def describe_evidence(
    name: str, gain: float, z: float, consistency: Consistency | None, rivals: Mapping[str, float]
) -> dict[str, Any]:
    """Return the value of the key `evidence` of an effect.

    Parameters
    ----------
    name : str
        Name of the effect.
    gain : float
        Drop of −2 ln L by it; NaN if unknown.
    z : float
        Its strength in standard errors; NaN if unknown.
    consistency : Consistency or None
        Test of its strength over cells of the data; None if there is none.
    rivals : mapping of str to float
        By how much −2 ln L is larger with each rival in its place.
    """
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
    """Return the posterior probability of each candidate, with equal prior probabilities.

    `behind` is by how much −2 ln L is larger with each than with the effect of the verdict. Probabilities are in
    proportion to exp(−behind/2) and sum to 1.
    """
    least = min(behind.values())
    likelihoods = {name: float(np.exp((least - difference) / 2)) for name, difference in behind.items()}
    total = sum(likelihoods.values())
    return {name: likelihood / total for name, likelihood in likelihoods.items()}


def describe_light(light: LearnedLight) -> dict[str, Any]:
    """Return the value of the key `light`: how a learned light shape differs from the declared one."""
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
    """Return a row of the key `sheet`: a number of the data sheet, and its fitted value.

    `z` is None if the frames do not make the standard error smaller than that of the data sheet.
    """
    return {
        "name": pull.name,
        "unit": pull.unit,
        "stated": float(pull.stated),
        "stated_stderr": float(pull.stated_stderr),
        "found": float(pull.fitted),
        "stderr": number(pull.stderr),
        "stated_errors": number(pull.shift),
        "z": number(pull.z) if pull.stderr < pull.stated_stderr else None,
        "contradicts": pull.contradicts,
    }


def describe_limit(limit: UpperLimit) -> dict[str, Any]:
    """Return a row of the key `limits`: the range (95 %) of the strength of an effect that is not named."""
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
    """Return the value of the key `baseline_shift`: p1 and p2 [px] under the declared and the extended model.

    They are the parameters of the width's law in exposure t, σ_g − laser width = p1 ln t + p2.
    """
    return {
        name: {"before": number(before), "after": number(after), "stderr": number(stderr), "unit": "px"}
        for name, before, after, stderr in zip(("p1", "p2"), law.before, law.after, law.stderr, strict=True)
    }


def describe_unexplained(unexplained: Unexplained | None, tolerance: float) -> dict[str, Any]:
    """Return the value of the key `unexplained`: the rms that remains beside all effects [peak].

    The error is estimated for size², so that `error` is that towards larger sizes: √(size² + error of size²) − size.
    """
    size = error = z = share = p_value = None
    if unexplained is not None:
        share, p_value = number(unexplained.share), probability(unexplained.p_value)
        share = None if share is None else float(np.clip(share, 0.0, 1.0))
        if np.isfinite(unexplained.variance_error):
            size, z = number(unexplained.size), number(unexplained.z)
            error = number(np.sqrt(unexplained.size**2 + unexplained.variance_error) - unexplained.size)
    return {"size": size, "error": error, "z": z, "tolerance": tolerance, "share": share, "p_value": p_value}


def describe_gap(gap: Gap | None) -> dict[str, Any]:
    """Return the value of the key `gap`: residuals on held-out data; all None without held-out data."""
    keys = ("before", "after", "noise_floor", "closed", "rms_dn_before", "rms_dn_after", "gain")
    if gap is None:
        return dict.fromkeys((*keys, "on"))
    return {key: number(getattr(gap, key)) for key in keys} | {"on": gap.on}


def describe_levels(levels: LevelFindings) -> dict[str, Any]:
    """Return the value of the key `levels`: the gain K from levels of flats, and the scatter of their light."""
    return {
        "number": int(levels.number),
        "gain_dn_per_e": {"value": float(levels.gain.value), "stderr": number(levels.gain.stderr)},
        "straight_line": {"value": float(levels.straight_line.value), "stderr": number(levels.straight_line.stderr)},
        "light_scatter": float(levels.light_scatter),
    }


def number(value: float | None) -> float | None:
    """Return a number as a Python float; None for None, NaN and infinity."""
    return None if value is None or not np.isfinite(value) else float(value)


def probability(value: float) -> float | None:
    """Return a p-value as a Python float, raised to `LEAST_PROBABILITY` if it is less; None for NaN."""
    return number(np.clip(value, LEAST_PROBABILITY, 1.0))
