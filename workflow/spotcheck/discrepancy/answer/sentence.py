"""The verdict as a person would say it, in at most three lines: is there a disagreement, what is it, and how sure."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from spotcheck.discrepancy import criteria
from spotcheck.discrepancy.answer.document import LIGHT
from spotcheck.model.effects import vocabulary

UNITS = {"1": "", "deg": "°", "degree": "°"}
PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: ""}
SHEET_WORDS = {"gain_dn_per_e": "the gain", "read_noise_e": "the read noise", "black_level_dn": "the black level"}
# Smaller p-values are not read as numbers.
SMALL_P = 1e-4
# So many effects are told in whole sentences, the others by name and strength.
IN_FULL = 2
# Below this part over the noise floor the mean images had no gap to speak of.
NO_GAP = 0.02
# p1 or p2 is told where effects move it by so many of its errors.
MOVED = 3.0


def sentence(document: dict[str, Any]) -> str:
    """At most three lines, parted by line breaks; the document's own `sentence` is not read."""
    status = document["status"]
    if status == "not_assessed":
        lines = [_untested(document)]
    elif status == "consistent":
        lines = [_agreed(document), _as_fitted(document), _not_proven(document)]
    elif status == "unknown":
        lines = [_opening(document), *_unknown(document)]
    else:
        tied = status == "ambiguous"
        sure = _advised(document) if tied else _sure(document)
        lines = [_opening(document), _effects(document), _joined(_closed(document), _left(document), sure,
                                                                 "" if tied else _moved(document))]  # fmt: skip
    lines[0] = _joined(_contradicted(document), lines[0])
    return "\n".join(line for line in lines if line)


# Numbers in words


def value_text(value: float | None, stderr: float | None, unit: str) -> str:
    """Value ± standard error with two digits of the error, and the unit: `0.0240 ± 0.0011`, `−3.1 ± 0.4 µs`."""
    if value is None or not np.isfinite(value):
        return "no value"
    unit = UNITS.get(unit, unit)
    if unit == "s" and value:
        power = int(np.clip(3 * np.floor(np.log10(abs(value)) / 3), -9, 0))
        value, stderr = value / 10.0**power, None if stderr is None else stderr / 10.0**power
        unit = PREFIXES[power] + "s"
    tail = unit if unit in ("", "°") else f" {unit}"
    if stderr is None or not np.isfinite(stderr) or stderr <= 0:
        text = f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    else:
        digits = int(np.clip(1 - np.floor(np.log10(stderr)), -9, 9))
        shown = max(digits, 0)
        text = f"{round(value, digits):.{shown}f} ± {round(stderr, digits):.{shown}f}"
    return f"{text}{tail}".replace("-", "−")


def condition_text(condition: Mapping[str, Any]) -> str:
    """A measurement in words: `an exposure of 1.8 ms and 45°`."""
    words = []
    for name, value in condition.items():
        if name == "exposure_s":
            words.append(f"an exposure of {value_text(value, None, 's')}")
        elif name == "angle_deg" and value is not None:
            words.append(f"{value:.4g}°")
        elif name != "blocked" and value is not None:
            words.append(f"{name} {value:.4g}")
    return _list(words) + (" with the beam blocked" if condition.get("blocked") else "")


def percent_text(part: float) -> str:
    """A part in percent with two digits, three from 90 % on; what is not quite all is never called all."""
    percent = 100 * min(part, 1.0)
    if 90 <= percent < 100:
        # 99.97 % is 99.9 %: rounded down.
        return f"{np.floor(10 * percent) / 10:.3g} %"
    return "100 %" if percent >= 100 else f"{percent:.2g} %".replace("-", "−")


def probability_text(p: float) -> str:
    """A p-value, as far as one reads it."""
    return f"p = {p:.2g}" if p >= SMALL_P else "p < 0.0001"


# First line: is there a disagreement


def _contradicted(document: dict[str, Any]) -> str:
    """Numbers of the data sheet that frames contradict."""
    rows = [own for own in document["sheet"] if own["contradicts"]]
    told = [
        f"{SHEET_WORDS.get(own['name'], own['name'])} is {value_text(own['found'], own['stderr'], own['unit'])},"
        f" not {value_text(own['stated'], own['stated_stderr'], own['unit'])}"
        for own in rows
    ]
    return f"The frames contradict the data sheet: {_list(told)}." if rows else ""


def _opening(document: dict[str, Any]) -> str:
    """That model and measurement disagree, and by how much."""
    detection, tolerance = document["detection"], document["unexplained"]["tolerance"]
    p, percent = detection["p_value"], detection["rms_residual_percent_of_peak"]
    odds = f" ({probability_text(p)})" if p is not None else ""
    if p is not None and p >= detection["alpha"]:
        if document["effects"]:
            return f"Taken as a whole, model and measurement look alike ({probability_text(p)}), but not everywhere."
        return f"No single test finds a disagreement ({probability_text(p)}), but more is left than noise brings."
    if percent is None:
        return f"Model and measurement disagree{odds}."
    if percent < 100 * tolerance:
        return f"Model and measurement disagree, though hardly in the mean image{odds}."
    return f"Model and measurement disagree: the mean image is off by {percent:.2g} % of the spot's peak{odds}."


def _agreed(document: dict[str, Any]) -> str:
    p = document["detection"]["p_value"]
    odds = f" ({probability_text(p)})" if p is not None else ""
    return f"Model and measurement agree: they differ by no more than noise does{odds}."


def _untested(document: dict[str, Any]) -> str:
    whole = [own["why"] for own in document["not_assessed"] if own["effect"] == "all"]
    return f"Nothing could be tested: {_list(whole, '; ') or 'no test was possible'}."


# Second line: what it is


def _effects(document: dict[str, Any]) -> str:
    """Every effect: the first in whole sentences, the others by name and strength."""
    effects = document["effects"]
    parts = [_effect(own, document) for own in effects[:IN_FULL]]
    for own in effects[IN_FULL:]:
        others = "".join(f" or {name}" for name in own["candidates"][1:])
        parts.append(f"{_short(own)}{others}")
    text = parts[0] if len(parts) == 1 else f"{parts[0]}; beside it {_list(parts[1:])}"
    if len(parts) > IN_FULL:
        text = f"{parts[0]}; beside it {parts[1]}; and {_list(parts[2:])}"
    return f"{text[0].upper()}{text[1:]}."


def _effect(own: dict[str, Any], document: dict[str, Any]) -> str:
    """What an effect does, with its name and values, and what may stand in its place."""
    first = _light(document) if own["name"] == LIGHT else f"{_does(own['name'])} ({_named(own)})"
    if len(own["candidates"]) == 1:
        return first
    others = [f"{_does(name)} ({name})" for name in own["candidates"][1:]]
    weight, next_best = own["evidence"]["weight"], max(rival["weight"] for rival in own["evidence"]["rivals"])
    times = weight / max(next_best, 1e-300)
    likelier = f"the first is {times:.2g} times as likely" if times >= 1.5 else "none is likelier"
    return f"either {first}, or {_list(others, ', or ')}: these frames cannot tell which, {likelier}"


def _light(document: dict[str, Any]) -> str:
    light = document["light"]
    error = None if light["stderr"] is None else 100 * light["stderr"]
    words = f", {light['words']}" if light["words"] else ""
    return f"the light is not a Gaussian: {value_text(100 * light['power'], error, '%')} of its power lies elsewhere{words}"


def _does(name: str) -> str:
    """What an effect does, in the words of the vocabulary."""
    known = vocabulary().get(name)
    if known is not None:
        return known.sentence
    return "the light is not a Gaussian" if name == LIGHT else name


def _named(own: dict[str, Any]) -> str:
    values = [f"{key} {value_text(p['value'], p['stderr'], p['unit'])}" for key, p in own["parameters"].items()]
    return ", ".join([own["name"], *values])


def _short(own: dict[str, Any]) -> str:
    strength = dict(list(own["parameters"].items())[:1])
    return _named(own | {"parameters": strength}).replace(", ", " (", 1) + (")" if strength else "")


def _unknown(document: dict[str, Any]) -> list[str]:
    """That nothing is named, where the frames are oddest, and what is left."""
    what = "No effect of the vocabulary explains it: something else is at work"
    known = any(own["before"] is not None for own in document["baseline_shift"].values())
    what += ", and p1 and p2 may be off because of it." if known else "."
    where = f"It shows most in {document['where'][0]['words']}." if document["where"] else ""
    return [what, _joined(where, _left(document))]


# Third line: how sure, and how much of the gap is closed


def _closed(document: dict[str, Any]) -> str:
    """The part of the gap that closes on frames that had no part in it."""
    gap, effects = document["gap"], document["effects"]
    if gap["before"] is None or gap["on"] is None:
        return "It was not checked on frames of its own."
    floor = gap["noise_floor"]
    if gap["closed"] is None or (floor is not None and gap["before"] < floor * (1 + NO_GAP)):
        return "It shows in the scatter: the mean images fitted already."
    share, on = percent_text(gap["closed"]), gap["on"]
    if gap["closed"] <= 0:
        return f"It closes no gap on {on}."
    if document["status"] == "ambiguous":
        return f"Either way {share} of the gap closes on {on}."
    if len(effects) == 1:
        who = "A learned shape" if effects[0]["name"] == LIGHT else "Added to the model, it"
        return f"{who} closes {share} of the gap on {on}."
    light = next((own["gap_closed"] for own in effects if own["name"] == LIGHT), None)
    own = f", the light's shape alone {percent_text(light)}" if light is not None else ""
    return f"Together they close {share} of the gap on {on}{own}."


def _left(document: dict[str, Any]) -> str:
    """What is left in the mean image, or how much may be."""
    left = document["unexplained"]
    size, error, tolerance = left["size"], left["error"], left["tolerance"]
    if size is None or error is None:
        return ""
    doubt = criteria.STATED.value * ((size + error) ** 2 - size**2)
    if size**2 - doubt > tolerance**2:
        return f"No effect explains the {value_text(100 * size, 100 * error, '%')} of the peak that are left."
    return f"In the mean image less than {percent_text(max(np.sqrt(size**2 + doubt), tolerance))} of the peak is left."


def _sure(document: dict[str, Any]) -> str:
    if [own["name"] for own in document["effects"]] == [LIGHT]:
        return "Nothing else is needed beside it."
    return "No other effect explains these frames as well."


def _advised(document: dict[str, Any]) -> str:
    """Measurements that would tell rivals apart."""
    told = [
        f"{own['frames']} frame{'s' if own['frames'] > 1 else ''} at {condition_text(own['condition'])} would tell"
        f" {own['separates'][0]} from {own['separates'][1]}"
        for own in document["advice"]
    ]
    text = _list(told, "; ")
    return f"{text[0].upper()}{text[1:]}." if told else "No next measurement was found that would tell them apart."


def _moved(document: dict[str, Any]) -> str:
    """p1 and p2 where the effects moved them."""
    moved = []
    for name, own in document["baseline_shift"].items():
        before, after, error = own["before"], own["after"], own["stderr"]
        if before is None or after is None or not error or abs(after - before) <= MOVED * error:
            continue
        digits = int(np.clip(1 - np.floor(np.log10(error)), 0, 6))
        moved.append(
            f"{name} goes from {before:.{digits}f}".replace("-", "−") + f" to {value_text(after, error, own['unit'])}"
        )
    whom = "it" if len(document["effects"]) == 1 else "them"
    return f"With {whom} {_list(moved)}." if moved else ""


# Where nothing is added


def _as_fitted(document: dict[str, Any]) -> str:
    values = [
        f"{name} = {value_text(own['before'], own['stderr'], own['unit'])}"
        for name, own in document["baseline_shift"].items()
        if own["before"] is not None
    ]
    return f"As fitted, {_list(values)}." if values else ""


def _not_proven(document: dict[str, Any]) -> str:
    known = any(own["value"] is not None for own in document["limits"])
    return "That does not prove the model: how large each effect could still be stands under limits." if known else ""


def _joined(*parts: str) -> str:
    return " ".join(part for part in parts if part)


def _list(words: Sequence[str], mark: str = "") -> str:
    """`a`, `a and b`, `a, b and c`; with a mark joined by it."""
    if mark or len(words) < 2:
        return mark.join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"
