"""The summary of a verdict in at most three lines: whether there is a disagreement, what it is, what remains."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spotcheck.discrepancy.criteria import CLEAR_ERRORS
from spotcheck.discrepancy.limits import NOT_CONFIRMED, TOO_SMALL
from spotcheck.discrepancy.verdict import LEARNED_SHAPE, NO_TEST, NOT_CONVERGED, Status
from spotcheck.discrepancy.words import condition_text, list_text, percent_text, probability_text
from spotcheck.io.number_text import quantity_text, rounded_text
from spotcheck.model.effects import vocabulary

SHEET_WORDS = {"gain_dn_per_e": "the gain", "read_noise_e": "the read noise", "black_level_dn": "the black level"}
# Effects that are described in whole sentences; further ones by name and strength.
IN_FULL = 2
# A candidate is called likelier than its rivals from this ratio of probabilities on.
LIKELIER = 1.5
# Scatter of a lamp from level to level that is worth a sentence [part of its light].
LAMP_SCATTER = 0.002
REPAIR = (
    "Exclude damaged frames (no in column keep of manifest.csv), and check gain, read noise and black level in"
    " instrument.yaml; then run the verdict again."
)


@dataclass(frozen=True)
class Wording:
    """Words for what is compared."""

    sides: str  # model and data, as the subject of a sentence
    peak: str  # what sizes are parts of, when it is first mentioned
    short_peak: str  # the same later
    image: str  # the mean of the data
    data: str  # the data


SPOTS = Wording("Model and measurement", "the spot's peak", "the peak", "the mean images", "these frames")
LEVELS = Wording(
    sides="The linear sensor model and the flats",
    peak="the highest signal",
    short_peak="the highest signal",
    image="the mean levels",
    data="these levels",
)


def summarize_verdict(document: Mapping[str, Any]) -> str:
    """Return the summary of a verdict: at most three lines, separated by line breaks.

    Parameters
    ----------
    document : mapping
        As `compose_verdict` returns it; its own `sentence` is not read.
    """
    status = Status(document["status"])
    opening = _join(_describe_contradiction(document), _describe_disagreement(document), _list_notes(document))
    if status is Status.NOT_ASSESSED:
        lines = [f"Nothing could be tested: {list_text(_reasons(document), '; ') or NO_TEST}."]
    elif status is Status.NOT_CONVERGED:
        reason = next(iter(_reasons(document)), NOT_CONVERGED)
        lines = [opening, f"No effect is named: {reason}.", REPAIR]
    elif status is Status.CONSISTENT:
        lines = [opening, _join(_describe_law(document), _describe_gain(document)), _point_to_limits(document)]
    elif status is Status.UNKNOWN:
        rest = _join(_locate_residual(document), _describe_rest(document), _describe_gain(document))
        lines = [opening, _describe_unknown(document), rest]
    else:
        last = _join(_describe_gap(document), _describe_advice(document), _describe_shift(document))
        lines = [opening, _describe_effects(document), _join(last, _describe_gain(document))]
    return "\n".join(filter(None, lines))


def _wording_of(document: Mapping[str, Any]) -> Wording:
    """Return the words for the data of a verdict."""
    return LEVELS if "levels" in document else SPOTS


# First line: whether there is a disagreement


def _describe_contradiction(document: Mapping[str, Any]) -> str:
    """Return which numbers of the data sheet the frames contradict."""
    texts = [
        f"{SHEET_WORDS.get(row['name'], row['name'])} is {quantity_text(row['found'], row['stderr'], row['unit'])}, not"
        f" {quantity_text(row['stated'], row['stated_stderr'], row['unit'])}"
        for row in document["sheet"]
        if row["contradicts"]
    ]
    return f"The frames contradict the data sheet: {list_text(texts, '; ')}." if texts else ""


def _describe_disagreement(document: Mapping[str, Any]) -> str:
    """Return whether model and data disagree, and by how much; "" if that was not tested."""
    status, detection, wording = Status(document["status"]), document["detection"], _wording_of(document)
    p, percent = detection["p_value"], detection["rms_residual_percent_of_peak"]
    chance = probability_text(p) if p is not None else ""
    in_brackets = f" ({chance})" if chance else ""
    if status is Status.NOT_CONVERGED and p is None:
        return ""
    is_significant = p is None or p < detection["alpha"]
    if status is Status.CONSISTENT or (status is Status.NOT_CONVERGED and not is_significant):
        otherwise = bool(_describe_contradiction(document))
        sides = f"Otherwise, {wording.sides[0].lower()}{wording.sides[1:]}" if otherwise else wording.sides
        return f"{sides} agree within the noise{in_brackets}."
    if not is_significant:
        but = "tests of single effects do" if document["effects"] else "the residual exceeds the tolerance"
        return f"The overall test finds no disagreement{in_brackets}, but {but}."
    if percent is None:
        return f"{wording.sides} disagree{in_brackets}."
    if percent < 100 * document["unexplained"]["tolerance"]:
        return f"{wording.sides} disagree, but hardly in {wording.image}{in_brackets}."
    more = f", {chance}" if chance else ""
    return f"{wording.sides} disagree by {percent_text(percent / 100)} of {wording.peak} (rms{more})."


def _reasons(document: Mapping[str, Any]) -> list[str]:
    """Return what concerns all effects: first the reason of a verdict without effects, then remarks on the data."""
    return [row["why"] for row in document["not_assessed"] if row["effect"] == "all"]


def _list_notes(document: Mapping[str, Any]) -> str:
    """Return the remarks on the data."""
    notes = _reasons(document)[1 if Status(document["status"]) is Status.NOT_CONVERGED else 0 :]
    return f"Note: {list_text(notes, '; ')}." if notes else ""


# Second line: what it is


def _describe_effects(document: Mapping[str, Any]) -> str:
    """Return a sentence for each of the first effects, a list of the others, and those with rivals."""
    alone = [effect for effect in document["effects"] if len(effect["candidates"]) == 1]
    tied = [effect for effect in document["effects"] if len(effect["candidates"]) > 1]
    texts = [effect_text(effect, document) for effect in alone[:IN_FULL]]
    if alone[IN_FULL:]:
        texts.append(f"Further effects: {list_text([_name_effect(effect) for effect in alone[IN_FULL:]])}")
    texts += [either_text(effect, document) for effect in tied]
    return " ".join(f"{text[0].upper()}{text[1:]}." for text in texts)


def effect_text(effect: Mapping[str, Any], document: Mapping[str, Any]) -> str:
    """Return what an effect does, with its name and values, without a capital letter and a full stop."""
    if effect["name"] == LEARNED_SHAPE.name and document["light"]:
        return _describe_light(document["light"])
    return f"{_say_what_it_does(effect['name'])} ({', '.join([effect['name'], *_list_values(effect)])})"


def either_text(effect: Mapping[str, Any], document: Mapping[str, Any]) -> str:
    """Return an effect and its rivals, in the form of `effect_text`."""
    rivals = [f"{_say_what_it_does(name)} ({name})" for name in effect["candidates"][1:]]
    ratio = effect["evidence"]["weight"] / max([rival["weight"] for rival in effect["evidence"]["rivals"]] or [np.inf])
    shown = f"{ratio:.2g}" if ratio < 99.5 else "over 100"
    likelier = f"; the first is {shown} times as likely" if ratio >= LIKELIER else ""
    either = f"either {effect_text(effect, document)}, or {list_text(rivals, ', or ')}"
    return f"{either}: {_wording_of(document).data} cannot separate them{likelier}"


def _describe_light(light: Mapping[str, Any]) -> str:
    """Return what the learned shape is."""
    error = None if light["stderr"] is None else 100 * light["stderr"]
    words = light["words"] or f"{quantity_text(100 * light['power'], error, '%')} of its power lies elsewhere"
    return f"the light does not have the declared shape: {words}"


def _say_what_it_does(name: str) -> str:
    """Return the sentence of an effect; its name if the vocabulary does not know it."""
    effect = LEARNED_SHAPE if name == LEARNED_SHAPE.name else vocabulary().get(name)
    return effect.sentence if effect else name


def _list_values(effect: Mapping[str, Any]) -> list[str]:
    """Return the parameters of an effect that have a value."""
    return [
        f"{name} {quantity_text(value['value'], value['stderr'], value['unit'])}"
        for name, value in effect["parameters"].items()
        if value["value"] is not None
    ]


def _name_effect(effect: Mapping[str, Any]) -> str:
    """Return an effect by name and strength."""
    values = _list_values(effect)[:1]
    return f"{effect['name']} ({values[0]})" if values else effect["name"]


def _describe_unknown(document: Mapping[str, Any]) -> str:
    """Return that no effect explains a disagreement."""
    has_law = any(row["before"] is not None for row in document["baseline_shift"].values())
    text = f"No effect of the vocabulary explains it{'; p1 and p2 may be biased' if has_law else ''}."
    refuted, small = ([row["effect"] for row in document["limits"] if row["why"] == why] for why in
                      (NOT_CONFIRMED, TOO_SMALL))  # fmt: skip
    more = f"{list_text(refuted)} fit{'s' if len(refuted) == 1 else ''} the searched frames, but not the held-out ones."
    less = f"{list_text(small)} {'is' if len(small) == 1 else 'are'} significant, but too small to matter."
    return _join(text, more if refuted else "", less if small else "")


# Third line: what the effects explain and what remains


def _describe_gap(document: Mapping[str, Any]) -> str:
    """Return which part of the gap the effects close on held-out frames, and what remains."""
    effects, gap = document["effects"], document["gap"]
    is_one, is_tied = len(effects) == 1, Status(document["status"]) is Status.AMBIGUOUS
    shape = next((effect for effect in effects if effect["name"] == LEARNED_SHAPE.name), None)
    subject, s = ("This effect", "s") if is_one else ("These effects", "")
    if is_tied and is_one:
        subject = "The first"
    if shape and is_one:
        subject = "The learned shape"
    if gap["before"] is None:
        text = f"{subject} {'was' if is_one else 'were'} not tested on held-out frames."
    elif gap["closed"] is None:
        text = f"The declared model has no significant gap on {gap['on']} that {subject.lower()} could close."
    elif gap["closed"] <= 0:
        text = f"{subject} close{s} none of the gap on {gap['on']}."
    else:
        share = f"{percent_text(min(gap['closed'], 1.0))} of the gap on {gap['on']}"
        of_shape = "" if is_one or not shape or shape["gap_closed"] is None else percent_text(shape["gap_closed"])
        text = f"{subject} close{s} {share}{f' (the shape of the light alone {of_shape})' if of_shape else ''}"
        text += f"; {rest}." if (rest := _say_rest(document)) else "."
    if is_tied:
        return text
    return f"{text} No other effect {'is significant' if shape and is_one else 'does as well'}."


def _describe_rest(document: Mapping[str, Any]) -> str:
    """Return what remains, as a sentence."""
    rest = _say_rest(document)
    return f"{rest[0].upper()}{rest[1:]}." if rest else ""


def _say_rest(document: Mapping[str, Any]) -> str:
    """Return how much of the mean image remains unexplained, or at most; "" if that is not known."""
    row, peak = document["unexplained"], _wording_of(document).short_peak
    if row["size"] is None:
        return ""
    allowance = CLEAR_ERRORS * ((row["size"] + (row["error"] or 0.0)) ** 2 - row["size"] ** 2)
    if row["size"] ** 2 - allowance > row["tolerance"] ** 2:
        return f"{percent_text(row['size'])} of {peak} remains unexplained"
    most = max(float(np.sqrt(row["size"] ** 2 + allowance)), row["tolerance"])
    return f"less than {percent_text(most)} of {peak} remains"


def _locate_residual(document: Mapping[str, Any]) -> str:
    """Return where the residual is largest."""
    return f"The most significant residual is in {document['where'][0]['words']}." if document["where"] else ""


def _describe_advice(document: Mapping[str, Any]) -> str:
    """Return the measurements that would separate rivals."""
    pairs = sum(len(effect["candidates"]) - 1 for effect in document["effects"])
    if not pairs:
        return ""
    texts = []
    for advice in document["advice"]:
        which = "them" if pairs == 1 else f"{advice['separates'][0]} from {advice['separates'][1]}"
        frames = "1 frame" if advice["frames"] == 1 else f"{advice['frames']} frames"
        texts.append(f"{frames} at {condition_text(advice['condition'])} would separate {which}")
    return f"{list_text(texts, '; ')}." if texts else "No measurement is known that would separate them."


def _describe_shift(document: Mapping[str, Any]) -> str:
    """Return the changes of p1 and p2 by more than `CLEAR_ERRORS` of their errors; none while effects have rivals."""
    texts: list[str] = []
    for name, row in document["baseline_shift"].items():
        before, after, error = row["before"], row["after"], row["stderr"]
        if before is None or after is None or not error or abs(after - before) <= CLEAR_ERRORS * error:
            continue
        first = rounded_text(before, error)
        texts.append(f"{name}{'' if texts else ' changes'} from {first} to {quantity_text(after, error, row['unit'])}")
    is_tied = Status(document["status"]) is Status.AMBIGUOUS
    return f"The fitted {list_text(texts)}." if texts and not is_tied else ""


def _describe_gain(document: Mapping[str, Any]) -> str:
    """Return the gain K from levels of flats, and the scatter of their light."""
    levels = document.get("levels")
    if not levels:
        return ""
    fitted, line = (quantity_text(levels[key]["value"], levels[key]["stderr"], "DN/e-") for key in
                    ("gain_dn_per_e", "straight_line"))  # fmt: skip
    if document["effects"]:
        which = "this effect" if len(document["effects"]) == 1 else "these effects"
        text = f"The gain K is {fitted} with {which}; a straight line up to 70 % of saturation gives {line}."
    elif Status(document["status"]) is Status.UNKNOWN:
        text = f"A straight line up to 70 % of saturation gives the gain K = {line}."
    else:
        text = f"The gain K is {fitted}, from {levels['number']} levels."
    scatter = levels["light_scatter"]
    more = f"The light scatters by {percent_text(scatter)} from level to level." if scatter > LAMP_SCATTER else ""
    return _join(text, more)


# Without effects


def _describe_law(document: Mapping[str, Any]) -> str:
    """Return the fitted p1 and p2."""
    values = [
        f"{name} = {quantity_text(row['before'], row['stderr'], row['unit'])}"
        for name, row in document["baseline_shift"].items()
        if row["before"] is not None
    ]
    return f"The fit gives {list_text(values)}." if values else ""


def _point_to_limits(document: Mapping[str, Any]) -> str:
    """Return where limits on the effects are found, if there are any."""
    has_limits = any(row["words"] for row in document["limits"])
    text = "This does not prove the model: `spotcheck limits` lists how large each effect could still be."
    return text if has_limits else ""


def _join(*parts: str) -> str:
    """Return sentences in one line."""
    return " ".join(filter(None, parts))
