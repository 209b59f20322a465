"""The summary at the top of the report: the verdict, its significance, and what to measure next.

The verdict (verdict.json) says which effects the model of the frames lacks. A verdict is on spots, or on flats and
darks; only the latter has an entry `levels`, the means and variances of flats and darks. The gap is the mean square of
block residuals over that of the noise, on held-out data. The `status` of a verdict is one of:

- not_assessed: nothing could be tested;
- not_converged: a fit failed, so that no effect is named;
- consistent: the frames agree with the model;
- unknown: they disagree, and no known effect explains it;
- ambiguous: several effects explain it equally well;
- named: the named effects explain it;
- named_more_remains: effects are named, and a part remains unexplained.
"""

from typing import Any, NamedTuple

from spotcheck.discrepancy.limits import ALREADY_PRESENT
from spotcheck.discrepancy.sentence import describe_exception, effect_text, either_text
from spotcheck.discrepancy.words import condition_text, list_text, percent_text, probability_text
from spotcheck.io.number_text import quantity_text

# A p-value below this is written as "less than once in ten thousand measurements".
RARE = 1e-4
# Largest number of effects that are listed as similar to the unexplained residual.
MAX_SIMILAR_EFFECTS = 3


class Summary(NamedTuple):
    """Sentences that summarize a verdict. The second one is "" if nothing was tested."""

    verdict: str  # whether the frames agree with the model, or the effects that explain the difference
    significance: str  # p-value, share of the gap that the effects close, and the gain K from flats
    advice: str  # what to measure next


def summarize(verdict: dict[str, Any]) -> Summary:
    """Return the summary of a verdict, which is the content of verdict.json."""
    significance, gain_clause = _describe_significance(verdict), _describe_gain(verdict)
    if significance and gain_clause:
        # The clause replaces the full stop of the sentence.
        significance = f"{significance[:-1]}; {gain_clause}."
    return Summary(_describe_verdict(verdict), significance, _advise(verdict))


def number_keys(verdict: dict[str, Any]) -> dict[str, str]:
    """Return the key of each number that sentences about a verdict may contain, by its text in a sentence.

    A key is the full name of a number for `spotcheck explain`: "97 %" may have the key "verdict.gap.closed".
    """
    detection, unexplained, closed = verdict["detection"], verdict["unexplained"]["size"], verdict["gap"]["closed"]
    keys = {}
    for effect in verdict["effects"]:
        for name, value in effect["parameters"].items():
            text = _value_text(value)
            # A whole number without a unit may be a count in a sentence instead.
            if not text.isdigit():
                keys[text] = f"verdict.effects.{effect['name']}.{name}"
    for name in ("straight_line", "gain_dn_per_e") if "levels" in verdict else ():
        keys[_gain_text(verdict, name)] = f"verdict.levels.{name}"
    for name, shift in verdict["baseline_shift"].items():
        if shift["after"] is not None:
            text = quantity_text(shift["after"], shift["stderr"], shift["unit"])
            keys[text] = f"verdict.baseline_shift.{name}.after"
    if detection["p_value"] is not None:
        keys[probability_text(detection["p_value"])] = "verdict.detection.p_value"
    if closed is not None:
        keys[percent_text(min(closed, 1.0))] = "verdict.gap.closed"
    if unexplained is not None:
        keys[percent_text(unexplained)] = "verdict.unexplained.size"
    if detection["rms_residual_percent_of_peak"] is not None:
        rms = percent_text(detection["rms_residual_percent_of_peak"] / 100)
        keys[rms] = "verdict.detection.rms_residual_percent_of_peak"
    return keys


def _value_text(parameter: dict[str, Any]) -> str:
    """Return the value of a parameter of an effect with error and unit, from its entry in verdict.json."""
    return quantity_text(parameter["value"], parameter["stderr"], parameter["unit"])


def _gain_text(verdict: dict[str, Any], name: str) -> str:
    """Return a gain K of a verdict on flats as text.

    `name` is "straight_line" for the slope of the variance over the mean, or "gain_dn_per_e" for the gain of the model
    with the named effects.
    """
    gain = verdict["levels"][name]
    return quantity_text(gain["value"], gain["stderr"], "DN/e-")


def _describe_verdict(verdict: dict[str, Any]) -> str:
    """Return one sentence: the frames agree with the model, or these effects explain the difference."""
    status = verdict["status"]
    if status in ("not_assessed", "not_converged"):
        # The effect "all" stands for the whole verdict.
        reasons = [entry["why"] for entry in verdict["not_assessed"] if entry["effect"] == "all"]
        opening = "Nothing could be tested" if status == "not_assessed" else "No effect is named"
        return f"{opening}: {list_text(reasons, '; ') or 'no test was possible'}."
    data, model = ("levels", "a linear sensor") if "levels" in verdict else ("spot", "the model")
    verb = "agree" if "levels" in verdict else "agrees"
    if status == "consistent":
        return f"The measured {data} {verb} with {model} within the noise."
    opening = f"The measured {data} dis{verb} with {model}"
    if status == "unknown":
        return f"{opening}, and no known effect explains the difference."
    effects = verdict["effects"]
    if status == "ambiguous":
        ambiguous_effect = next(effect for effect in effects if len(effect["candidates"]) > 1)
        return f"{opening}: {either_text(ambiguous_effect, verdict)}."
    count = len(effects) - 1
    more = {0: "", 1: ", and one more effect was detected"}.get(count, f", and {count} more effects were detected")
    return f"{opening}: {effect_text(effects[0], verdict)}{more}."


def _describe_significance(verdict: dict[str, Any]) -> str:
    """Return a sentence on the p-value of the overall test and the closed share of the gap; "" without a test."""
    status, p, effects = verdict["status"], verdict["detection"]["p_value"], verdict["effects"]
    if status in ("not_assessed", "not_converged") or p is None:
        return ""
    chance = f"in {percent_text(p)} of such measurements ({probability_text(p)})"
    if status == "consistent":
        return f"Noise alone causes a difference at least as large {chance}."
    if p < RARE:
        chance = f"less than once in ten thousand measurements ({probability_text(p)})"
    if p < max(RARE, verdict["detection"]["alpha"]):
        text = f"Noise alone causes such a difference {chance}"
    else:
        # The overall test may miss what a test of one effect finds.
        text = f"The overall test finds no disagreement ({probability_text(p)}), but {describe_exception(verdict)}"
    if status == "unknown":
        return f"{text}."
    if status == "ambiguous":
        return f"{text}, but these effects cannot be told apart."
    closed = verdict["gap"]["closed"]
    if closed is None or closed <= 0:
        return f"{text}, and no other known effect fits as well."
    if len(effects) > 1:
        cause = "these effects close"
    else:
        cause = "this effect closes" if verdict["light"] is None else "the learned shape closes"
    # Noise may raise the closed share above 1.
    return f"{text}, and {cause} {percent_text(min(closed, 1.0))} of the gap on {verdict['gap']['on']}."


def _describe_gain(verdict: dict[str, Any]) -> str:
    """Return a clause without full stop on the gain K [DN/e-] from flats; "" for a verdict on spots."""
    if "levels" not in verdict:
        return ""
    line = _gain_text(verdict, "straight_line")
    if not verdict["effects"]:
        return f"the gain K is {line}, by a straight line (EMVA 1288)"
    effects = "this effect" if len(verdict["effects"]) == 1 else "these effects"
    gain = _gain_text(verdict, "gain_dn_per_e")
    return f"the gain K is {gain} with {effects}; a straight line (EMVA 1288) gives {line}"


def _advise(verdict: dict[str, Any]) -> str:
    """Return a sentence on what to measure next, or on why there is no such advice."""
    status, unexplained = verdict["status"], verdict["unexplained"]["size"]
    if verdict["advice"]:
        measurements = [
            f"{advice['frames']} frame{'s' if advice['frames'] > 1 else ''} at {condition_text(advice['condition'])},"
            f" which would separate {advice['separates'][0]} from {advice['separates'][1]}"
            for advice in verdict["advice"]
        ]
        return f"Measure next: {list_text(measurements, '; ')}."
    if status == "unknown":
        place = f"; the residual is largest in {verdict['where'][0]['words']}" if verdict["where"] else ""
        return f"No measurement can be advised, because no known effect predicts the difference{place}."
    if status == "named_more_remains" and unexplained is not None:
        # Effects whose fitted strength is significant, although they are not named.
        present = [limit["effect"] for limit in verdict["limits"] if limit["more"] == ALREADY_PRESENT]
        similar = present[:MAX_SIMILAR_EFFECTS]
        contrast = "none of them explains it" if len(similar) > 1 else "it does not explain it"
        nearest = (
            f"most similar: {list_text(similar)}, but {contrast}" if similar else "no known effect is similar to it"
        )
        rest = f"{percent_text(unexplained)} of the peak remains unexplained ({nearest})"
        return f"The named effects need no further measurement; {rest}."
    return {
        "ambiguous": "No measurement is known that would separate them.",
        "not_converged": "No measurement can be advised before the fits converge.",
        "not_assessed": "No measurement can be advised before that is corrected.",
        "consistent": "No further measurement is needed; more frames would only tighten the upper limits.",
    }.get(status, "No further measurement is needed to identify the effect.")
