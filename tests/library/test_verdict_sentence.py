"""What a person reads first: every kind of judgement in at most three lines of plain English, word by word."""

import re

import pytest

from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.verdict.document import document
from spotcheck.old_engine.verdict.sentence import sentence
from spotcheck.old_engine.verdict.words import condition_text, percent_text, probability_text, value_text
from tests.library.judgements import (
    BEND,
    CLIP,
    GHOST,
    JUDGEMENTS,
    MOVED,
    PEDESTAL,
    WORDS,
    closed,
    found,
    judged,
    learned,
    left,
    off,
    stated,
)

DISAGREE = "Model and measurement disagree by 5.5 % of the spot's peak (rms, p < 0.0001)."
HARDLY = "Model and measurement disagree, though hardly in the mean image (p < 0.0001)."
STOPS = "The signal stops at a level, below the converter's full scale (saturation, level 521 ± 5 DN)"
BENDS = "he sensor's response bends below saturation (nonlinearity, q 0.1120 ± 0.0011)"
LOBES = f"he light is not a Gaussian: {WORDS}"
LITTLE = "less than 0.2 % of the peak"
ON = "of the gap on unseen repeats and"
AS_WELL = "no other effect does as well."
SHARES = ("6.00 ± 0.20 %", "6 %")
AT_WORK = "something else is at work, and p1 and p2 may be off."
GHOSTLY = "Either a faint displaced copy of the spot lies beside it (ghost_reflection, fraction"

SENTENCES = {
    "agreed": [
        "Model and measurement agree: they differ by no more than noise does (p = 0.32).",
        "As fitted, p1 = 7.3931 ± 0.0034 px and p2 = 86.810 ± 0.029 px.",
        "That does not prove the model: how large each effect could still be, `spotcheck limits` tells.",
    ],
    "agreed, one frame": ["Model and measurement agree: they differ by no more than noise does (p = 0.32)."],
    "one": [
        DISAGREE,
        f"{STOPS}.",
        f"Added to the model, it closes 99.9 % {ON} leaves {LITTLE}; {AS_WELL}"
        " With it p1 goes from 2.304 to 0.003 ± 0.006 px, p2 from 33.1 to 8.8 ± 0.4 px.",
    ],
    "one, no frames apart": [
        DISAGREE,
        f"T{BENDS}.",
        "It was not tried on unseen frames; no other effect does as well.",
    ],
    "one of the scatter": [
        HARDLY,
        "Whole rows scatter together, anew in every frame (row_noise, rms 4.00 ± 0.04 DN).",
        "It shows in the noise or the scatter, not in the mean images; no other effect does as well.",
    ],
    "one, hardly seen": [
        "Taken as a whole, model and measurement look alike (p = 0.2), but not everywhere.",
        f"T{BENDS}.",
        f"Added to the model, it closes 80 % {ON} leaves {LITTLE}; {AS_WELL}",
    ],
    "two": [
        DISAGREE,
        f"T{BENDS}; besides, {PEDESTAL} (dark_offset, level 8.00 ± 0.08 DN).",
        f"Together they close 98 % of the gap on unseen repeats and leave {LITTLE}; no other effect does as well.",
    ],
    "four": [
        DISAGREE,
        f"{STOPS}; besides, t{BENDS}."
        " Also found: row_noise (rms 4.00 ± 0.04 DN) and speckle (contrast 0.2500 ± 0.0025).",
        f"Together they close 80 % {ON} leave 0.6 % of the peak unexplained; {AS_WELL}",
    ],
    "light": [
        DISAGREE,
        f"T{LOBES}.",
        f"A learned shape closes 97 % of the gap on unseen repeats and leaves {LITTLE}; nothing else was found.",
    ],
    "light and one": [
        DISAGREE,
        f"T{LOBES}; besides, t{BENDS}.",
        "Together they close 99 % of the gap on unseen repeats (the light's shape alone 97 %) and leave"
        f" {LITTLE}; no other effect does as well.",
    ],
    "one and light": [
        DISAGREE,
        f"{STOPS}; besides, t{LOBES}.",
        "Together they close 90 % of the gap on unseen repeats (the light's shape alone 10 %) and leave"
        f" 0.6 % of the peak unexplained; {AS_WELL}",
    ],
    "tied": [
        DISAGREE,
        f"{GHOSTLY} 0.0239 ± 0.0004, dx −29.20 ± 0.35 px, dy 4.10 ± 0.28 px), or a broad faint halo of scattered light"
        " surrounds the spot (scatter_halo): these frames cannot tell which; the first is 10 times as likely.",
        f"The first closes 98 % {ON} leaves {LITTLE}. 12 frames at an exposure of 1.8 ms and 22.5°"
        " would tell which.",
    ],
    "tied, three": [
        DISAGREE,
        f"{STOPS}. {GHOSTLY} 0.02390 ± 0.00024, dx −29.2 px, dy 4.1 px), or a broad faint halo of scattered light"
        " surrounds the spot (scatter_halo), or the spot's flanks are steeper (n > 1) or flatter (n < 1) than a"
        " Gaussian's (super_gaussian): these frames cannot tell which.",
        f"Together they close 90 % of the gap on unseen repeats and leave {LITTLE}. No next measurement was found that"
        " would tell.",
    ],
    "stranger": [
        "Model and measurement disagree by 2.1 % of the spot's peak (rms, p < 0.0001).",
        f"No effect of the vocabulary explains it: {AT_WORK}",
        "It shows most in row 96, column 120 at 0.4 ms. 1.9 % of the peak is unexplained.",
    ],
    "stranger, noise": [
        HARDLY,
        "No effect of the vocabulary explains it: something else is at work.",
        "It shows most in row 96, column 120 at 0.4 ms. Less than 0.2 % of the peak is unexplained.",
    ],
    "stranger, no test": [
        "No single test finds a disagreement (p = 0.32), but more is left than noise brings.",
        f"No effect of the vocabulary explains it: {AT_WORK}",
        "1 % of the peak is unexplained.",
    ],
    "not foretold": [
        DISAGREE,
        f"nonlinearity seemed to explain it, but not on unseen frames: {AT_WORK}",
        "It shows most in row 96, column 120 at 0.4 ms. 0.4 % of the peak is unexplained.",
    ],
    "sheet": [
        "The frames contradict the data sheet: the gain is 0.1321 ± 0.0010 DN/e−, where it states 0.1100 ± 0.0033"
        f" DN/e−. {DISAGREE}",
        f"{STOPS}.",
        f"Added to the model, it closes 98 % {ON} leaves {LITTLE}; {AS_WELL}",
    ],
    "sheet alone": [
        "The frames contradict the data sheet: the black level is 10.800 ± 0.020 DN, where it states 12.00 ± 0.30 DN."
        " Otherwise model and measurement agree: they differ by no more than noise does (p = 0.32).",
    ],
    "untested": ["Nothing could be tested: there is no usable spot frame."],
}  # fmt: skip


def said(judgement, **options) -> str:
    return sentence(document(judgement, "small", light_words=WORDS, **options))


@pytest.mark.parametrize("kind", JUDGEMENTS)
def test_what_is_said_word_by_word(kind):
    assert said(JUDGEMENTS[kind][1]).split("\n") == SENTENCES[kind]


def test_every_sentence_is_short_and_plain():
    """Three lines at most, some 60 words; neither scores nor powers of ten nor keys that were not filled."""
    words = []
    for _, judgement in JUDGEMENTS.values():
        text = said(judgement)
        words.append(len(text.split()))
        assert 1 <= len(text.split("\n")) <= 3
        assert not re.search(r"\bz\b|\de[+-]?\d|None|nan|inf\b|  |\.\.| \.|\bχ|likelihood", text)
    assert sorted(words)[len(words) // 2] <= 60 and max(words) <= 120


@pytest.mark.parametrize("name", vocabulary())
def test_every_effect_is_told_in_its_own_words(name):
    effect = vocabulary()[name]
    line = said(off(found=(found(name, *[0.5] * len(effect.parameters)),))).split("\n")[1]
    assert line.startswith(f"{effect.sentence[0].upper()}{effect.sentence[1:]} ({name}, {effect.parameters[0].name} ")


@pytest.mark.parametrize("kind", ["agreed", "one", "stranger", "sheet"])
def test_what_no_verdict_rests_on_is_told_first(kind):
    """Behind what agrees or does not, in as many lines as without; where nothing could be tested, among the reasons."""
    remark = "4 of 8 spot frames cannot be used (no light above the noise)"
    lines = sentence(document(JUDGEMENTS[kind][1], "small", light_words=WORDS, beware=remark)).split("\n")
    assert lines == [f"{SENTENCES[kind][0]} Beware: {remark}.", *SENTENCES[kind][1:]]
    untested = sentence(document(JUDGEMENTS["untested"][1], "small", beware=remark))
    assert untested == f"Nothing could be tested: there is no usable spot frame; {remark}."


def test_a_learned_shape_without_words():
    lines = [
        sentence(document(off(light=learned(0.06, error)), "small")).split("\n")[1] for error in (0.002, float("nan"))
    ]
    assert lines == [f"The light is not a Gaussian: {share} of its power lies elsewhere." for share in SHARES]


def test_several_numbers_of_a_sheet():
    rows = (stated("gain_dn_per_e", 0.11, 0.0033, 6.7, 0.001), stated("read_noise_e", 12.0, 0.6, 5.0, 0.2))
    first = said(judged(sheet=rows)).split("\n")[0]
    assert "states 0.1100 ± 0.0033 DN/e−; the read noise is 15.00 ± 0.20 e−, where it states 12.0 ± 0.6 e−." in first


def test_what_noise_may_hide_is_not_said_to_be_absent():
    """One frame with much noise: the power of what is left is known to (0.5 % of the peak)², so that three times this
    may be hidden: √3 · 0.5 % = 0.87 %."""
    last = said(off(found=(BEND,), gap=closed(nonlinearity=0.9), unexplained=left(0.0, 2.5e-5))).split("\n")[2]
    assert "leaves less than 0.87 % of the peak;" in last


def test_laws_that_hardly_move_are_not_told():
    """2 errors off is no news, 4 are; where effects tie no move is certain."""
    near, far = (MOVED._replace(before=(0.003 + k * 0.0057, 8.83)) for k in (2, 4))
    assert "p1" not in said(off(found=(CLIP,), shift=near))
    assert said(off(found=(CLIP, BEND), shift=far)).endswith("With them p1 goes from 0.026 to 0.003 ± 0.006 px.")
    assert "p1" not in said(off(found=(GHOST,), shift=far))


def test_no_gap_closes():
    assert "On unseen repeats no gap closes;" in said(off(found=(BEND,), gap=closed(nonlinearity=-0.1)))
    fitted = closed(nonlinearity=0.9)._replace(before=1.015)
    assert "\nIt shows in the noise or the scatter, not in the mean images;" in said(off(found=(BEND,), gap=fitted))


@pytest.mark.parametrize(
    ("value", "stderr", "unit", "text"),
    [
        (0.0239, 0.0004, "1", "0.0239 ± 0.0004"),
        (-29.2, 0.35, "px", "−29.20 ± 0.35 px"),
        (1.23e-5, 4.2e-7, "s", "12.3 ± 0.4 µs"),
        (12.3, 1.4, "deg", "12.3 ± 1.4°"),
        (851.3, None, "DN", "851.3 DN"),
        (851.3, 0.0, "DN", "851.3 DN"),
        (30022.4, 123.0, "px/s", "30020 ± 120 px/s"),
        (30022.4, 98.0, "px/s", "30020 ± 100 px/s"),
        (30022.4, None, "px/s", "30022 px/s"),
        (None, 0.1, "px", "no value"),
        (float("nan"), 0.1, "px", "no value"),
    ],
)
def test_values_with_their_errors(value, stderr, unit, text):
    assert value_text(value, stderr, unit) == text


@pytest.mark.parametrize(
    ("part", "text"),
    [(0.0548, "5.5 %"), (0.9997, "99.9 %"), (0.97, "97 %"), (1.0, "100 %"), (1.204, "120 %"), (0.002, "0.2 %"),
     (-0.03, "−3 %"), (1e-7, "0 %"), (-1e-7, "0 %"), (0.0, "0 %")],
)  # fmt: skip
def test_parts_in_percent(part, text):
    assert percent_text(part) == text


def test_probabilities_and_conditions():
    assert [probability_text(p) for p in (0.32, 0.0004, 1e-300)] == ["p = 0.32", "p = 0.0004", "p < 0.0001"]
    assert condition_text({"exposure_s": 1.8e-3, "angle_deg": 45.0}) == "an exposure of 1.8 ms and 45°"
    assert condition_text({"exposure_s": 4e-4, "angle_deg": None, "blocked": True}) == (
        "an exposure of 400 µs with the beam blocked"
    )
