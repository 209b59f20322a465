"""The verdict on a dataset: the content of verdict.json (version 4), from a record of findings.

Numbers that are not known are NaN in findings and None in the verdict. A gain is the drop of −2 ln L by an effect.
Rivals of an effect are other effects that explain the data about as well. A learned light shape is a free one, fitted
beside the declared shape, which the verdict lists like an effect.
"""

from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from enum import Enum
from typing import Any

import numpy as np

from spotcheck.discrepancy.criteria import ALPHA, CLEAR_ERRORS, LARGEST_GAP, TOLERANCE
from spotcheck.discrepancy.findings import (
    Detection,
    Findings,
    Gap,
    LawShift,
    LearnedLight,
    NamedEffect,
    ParameterValue,
    SensorPull,
    Unexplained,
    UpperLimit,
)
from spotcheck.discrepancy.words import limit_text, size_text
from spotcheck.model.effects import built_in, vocabulary

VERSION = 4
# Significant digits of all numbers: more than are known of any of them, and so few that all processors agree on them.
DIGITS = 9
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
    general_rows = [("all", why) for why in (reason, *findings.remarks, findings.deviating_frames) if why]
    effects = ([effect_of_light(findings.light)] if findings.light else []) + list(findings.effects)
    document = {
        "schema": VERSION,
        "dataset": dataset_name,
        "status": status.value,
        "detection": describe_detection(findings.detection, findings.rms_of_peak, alpha),
        "where": list(map(asdict, findings.places)),
        "effects": list(map(describe_effect, effects)),
        "light": findings.light and describe_light(findings.light),
        "sheet": list(map(describe_pull, findings.sensor)),
        "limits": list(map(describe_limit, findings.limits)),
        "baseline_shift": describe_law(findings.law),
        "unexplained": describe_unexplained(findings.unexplained, tolerance),
        "gap": asdict(findings.gap) if findings.gap else dict.fromkeys(field.name for field in fields(Gap)),
        "metrics": list(map(asdict, findings.metrics)),
        "advice": list(map(asdict, findings.advice)),
        "not_assessed": [{"effect": name, "why": why} for name, why in (*general_rows, *findings.not_assessed)],
        "sentence": "",
    }
    if levels := findings.levels:
        document["levels"] = {
            "number": levels.number,
            "gain_dn_per_e": describe_gain(levels.gain),
            "straight_line": describe_gain(levels.straight_line),
            "light_scatter": levels.light_scatter,
        }
    return plain(document)


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
        return Status.UNKNOWN if is_detected or is_exceeded or deviates_on_held_out(findings) else Status.CONSISTENT
    if any(effect.rivals for effect in findings.effects):
        return Status.AMBIGUOUS
    return Status.NAMED_MORE_REMAINS if is_exceeded else Status.NAMED


def deviates_on_held_out(findings: Findings) -> bool:
    """Return whether held-out data are far from the model, which detection does not test them against."""
    gap = findings.gap
    return bool(findings.deviating_frames) or (gap is not None and gap.after > LARGEST_GAP * gap.noise_floor)


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


# Keys of the document


def describe_detection(detection: Detection | None, rms_of_peak: float, alpha: float) -> dict[str, Any]:
    """Return the value of the key `detection`.

    `detection` is None if nothing was tested. `rms_of_peak` is the rms of the mean residual [peak], NaN if unknown.
    """
    tests = detection.tests if detection else ()
    # p-values may be equal, at the smallest one that is reported: then the largest z decides.
    worst = min(tests, key=lambda test: (test.p_value, -test.z), default=None)
    return {
        "p_value": detection and detection.p_value,
        "alpha": alpha,
        "parts": len(tests),
        "worst": worst
        and {"part": worst.name, "where": worst.where, "statistic": worst.statistic, "p_value": worst.p_value},
        "rms_residual_percent_of_peak": 100 * rms_of_peak,
    }


def effect_of_light(light: LearnedLight) -> NamedEffect:
    """Return a learned light shape as an effect: its power, and the azimuthal order with most of it."""
    power, order = LEARNED_SHAPE.parameters
    highest = float(np.argmax(light.orders)) if any(light.orders) else np.nan
    applied = LEARNED_SHAPE.apply({power.name: light.power, order.name: np.nan_to_num(highest)})
    return NamedEffect(
        applied=applied,
        values={
            power.name: ParameterValue(light.power, light.stderr, power.unit),
            order.name: ParameterValue(highest, np.nan, order.unit),
        },
        gain=light.gain,
        z=light.power / light.stderr if light.stderr > 0 else np.nan,
        gap_closed=light.gap_closed,
    )


def describe_effect(effect: NamedEffect) -> dict[str, Any]:
    """Return the row of an effect in `effects`; its parameters have the order of the vocabulary, the strength first."""
    test, rivals = effect.consistency, sorted(effect.rivals, key=effect.rivals.__getitem__)
    weights = weigh_candidates({effect.name: 0.0, **effect.rivals})
    order = [parameter.name for parameter in effect.applied.effect.parameters]
    return {
        "name": effect.name,
        "candidates": [effect.name, *rivals],
        "form": effect.applied.variant.value,
        "parameters": {name: describe_value(effect.values[name]) for name in sorted(effect.values, key=order.index)},
        "gap_closed": effect.gap_closed,
        "evidence": {
            "gain": effect.gain,
            "z": effect.z,
            "consistency": test
            and {"q": test.q, "cells": test.cells, "limit": test.limit, "holds": test.is_consistent},
            "weight": weights[effect.name],
            "rivals": [{"name": name, "behind": effect.rivals[name], "weight": weights[name]} for name in rivals],
        },
    }


def describe_value(value: ParameterValue) -> dict[str, Any]:
    """Return value, standard error and unit of a parameter; directions are reduced to 0° … 360°."""
    return asdict(replace(value, value=value.value % 360) if value.unit == "deg" else value)


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
    axes = {"major": light.major, "minor": light.minor, "direction_deg": light.direction_deg % 360}
    row = {key: getattr(light, key) for key in ("power", "stderr", "orders", "lowest", "words")}
    return row | {"axes": axes}


def describe_pull(pull: SensorPull) -> dict[str, Any]:
    """Return a row of the key `sheet`: a number of the data sheet, or as measured, and its fitted value.

    `z` is None if the frames do not make the standard error smaller than that of the stated value, or if this was
    measured in the same frames.
    """
    return {
        "name": pull.name,
        "unit": pull.unit,
        "source": pull.source,
        "stated": pull.stated,
        "stated_stderr": pull.stated_stderr,
        "found": pull.fitted,
        "stderr": pull.stderr,
        "stated_errors": pull.shift,
        "z": pull.z if pull.stderr < pull.stated_stderr and pull.is_independent else None,
        "contradicts": pull.contradicts,
    }


def describe_limit(limit: UpperLimit) -> dict[str, Any]:
    """Return a row of the key `limits`: the range (95 %) of the strength of an effect that is not named."""
    effect = (built_in() | dict(vocabulary())).get(limit.effect)
    low, high = (limit_text(end, limit.unit, effect) if np.isfinite(end) else "" for end in (limit.low, limit.high))
    row = {key: getattr(limit, key) for key in ("effect", "parameter", "low", "high", "unit", "frames")}
    words = size_text(effect, low, high) if effect else ""
    return row | {"words": words, "why": limit.reason, "more": limit.remark}


def describe_law(law: LawShift) -> dict[str, Any]:
    """Return the value of the key `baseline_shift`: p1 and p2 [px] under the declared and the extended model.

    They are the parameters of the width's law in exposure t, σ_g − laser width = p1 ln t + p2.
    """
    return {
        name: {"before": before, "after": after, "stderr": stderr, "unit": "px"}
        for name, before, after, stderr in zip(("p1", "p2"), law.before, law.after, law.stderr, strict=True)
    }


def describe_unexplained(unexplained: Unexplained | None, tolerance: float) -> dict[str, Any]:
    """Return the value of the key `unexplained`: the rms that remains beside all effects [peak].

    The error is estimated for size², so that `error` is that towards larger sizes: √(size² + error of size²) − size.
    """
    row: dict[str, Any] = dict.fromkeys(("size", "error", "z", "share", "p_value")) | {"tolerance": tolerance}
    if unexplained is not None:
        row |= {"share": np.clip(unexplained.share, 0.0, 1.0), "p_value": unexplained.p_value}
        if np.isfinite(unexplained.variance_error):
            error = np.sqrt(unexplained.size**2 + unexplained.variance_error) - unexplained.size
            row |= {"size": unexplained.size, "error": error, "z": unexplained.z}
    return row


def describe_gain(gain: ParameterValue) -> dict[str, float]:
    """Return the value of a key of `levels` with a gain K of the sensor [DN/e-]."""
    return {"value": gain.value, "stderr": gain.stderr}


def plain(value: Any) -> Any:
    """Return a tree with lists for tuples and Python numbers for numpy's.

    Floats are rounded to `DIGITS` digits; None stands for NaN and infinity.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None
    return value
