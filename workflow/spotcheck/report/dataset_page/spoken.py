"""The first screen's sentences: the verdict as a person says it aloud, how sure it is, and what to measure next."""

from typing import Any, NamedTuple

from spotcheck.discrepancy.limits import ALREADY_PRESENT
from spotcheck.discrepancy.sentence import effect_text, either_text
from spotcheck.discrepancy.words import condition_text, list_text, percent_text, probability_text, value_text

# A p-value below which a person speaks of certainty: once in ten thousand.
CERTAIN = 1e-4
# Effects that what stays unexplained is said to look like, at most.
MOST_LIKE = 3
# Of flats, in place of what is said of spots.
SPOT, FLATS = "The measured spot is", "The measured levels are"
MODEL, LINEAR = "the model says", "a linear sensor gives"


class Spoken(NamedTuple):
    """Three sentences at most."""

    verdict: str
    sure: str
    next: str


def spoken(verdict: dict[str, Any]) -> Spoken:
    """The sentences of a verdict, whatever its status."""
    certain, gain = sure(verdict), gain_of(verdict)
    return Spoken(headline(verdict), f"{certain[:-1]}; {gain}." if certain and gain else certain, measure_next(verdict))


def numbers_in(verdict: dict[str, Any]) -> dict[str, str]:
    """Texts of the numbers that the sentences hold, and the keys by which they are found again."""
    detection, left, closed = verdict["detection"], verdict["unexplained"]["size"], verdict["gap"]["closed"]
    found = {}
    for own in verdict["effects"]:
        for name, p in own["parameters"].items():
            text = value_text(p["value"], p["stderr"], p["unit"])
            # A whole number without a unit may be a count in the sentence, and is no value that it tells.
            if not text.isdigit():
                found[text] = f"verdict.effects.{own['name']}.{name}"
    for name in ("straight_line", "gain_dn_per_e") if "levels" in verdict else ():
        found[_in_dn(verdict["levels"][name])] = f"verdict.levels.{name}"
    for name, own in verdict["baseline_shift"].items():
        if own["after"] is not None:
            found[value_text(own["after"], own["stderr"], own["unit"])] = f"verdict.baseline_shift.{name}.after"
    if detection["p_value"] is not None:
        found[probability_text(detection["p_value"])] = "verdict.detection.p_value"
    if closed is not None:
        found[percent_text(min(closed, 1.0))] = "verdict.gap.closed"
    if left is not None:
        found[percent_text(left)] = "verdict.unexplained.size"
    if detection["rms_residual_percent_of_peak"] is not None:
        rms = percent_text(detection["rms_residual_percent_of_peak"] / 100)
        found[rms] = "verdict.detection.rms_residual_percent_of_peak"
    return found


def headline(verdict: dict[str, Any]) -> str:
    """The verdict in one sentence."""
    subject, model = (FLATS, LINEAR) if "levels" in verdict else (SPOT, MODEL)
    status = verdict["status"]
    if status == "not_assessed":
        return f"Nothing could be tested: {_why_none(verdict)}."
    if status == "not_converged":
        return f"No effect is named: {_why_none(verdict)}."
    if status == "consistent":
        return f"{subject} what {model}: they differ by no more than noise does."
    if status == "unknown":
        return f"{subject} not what {model}, and no known effect explains why."
    first, more = verdict["effects"][0], len(verdict["effects"]) - 1
    tied = [own for own in verdict["effects"] if len(own["candidates"]) > 1]
    if status == "ambiguous":
        return f"{subject} not what {model}: {either_text(tied[0], verdict)}."
    beside = {0: "", 1: ", and one more effect is at work"}.get(more, f", and {more} more effects are at work")
    return f"{subject} not what {model}: {effect_text(first, verdict)}{beside}."


def sure(verdict: dict[str, Any]) -> str:
    """How sure that is, in words and with the number behind it."""
    status, p = verdict["status"], verdict["detection"]["p_value"]
    if status in ("not_assessed", "not_converged") or p is None:
        return ""
    if status == "consistent":
        return f"Noise alone would differ as much in {percent_text(p)} of such measurements ({probability_text(p)})."
    if p < CERTAIN:
        chance = f"Certain: noise alone would do this less than once in ten thousand times ({probability_text(p)})"
    elif p < verdict["detection"]["alpha"]:
        chance = f"Sure: noise alone would do this in {percent_text(p)} of such measurements ({probability_text(p)})"
    else:
        but = "tests of single effects do" if verdict["effects"] else "the residual exceeds the tolerance"
        chance = f"The overall test finds no disagreement ({probability_text(p)}), but {but}"
    if status == "unknown":
        return f"{chance}."
    closed = verdict["gap"]["closed"]
    if status == "ambiguous":
        return f"{chance}, but not which of them it is."
    if closed is None or closed <= 0:
        return f"{chance}, and no other known effect does as well."
    what = "these effects close" if len(verdict["effects"]) > 1 else "this effect closes"
    if verdict["light"] is not None and len(verdict["effects"]) == 1:
        what = "the learned shape closes"
    return f"{chance}, and {what} {percent_text(min(closed, 1.0))} of the gap on {verdict['gap']['on']}."


def gain_of(verdict: dict[str, Any]) -> str:
    """What flats tell of the gain; "" of spots."""
    if "levels" not in verdict:
        return ""
    line, found = (_in_dn(verdict["levels"][name]) for name in ("straight_line", "gain_dn_per_e"))
    if verdict["effects"]:
        which = "this effect" if len(verdict["effects"]) == 1 else "these effects"
        return f"the gain K is {found} with {which}; a straight line (EMVA 1288) gives {line}"
    return f"the gain K is {line}, by a straight line (EMVA 1288)"


def _in_dn(own: dict[str, Any]) -> str:
    return value_text(own["value"], own["stderr"], "DN/e-")


def measure_next(verdict: dict[str, Any]) -> str:
    """What to measure next; where there is nothing, why."""
    status, left = verdict["status"], verdict["unexplained"]["size"]
    if verdict["advice"]:
        told = [
            f"{own['frames']} frame{'s' if own['frames'] > 1 else ''} at {condition_text(own['condition'])}, which"
            f" would separate {own['separates'][0]} from {own['separates'][1]}"
            for own in verdict["advice"]
        ]
        return f"Measure next: {list_text(told, '; ')}."
    if status == "ambiguous":
        return "No measurement is known that would separate them."
    if status == "not_converged":
        return "No measurement can be advised before the fits converge."
    if status == "not_assessed":
        return "No measurement can be advised before that is corrected."
    if status == "unknown":
        shows = f"; it shows most in {verdict['where'][0]['words']}" if verdict["where"] else ""
        return f"No measurement can be advised, for no known effect predicts one{shows}."
    if status == "named_more_remains" and left is not None:
        seen = [own["effect"] for own in verdict["limits"] if own["more"] == ALREADY_PRESENT][:MOST_LIKE]
        none = "none of them explains it" if len(seen) > 1 else "it does not explain it"
        like = f"nearest come {list_text(seen)}, but {none}" if seen else "no known effect comes near"
        return (
            f"What is named needs no further measurement; {percent_text(left)} of the peak remains unexplained: {like}."
        )
    if status == "consistent":
        return "Nothing more is needed; further frames would only tighten the limits on what does not show."
    return "No further measurement is needed to name it."


def _why_none(verdict: dict[str, Any]) -> str:
    reasons = [own["why"] for own in verdict["not_assessed"] if own["effect"] == "all"]
    return list_text(reasons, "; ") or "no test was possible"
