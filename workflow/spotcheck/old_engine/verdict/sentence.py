"""The verdict as a person would say it, in at most three lines: is there a disagreement, what is it, and how sure."""

from typing import Any

import numpy as np

from spotcheck.old_engine import criteria
from spotcheck.old_engine.conclude.judgement import TOO_SMALL
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.verdict.document import LIGHT, NOT_FORETOLD
from spotcheck.old_engine.verdict.words import (
    condition_text,
    digits_of,
    list_text,
    percent_text,
    probability_text,
    value_text,
)

SHEET_WORDS = {"gain_dn_per_e": "the gain", "read_noise_e": "the read noise", "black_level_dn": "the black level"}
# So many effects are told in whole sentences, the others by name and strength.
IN_FULL = 2
# Below this part over the noise floor the mean images had no gap to speak of.
NO_GAP = 0.02
# Likelier by less than this is not worth a word.
LIKELIER = 1.5

# Of flats, in place of what is said of spots.
OF_LEVELS = {
    "Model and measurement": "Flats and a linear sensor",
    "model and measurement": "flats and a linear sensor",
    "the spot's peak": "the highest signal",
    "the peak": "the highest signal",
    "the mean images": "the means",
    "the mean image": "the means",
    "these frames": "these levels",
    "on unseen frames": "on unseen levels",
}
# A lamp that scatters by more than this from level to level is worth a word [part of its light].
SCATTERS = 0.002


def sentence(document: dict[str, Any]) -> str:
    """At most three lines, parted by line breaks; the document's own `sentence` is not read."""
    status = document["status"]
    if status == "not_assessed":
        lines = [_untested(document)]
    elif status == "consistent":
        lines = [_agreed(document), _joined(_as_fitted(document), _gain(document)), _not_proven(document)]
    elif status == "unknown":
        lines = [_opening(document), _unknown(document), _joined(_shown(document), _gain(document))]
    else:
        last = _joined(_closed(document), _advised(document), _moved(document), _gain(document))
        lines = [_opening(document), _effects(document), last]
    lines[0] = _joined(_contradicted(document), lines[0], _beware(document) if status != "not_assessed" else "")
    text = "\n".join(line for line in lines if line)
    for spots, flats in OF_LEVELS.items() if "levels" in document else ():
        text = text.replace(spots, flats)
    return text


# First line: is there a disagreement


def _contradicted(document: dict[str, Any]) -> str:
    """Numbers of the data sheet that frames contradict."""
    rows = [own for own in document["sheet"] if own["contradicts"]]
    told = [
        f"{SHEET_WORDS.get(own['name'], own['name'])} is {value_text(own['found'], own['stderr'], own['unit'])},"
        f" where it states {value_text(own['stated'], own['stated_stderr'], own['unit'])}"
        for own in rows
    ]
    return f"The frames contradict the data sheet: {list_text(told, '; ')}." if rows else ""


def _opening(document: dict[str, Any]) -> str:
    """That model and measurement disagree, and by how much."""
    detection, tolerance = document["detection"], document["unexplained"]["tolerance"]
    p, percent = detection["p_value"], detection["rms_residual_percent_of_peak"]
    odds = f"{probability_text(p)}" if p is not None else ""
    if p is not None and p >= detection["alpha"]:
        if document["effects"]:
            return f"Taken as a whole, model and measurement look alike ({odds}), but not everywhere."
        return f"No single test finds a disagreement ({odds}), but more is left than noise brings."
    odds_alone = f" ({odds})" if odds else ""
    if percent is None:
        return f"Model and measurement disagree{odds_alone}."
    if percent < 100 * tolerance:
        return f"Model and measurement disagree, though hardly in the mean image{odds_alone}."
    more = f", {odds}" if odds else ""
    return f"Model and measurement disagree by {percent_text(percent / 100)} of the spot's peak (rms{more})."


def _agreed(document: dict[str, Any]) -> str:
    p = document["detection"]["p_value"]
    odds = f" ({probability_text(p)})" if p is not None else ""
    who = "Otherwise model" if _contradicted(document) else "Model"
    return f"{who} and measurement agree: they differ by no more than noise does{odds}."


def _of_all(document: dict[str, Any]) -> str:
    """What keeps every effect alike from being assessed, or parts of the dataset from any use."""
    return list_text([own["why"] for own in document["not_assessed"] if own["effect"] == "all"], "; ")


def _beware(document: dict[str, Any]) -> str:
    """What the dataset holds that the verdict does not rest on."""
    return f"Beware: {_of_all(document)}." if _of_all(document) else ""


def _untested(document: dict[str, Any]) -> str:
    return f"Nothing could be tested: {_of_all(document) or 'no test was possible'}."


# Second line: what it is


def _effects(document: dict[str, Any]) -> str:
    """Every effect: the first in whole sentences, further ones by name and strength, and those that have rivals."""
    alone = [own for own in document["effects"] if len(own["candidates"]) == 1]
    tied = [own for own in document["effects"] if len(own["candidates"]) > 1]
    told = []
    if alone:
        told.append("; besides, ".join(effect_text(own, document) for own in alone[:IN_FULL]))
    if alone[IN_FULL:]:
        told.append(f"also found: {list_text([_short(own) for own in alone[IN_FULL:]])}")
    told += [either_text(own, document) for own in tied]
    return " ".join(f"{text[0].upper()}{text[1:]}." for text in told)


def effect_text(own: dict[str, Any], document: dict[str, Any]) -> str:
    """What an effect does, with its name and values."""
    light = document["light"] if own["name"] == LIGHT else None
    return _light(light) if light else f"{_does(own['name'])} ({_with_values(own)})"


def either_text(own: dict[str, Any], document: dict[str, Any]) -> str:
    """An effect and those that may stand in its place."""
    others = [f"{_does(name)} ({name})" for name in own["candidates"][1:]]
    times = own["evidence"]["weight"] / max(rival["weight"] for rival in own["evidence"]["rivals"])
    shown = f"{times:.2g}" if times < 99.5 else f"{times:.0f}"
    likelier = f"; the first is {shown} times as likely" if times >= LIKELIER else ""
    either = f"either {effect_text(own, document)}, or {list_text(others, ', or ')}"
    return f"{either}: these frames cannot tell which{likelier}"


def _light(light: dict[str, Any]) -> str:
    """The learned shape, in its own words where it has some."""
    error = None if light["stderr"] is None else 100 * light["stderr"]
    words = light["words"] or f"{value_text(100 * light['power'], error, '%')} of its power lies elsewhere"
    return f"the light is not a Gaussian: {words}"


def _does(name: str) -> str:
    """What an effect does, in the words of the vocabulary."""
    known = vocabulary().get(name)
    return known.sentence if known else "the light is not a Gaussian" if name == LIGHT else name


def _with_values(own: dict[str, Any]) -> str:
    values = [f"{key} {value_text(p['value'], p['stderr'], p['unit'])}" for key, p in own["parameters"].items()]
    return ", ".join([own["name"], *values])


def _short(own: dict[str, Any]) -> str:
    """An effect by name and strength."""
    key, strength = next(iter(own["parameters"].items()))
    return f"{own['name']} ({key} {value_text(strength['value'], strength['stderr'], strength['unit'])})"


def _unknown(document: dict[str, Any]) -> str:
    """That nothing is named."""
    failed, small = ([own["effect"] for own in document["limits"] if own["why"] == why] for why in
                     (NOT_FORETOLD, TOO_SMALL))  # fmt: skip
    if small:
        return f"It would be explained by {list_text(small, ' or ')}, {TOO_SMALL}."
    what = (
        f"{list_text(failed)} seemed to explain it, but not on unseen frames"
        if failed
        else ("No effect of the vocabulary explains it")
    )
    law = any(own["before"] is not None for own in document["baseline_shift"].values())
    return f"{what}: something else is at work{', and p1 and p2 may be off' if law else ''}."


def _shown(document: dict[str, Any]) -> str:
    """Where the frames are oddest, and what is left."""
    where = f"It shows most in {document['where'][0]['words']}." if document["where"] else ""
    left = _left(document)
    return _joined(where, f"{left[0].upper()}{left[1:]} is unexplained." if left else "")


# Third line: how sure, and how much of the gap is closed


def _closed(document: dict[str, Any]) -> str:
    """The part of the gap that closes on frames that had no part in it, what is left, and that nothing does better."""
    gap, effects, tied = document["gap"], document["effects"], document["status"] == "ambiguous"
    one, floor = len(effects) == 1, gap["noise_floor"]
    only_light = one and effects[0]["name"] == LIGHT
    light = next((own["gap_closed"] for own in effects if own["name"] == LIGHT), None)
    if gap["before"] is None:
        text = "It was not tried on unseen frames" if one else "They were not tried on unseen frames"
    elif gap["closed"] is None or (floor is not None and gap["before"] < floor * (1 + NO_GAP)):
        text = f"{'It shows' if one else 'They show'} in the noise or the scatter, not in the mean images"
    elif gap["closed"] <= 0:
        text = f"On {gap['on']} no gap closes"
    else:
        who = "The first closes" if tied and one else "Added to the model, it closes" if one else "Together they close"
        who = "A learned shape closes" if only_light else who
        text = f"{who} {percent_text(min(gap['closed'], 1.0))} of the gap on {gap['on']}"
        text += f" (the light's shape alone {percent_text(light)})" if light is not None and not one else ""
        left = _left(document)
        if left:
            text += f" and leave{'s' if one else ''} {left}{' unexplained' if _remains(document) else ''}"
    if tied:
        return f"{text}."
    return f"{text}; {'nothing else was found' if only_light else 'no other effect does as well'}."


def _remains(document: dict[str, Any]) -> bool:
    """Whether more is left than the tolerance; `document.more_remains` by the numbers that stand in the document."""
    left = document["unexplained"]
    return left["size"] is not None and left["size"] ** 2 - _doubt(left) > left["tolerance"] ** 2


def _doubt(left: dict[str, Any]) -> float:
    return criteria.STATED.value * ((left["size"] + left["error"]) ** 2 - left["size"] ** 2)


def _left(document: dict[str, Any]) -> str:
    """How much of the peak is left in the mean image, or may be; "" where that is not known."""
    left = document["unexplained"]
    if left["size"] is None:
        return ""
    if _remains(document):
        return f"{percent_text(left['size'])} of the peak"
    most = max(float(np.sqrt(left["size"] ** 2 + _doubt(left))), left["tolerance"])
    return f"less than {percent_text(most)} of the peak"


def _advised(document: dict[str, Any]) -> str:
    """Measurements that would tell rivals apart."""
    pairs = sum(len(own["candidates"]) - 1 for own in document["effects"])
    if not pairs:
        return ""
    told = []
    for own in document["advice"]:
        which = "which" if pairs == 1 else f"{own['separates'][0]} from {own['separates'][1]}"
        frames = "1 frame" if own["frames"] == 1 else f"{own['frames']} frames"
        told.append(f"{frames} at {condition_text(own['condition'])} would tell {which}")
    return f"{list_text(told, '; ')}." if told else "No next measurement was found that would tell."


def _moved(document: dict[str, Any]) -> str:
    """p1 and p2 where certain effects moved them."""
    moved: list[str] = []
    for name, own in document["baseline_shift"].items():
        before, after, error = own["before"], own["after"], own["stderr"]
        if before is None or after is None or not error or abs(after - before) <= criteria.STATED.value * error:
            continue
        first = f"{before:.{max(digits_of(error), 0)}f}".replace("-", "−")
        moved.append(f"{name}{'' if moved else ' goes'} from {first} to {value_text(after, error, own['unit'])}")
    whom = "it" if len(document["effects"]) == 1 else "them"
    return f"With {whom} {', '.join(moved)}." if moved and document["status"] != "ambiguous" else ""


def _gain(document: dict[str, Any]) -> str:
    """Of levels of flats: K, with what was found or by a straight line, and how the light scatters."""
    levels = document.get("levels")
    if not levels:
        return ""
    own, line = (f"K = {value_text(levels[key]['value'], levels[key]['stderr'], 'DN/e-')}" for key in
                 ("gain_dn_per_e", "straight_line"))  # fmt: skip
    beside = f"a straight line through variance and mean up to 70 % of saturation gives {line}"
    text = f"{own}, by {levels['number']} levels."
    if document["status"] == "unknown":
        text = f"{beside[0].upper()}{beside[1:]}."
    elif document["effects"]:
        text = f"With {'it' if len(document['effects']) == 1 else 'them'} {own}; {beside}."
    scatter = levels["light_scatter"]
    more = f"The light scatters by {percent_text(scatter)} from level to level." if scatter > SCATTERS else ""
    return _joined(text, more)


# Where nothing is added


def _as_fitted(document: dict[str, Any]) -> str:
    values = [
        f"{name} = {value_text(own['before'], own['stderr'], own['unit'])}"
        for name, own in document["baseline_shift"].items()
        if own["before"] is not None
    ]
    return f"As fitted, {list_text(values)}." if values else ""


def _not_proven(document: dict[str, Any]) -> str:
    known = any(own["words"] for own in document["limits"])
    return (
        "That does not prove the model: how large each effect could still be, `spotcheck limits` tells."
        if known
        else ""
    )


def _joined(*parts: str) -> str:
    return " ".join(part for part in parts if part)
