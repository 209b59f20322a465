"""The summary of a verdict in at most three lines: whether there is a disagreement, what it is, what remains.

A `document` is the content of verdict.json (see `verdict.compose_verdict`). The gap is the mean squared residual on
held-out data, relative to noise. Rivals of an effect explain the data about as well. p1 and p2 are the parameters of
the law of the spot's width in exposure. Functions return one or more sentences, or "" if there is nothing to say.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spotcheck.characterization.sensor_choice import SOURCES
from spotcheck.discrepancy.criteria import CLEAR_ERRORS
from spotcheck.discrepancy.limits import NOT_CONFIRMED, TOO_SMALL
from spotcheck.discrepancy.verdict import LEARNED_SHAPE, NO_TEST, NOT_CONVERGED, Status
from spotcheck.discrepancy.words import condition_text, list_text, percent_text, probability_text
from spotcheck.io.number_text import quantity_text, rounded_text
from spotcheck.model.effects import vocabulary

# Names of numbers of the data sheet in a sentence.
SHEET_WORDS = {"gain_dn_per_e": "the gain", "read_noise_e": "the read noise", "black_level_dn": "the black level"}
# Number of effects that are described in whole sentences; further ones are listed by name and strength.
IN_FULL = 2
# Ratio of probabilities above which an effect is called likelier than its rivals, and from which on it is "over 100".
LIKELIER, LARGEST_RATIO = 1.5, 99.5
# Scatter of the light of flats from level to level above which it is reported [part of the light].
LAMP_SCATTER = 0.002
REPAIR = (
    "Exclude damaged frames (no in column keep of manifest.csv), and check gain, read noise and black level in"
    " instrument.yaml; then run the verdict again."
)


@dataclass(frozen=True)
class Wording:
    """Words for what is compared: spot frames, or levels of flats and darks."""

    sides: str  # model and data, as the subject of a sentence
    peak: str  # the light that sizes are parts of, at its first mention
    short_peak: str  # the same at further mentions
    image: str  # the mean of the data
    data: str  # the data


SPOTS = Wording(sides="Model and measurement", peak="the spot's peak", short_peak="the peak", image="the mean images",
                data="these frames")  # fmt: skip
LEVELS = Wording(sides="The linear sensor model and the flats", peak="the highest signal",
                 short_peak="the highest signal", image="the mean levels", data="these levels")  # fmt: skip


def summarize_verdict(document: Mapping[str, Any]) -> str:
    """Return the summary of a verdict: at most three lines, separated by line breaks.

    Parameters
    ----------
    document : mapping
        Content of verdict.json; its key `sentence` is not read.
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
        closing = _join(_locate_residual(document), _as_sentence(_say_remainder(document)), _describe_gain(document))
        lines = [opening, _describe_unknown(document), closing]
    else:
        sentences = (_describe_gap(document), _describe_advice(document), _describe_shift(document))
        lines = [opening, _describe_effects(document), _join(*sentences, _describe_gain(document))]
    return "\n".join(filter(None, lines))


def _wording_of(document: Mapping[str, Any]) -> Wording:
    """Return the words for the data of a verdict."""
    return LEVELS if "levels" in document else SPOTS


# First line: whether there is a disagreement


def _describe_contradiction(document: Mapping[str, Any]) -> str:
    """Return a sentence on each source whose numbers the frames contradict: data sheet, or flats and darks."""
    return _join(*(_describe_contradicted(document, source) for source in SOURCES))


def _describe_contradicted(document: Mapping[str, Any], source: str) -> str:
    """Return a sentence on the numbers of one source that the frames contradict."""
    texts = [
        f"{SHEET_WORDS.get(row['name'], row['name'])} is {quantity_text(row['found'], row['stderr'], row['unit'])}, not"
        f" {quantity_text(row['stated'], row['stated_stderr'], row['unit'])}"
        for row in document["sheet"]
        if row["contradicts"] and row["source"] == source
    ]
    return f"The frames contradict the {source}: {list_text(texts, '; ')}." if texts else ""


def _describe_disagreement(document: Mapping[str, Any]) -> str:
    """Return whether model and data disagree, and by how much; "" if that was not tested."""
    status, detection, wording = Status(document["status"]), document["detection"], _wording_of(document)
    p, percent = detection["p_value"], detection["rms_residual_percent_of_peak"]
    p_text = probability_text(p) if p is not None else ""
    p_in_brackets = f" ({p_text})" if p_text else ""
    if status is Status.NOT_CONVERGED and p is None:
        return ""
    is_significant = p is None or p < detection["alpha"]
    if status is Status.CONSISTENT or (status is Status.NOT_CONVERGED and not is_significant):
        follows_contradiction = bool(_describe_contradiction(document))
        lower_sides = f"{wording.sides[0].lower()}{wording.sides[1:]}"
        sides = f"Otherwise, {lower_sides}" if follows_contradiction else wording.sides
        return f"{sides} agree within the noise{p_in_brackets}."
    if not is_significant:
        return f"The overall test finds no disagreement{p_in_brackets}, but {describe_exception(document)}."
    if percent is None:
        return f"{wording.sides} disagree{p_in_brackets}."
    if percent < 100 * document["unexplained"]["tolerance"]:
        return f"{wording.sides} disagree, but hardly in {wording.image}{p_in_brackets}."
    p_behind_comma = f", {p_text}" if p_text else ""
    return f"{wording.sides} disagree by {percent_text(percent / 100)} of {wording.peak} (rms{p_behind_comma})."


def describe_exception(document: Mapping[str, Any]) -> str:
    """Return what disagrees with the model though the overall test does not, as a clause."""
    if document["effects"]:
        return "tests of single effects do"
    row = document["unexplained"]
    if row["size"] is not None and _find_least_square(row) > row["tolerance"] ** 2:
        return "the residual exceeds the tolerance"
    return f"{document['gap']['on'] or 'held-out repeats'} are far from the model"


def _find_least_square(row: Mapping[str, Any]) -> float:
    """Return the lower bound of the square of the unexplained residual [peak²]; `row` is the key `unexplained`.

    The error is estimated for the square of the size: (size + error)² − size² is one standard error of it.
    """
    return row["size"] ** 2 - CLEAR_ERRORS * ((row["size"] + (row["error"] or 0.0)) ** 2 - row["size"] ** 2)


def _reasons(document: Mapping[str, Any]) -> list[str]:
    """Return the texts of `not_assessed` that concern all effects.

    The first is the reason of a verdict that has one (not assessed, not converged); the others are remarks on the data.
    """
    return [row["why"] for row in document["not_assessed"] if row["effect"] == "all"]


def _list_notes(document: Mapping[str, Any]) -> str:
    """Return the remarks on the data in one sentence."""
    # The reason of a verdict that did not converge has a sentence of its own.
    notes = _reasons(document)[1 if Status(document["status"]) is Status.NOT_CONVERGED else 0 :]
    return f"Note: {list_text(notes, '; ')}." if notes else ""


# Second line: what it is


def _describe_effects(document: Mapping[str, Any]) -> str:
    """Return a sentence for each of the first effects without rivals, a list of the others, and those with rivals."""
    unrivalled = [effect for effect in document["effects"] if len(effect["candidates"]) == 1]
    rivalled = [effect for effect in document["effects"] if len(effect["candidates"]) > 1]
    texts = [effect_text(effect, document) for effect in unrivalled[:IN_FULL]]
    if unrivalled[IN_FULL:]:
        texts.append(f"Further effects: {list_text([_name_effect(effect) for effect in unrivalled[IN_FULL:]])}")
    texts += [either_text(effect, document) for effect in rivalled]
    return _join(*map(_as_sentence, texts))


def effect_text(effect: Mapping[str, Any], document: Mapping[str, Any]) -> str:
    """Return what an effect does, with its name and values, as a sentence without a capital letter and a full stop.

    Parameters
    ----------
    effect : mapping
        A row of the key `effects`.
    document : mapping
        Content of verdict.json.
    """
    if effect["name"] == LEARNED_SHAPE.name and document["light"]:
        return _describe_light(document["light"])
    return f"{_say_what_it_does(effect['name'])} ({', '.join([effect['name'], *_list_values(effect)])})"


def either_text(effect: Mapping[str, Any], document: Mapping[str, Any]) -> str:
    """Return an effect with rivals, and these, in the form and with the parameters of `effect_text`."""
    rivals = [f"{_say_what_it_does(name)} ({name})" for name in effect["candidates"][1:]]
    ratio = effect["evidence"]["weight"] / max([rival["weight"] for rival in effect["evidence"]["rivals"]] or [np.inf])
    ratio_text = f"{ratio:.2g}" if ratio < LARGEST_RATIO else "over 100"
    likelier = f"; the first is {ratio_text} times as likely" if ratio >= LIKELIER else ""
    either = f"either {effect_text(effect, document)}, or {list_text(rivals, ', or ')}"
    return f"{either}: {_wording_of(document).data} cannot separate them{likelier}"


def _describe_light(light: Mapping[str, Any]) -> str:
    """Return how the learned light shape differs from the declared one; `light` is the key of that name."""
    error = None if light["stderr"] is None else 100 * light["stderr"]
    words = light["words"] or f"{quantity_text(100 * light['power'], error, '%')} of its power lies elsewhere"
    return f"the light does not have the declared shape: {words}"


def _say_what_it_does(name: str) -> str:
    """Return the sentence of an effect in the vocabulary; its name if the vocabulary does not contain it."""
    effect = LEARNED_SHAPE if name == LEARNED_SHAPE.name else vocabulary().get(name)
    return effect.sentence if effect else name


def _list_values(effect: Mapping[str, Any]) -> list[str]:
    """Return names and values of the parameters of an effect, without those that have no value."""
    return [
        f"{name} {quantity_text(value['value'], value['stderr'], value['unit'])}"
        for name, value in effect["parameters"].items()
        if value["value"] is not None
    ]


def _name_effect(effect: Mapping[str, Any]) -> str:
    """Return the name of an effect with its strength in brackets."""
    values = _list_values(effect)[:1]
    return f"{effect['name']} ({values[0]})" if values else effect["name"]


def _describe_unknown(document: Mapping[str, Any]) -> str:
    """Return that no effect explains the disagreement, and which effects were rejected though they gain enough."""
    has_law = any(row["before"] is not None for row in document["baseline_shift"].values())
    text = f"No effect of the vocabulary explains it{'; p1 and p2 may be biased' if has_law else ''}."
    refuted, small = ([row["effect"] for row in document["limits"] if row["why"] == why] for why in
                      (NOT_CONFIRMED, TOO_SMALL))  # fmt: skip
    fits = "fits" if len(refuted) == 1 else "fit"
    on_refuted = f"{list_text(refuted)} {fits} the searched frames, but not the held-out ones."
    on_small = f"{list_text(small)} {'is' if len(small) == 1 else 'are'} significant, but too small to matter."
    return _join(text, on_refuted if refuted else "", on_small if small else "")


# Third line: what the effects explain and what remains


def _describe_gap(document: Mapping[str, Any]) -> str:
    """Return which part of the gap the effects close on held-out data, and what of the mean image remains."""
    effects, gap = document["effects"], document["gap"]
    is_single, has_rivals = len(effects) == 1, Status(document["status"]) is Status.AMBIGUOUS
    shape = next((effect for effect in effects if effect["name"] == LEARNED_SHAPE.name), None)
    subject, s = ("This effect", "s") if is_single else ("These effects", "")
    if has_rivals and is_single:
        subject = "The first"
    if shape and is_single:
        subject = "The learned shape"
    if gap["before"] is None:
        text = f"{subject} {'was' if is_single else 'were'} not tested on held-out frames."
    elif gap["closed"] is None:
        text = f"The declared model has no significant gap on {gap['on']} that {subject.lower()} could close."
    elif gap["closed"] <= 0:
        text = f"{subject} close{s} none of the gap on {gap['on']}."
    else:
        share = f"{percent_text(min(gap['closed'], 1.0))} of the gap on {gap['on']}"
        by_shape = "" if is_single or not shape or shape["gap_closed"] is None else percent_text(shape["gap_closed"])
        text = f"{subject} close{s} {share}{f' (the shape of the light alone {by_shape})' if by_shape else ''}"
        text += f"; {remainder}." if (remainder := _say_remainder(document)) else "."
    if has_rivals:
        return text
    return f"{text} No other effect {'is significant' if shape and is_single else 'does as well'}."


def _say_remainder(document: Mapping[str, Any]) -> str:
    """Return how much of the mean image remains unexplained, without a capital letter and a full stop.

    The size is given if it exceeds the tolerance significantly, else an upper bound, at least the tolerance.
    """
    row, peak = document["unexplained"], _wording_of(document).short_peak
    if row["size"] is None:
        return ""
    least_square = _find_least_square(row)
    if least_square > row["tolerance"] ** 2:
        return f"{percent_text(row['size'])} of {peak} remains unexplained"
    # The upper bound of the square is as far above it as the lower one is below.
    bound = max(float(np.sqrt(2 * row["size"] ** 2 - least_square)), row["tolerance"])
    return f"less than {percent_text(bound)} of {peak} remains"


def _locate_residual(document: Mapping[str, Any]) -> str:
    """Return where the most significant residual lies."""
    return f"The most significant residual is in {document['where'][0]['words']}." if document["where"] else ""


def _describe_advice(document: Mapping[str, Any]) -> str:
    """Return the measurements that would separate effects from their rivals; "" without rivals."""
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
    """Return how p1 and p2 change from the declared to the extended model.

    Changes up to `CLEAR_ERRORS` standard errors are left out, and all changes while effects have rivals.
    """
    texts: list[str] = []
    for name, row in document["baseline_shift"].items():
        before, after, error = row["before"], row["after"], row["stderr"]
        if before is None or after is None or not error or abs(after - before) <= CLEAR_ERRORS * error:
            continue
        verb, end = "" if texts else " changes", quantity_text(after, error, row["unit"])
        texts.append(f"{name}{verb} from {rounded_text(before, error)} to {end}")
    has_rivals = Status(document["status"]) is Status.AMBIGUOUS
    return f"The fitted {list_text(texts)}." if texts and not has_rivals else ""


def _describe_gain(document: Mapping[str, Any]) -> str:
    """Return the gain K [DN/e-] from levels of flats, and the scatter of their light; "" for spot frames."""
    levels = document.get("levels")
    if not levels:
        return ""
    fitted, line = (quantity_text(levels[key]["value"], levels[key]["stderr"], "DN/e-") for key in
                    ("gain_dn_per_e", "straight_line"))  # fmt: skip
    if document["effects"]:
        effects = "this effect" if len(document["effects"]) == 1 else "these effects"
        text = f"The gain K is {fitted} with {effects}; a straight line up to 70 % of saturation gives {line}."
    elif Status(document["status"]) is Status.UNKNOWN:
        text = f"A straight line up to 70 % of saturation gives the gain K = {line}."
    else:
        text = f"The gain K is {fitted}, from {levels['number']} levels."
    scatter = levels["light_scatter"]
    on_light = f"The light scatters by {percent_text(scatter)} from level to level." if scatter > LAMP_SCATTER else ""
    return _join(text, on_light)


# Without effects


def _describe_law(document: Mapping[str, Any]) -> str:
    """Return the values of p1 and p2 under the declared model."""
    values = [
        f"{name} = {quantity_text(row['before'], row['stderr'], row['unit'])}"
        for name, row in document["baseline_shift"].items()
        if row["before"] is not None
    ]
    return f"The fit gives {list_text(values)}." if values else ""


def _point_to_limits(document: Mapping[str, Any]) -> str:
    """Return which command lists the upper limits on effects; "" if there are none."""
    has_limits = any(row["words"] for row in document["limits"])
    text = "This does not prove the model: `spotcheck limits` lists how large each effect could still be."
    return text if has_limits else ""


def _as_sentence(text: str) -> str:
    """Return a text with a capital letter and a full stop; "" if it is empty."""
    return f"{text[0].upper()}{text[1:]}." if text else ""


def _join(*parts: str) -> str:
    """Return sentences in one line, without empty ones."""
    return " ".join(filter(None, parts))
