"""The summary of a verdict from findings, word by word, and values, limits and lists in words."""

import re
from dataclasses import replace

import numpy as np
import pytest

from spotcheck.discrepancy.findings import Advice, UpperLimit
from spotcheck.discrepancy.limits import NOT_CONFIRMED, TOO_SMALL
from spotcheck.discrepancy.sentence import either_text, summarize_verdict
from spotcheck.discrepancy.verdict import compose_verdict
from spotcheck.discrepancy.words import (
    condition_text,
    limit_text,
    limits_text,
    list_text,
    over_noise_text,
    percent_text,
    probability_text,
    size_text,
)
from spotcheck.model.effect import Effect, Only, Parameter
from spotcheck.model.effects import built_in
from tests.samples.findings_cases import (
    BEND,
    CLIP,
    GAIN,
    GHOST,
    KINDS,
    LEVELS,
    MOVED,
    NAN,
    NO_LAW,
    NOISE,
    PAIR,
    agree,
    closed,
    disagree,
    learned,
    left,
    named,
    summary,
    whole,
)

# Summary


@pytest.mark.parametrize("kind", KINDS)
def test_summary_word_by_word(kind):
    assert whole(kind)["sentence"].split("\n") == KINDS[kind][2]


def test_summaries_are_short_and_plain():
    """At most three lines, about 60 words in the median; no symbols of statistics, powers of ten or missing values."""
    lengths = []
    for kind in KINDS:
        text = whole(kind)["sentence"]
        lengths.append(len(text.split()))
        assert 1 <= len(text.split("\n")) <= 3
        assert not re.search(r"\bz\b|\de[+-]?\d|None|nan|inf\b|  |\.\.| \.|\bχ|likelihood", text)
    assert np.median(lengths) <= 60 and max(lengths) <= 135


@pytest.mark.parametrize("name", [name for name, effect in built_in().items() if effect.stages])
def test_every_effect_is_described_in_the_words_of_its_file(name):
    effect = built_in()[name]
    line = summary(disagree(effects=(named(name, *[(0.5, 0.1)] * len(effect.parameters)),))).split("\n")[1]
    assert line.startswith(f"{effect.sentence[0].upper()}{effect.sentence[1:]} ({name}, {effect.parameters[0].name} ")


@pytest.mark.parametrize("kind", ["agree", "one", "unknown", "sheet", "not converged"])
def test_remarks_on_the_data_end_the_first_line(kind):
    remark = "4 of 8 spot frames cannot be used (no light above the noise)"
    findings, _, lines = KINDS[kind]
    assert summary(replace(findings, remarks=(remark,))).split("\n") == [f"{lines[0]} Note: {remark}.", *lines[1:]]
    untested = summary(replace(KINDS["not assessed"][0], remarks=(remark,)))
    assert untested == f"Nothing could be tested: there is no usable spot frame; {remark}."


def test_effects_that_cannot_be_assessed_are_no_remarks():
    document = compose_verdict(agree(not_assessed=(("laser_drift", "the order is not known"),)), "small")
    assert document["not_assessed"] == [{"effect": "laser_drift", "why": "the order is not known"}]
    assert "order" not in summarize_verdict(document)


def test_a_learned_shape_without_words():
    lines = [summary(disagree(light=learned("", stderr=error))).split("\n")[1] for error in (0.002, NAN)]
    assert lines == [
        f"The light does not have the declared shape: {share} of its power lies elsewhere."
        for share in ("6.00 ± 0.20 %", "6 %")
    ]


def test_noise_that_may_hide_a_residual():
    """With an error of (0.5 % of the peak)² three times this may be hidden: √3 · 0.5 % = 0.87 %."""
    text = summary(disagree(effects=(BEND,), gap=closed(0.9), unexplained=left(0.0, 2.5e-5)))
    assert "less than 0.87 % of the peak remains." in text


def test_p1_and_p2_that_hardly_change_are_left_out():
    """Changes of 2 errors are left out, those of 4 are not; with rivals none is certain."""
    near, far = (replace(MOVED, before=(0.003 + k * 0.0057, 8.83)) for k in (2, 4))
    assert "p1" not in summary(disagree(effects=(CLIP,), law=near))
    assert summary(disagree(effects=(CLIP,), law=far)).endswith("The fitted p1 changes from 0.026 to 0.003 ± 0.006 px.")
    assert "p1" not in summary(disagree(effects=(PAIR,), law=far))


def test_a_gap_that_does_not_close():
    text = summary(disagree(effects=(BEND, CLIP), gap=closed(-0.1)))
    assert "These effects close none of the gap on held-out repeats." in text


def test_effects_that_do_not_explain_a_disagreement():
    reasons = {"nonlinearity": NOT_CONFIRMED, "smear": TOO_SMALL, "saturation": TOO_SMALL, "speckle": "not found"}
    limits = tuple(UpperLimit(name, built_in()[name].parameters[0].name, "1", why) for name, why in reasons.items())
    assert summary(disagree(law=NO_LAW, limits=limits)).split("\n")[1] == (
        "No effect of the vocabulary explains it. nonlinearity fits the searched frames, but not the held-out ones."
        " smear and saturation are significant, but too small to matter."
    )


def test_advice_for_rivals():
    assert summary(disagree(effects=(PAIR,))).endswith("No measurement is known that would separate them.")
    blocked = Advice({"exposure_s": 4e-4, "blocked": True}, ("ghost_reflection", "scatter_halo"), 1)
    assert summary(disagree(effects=(PAIR,), advice=(blocked,))).endswith(
        "1 frame at an exposure of 400 µs with the beam blocked would separate them."
    )


def test_rivals_that_are_far_behind():
    far = replace(GHOST, rivals={"scatter_halo": 40.0})
    document = compose_verdict(disagree(effects=(far,)), "small")
    assert either_text(document["effects"][0], document).endswith("the first is over 100 times as likely")
    alike = compose_verdict(disagree(effects=(replace(GHOST, rivals={"scatter_halo": 0.1}),)), "small")
    assert either_text(alike["effects"][0], alike).endswith("these frames cannot separate them")


def test_a_sheet_is_contradicted_in_several_numbers():
    first = summary(agree(sensor=(GAIN, replace(NOISE, fitted=15.0)))).split("\n")[0]
    assert "not 0.1100 ± 0.0033 DN/e-; the read noise is 15.00 ± 0.20 e-, not 12.0 ± 0.6 e-. Otherwise, model" in first


def test_flats_that_agree_or_are_not_explained():
    assert summary(agree(law=NO_LAW, limits=(), levels=LEVELS)) == (
        "The linear sensor model and the flats agree within the noise (p = 0.32).\n"
        "The gain K is 0.1234 ± 0.0005 DN/e-, from 20 levels. The light scatters by 0.4 % from level to level."
    )
    unknown = summary(disagree(law=NO_LAW, levels=replace(LEVELS, light_scatter=0.0), places=()))
    assert unknown.endswith("A straight line up to 70 % of saturation gives the gain K = 0.1310 ± 0.0020 DN/e-.")
    assert "Less than 0.2 % of the highest signal remains." in unknown and "spot" not in unknown


# Words


@pytest.mark.parametrize(
    ("part", "text"),
    [(0.0548, "5.5 %"), (0.9997, "99.9 %"), (0.97, "97 %"), (1.0, "100 %"), (1.204, "120 %"), (0.002, "0.2 %"),
     (-0.03, "−3 %"), (1e-7, "0 %"), (-1e-7, "0 %"), (0.0, "0 %")],
)  # fmt: skip
def test_parts_in_per_cent(part, text):
    assert percent_text(part) == text


def test_other_words():
    assert [probability_text(p) for p in (0.32, 0.0004, 1e-300)] == ["p = 0.32", "p = 0.0004", "p < 0.0001"]
    assert condition_text({"exposure_s": 1.8e-3, "angle_deg": 45.0}) == "an exposure of 1.8 ms and 45°"
    assert condition_text({"exposure_s": 4e-4, "angle_deg": None, "blocked": True}) == (
        "an exposure of 400 µs with the beam blocked"
    )
    assert [over_noise_text(x) for x in (0.996, 1.0, 12.34)] == ["1.00", "1.00", "12.3"]
    assert [list_text(list("abc")[:n]) for n in range(4)] == ["", "a", "a and b", "a, b and c"]


LIMIT_WORDS = {
    "smear": (UpperLimit("smear", "fraction", "1", "not significant", high=0.000444, frames=54),
              "light smeared along columns below 0.044 %", "; 54 more frames would halve that"),
    "bend": (UpperLimit("nonlinearity", "q", "1", "not significant", low=-0.0123, high=0.004,
                        remark="the shape limits"),
             "bend of the response from −1.2 % to 0.4 %", "; the shape limits"),
    "clip": (UpperLimit("saturation", "level", "DN", "not significant", low=930.0), "no clip below 930 DN", ""),
    "none": (UpperLimit("speckle", "contrast", "1", "the frames say nothing about it"), "", ""),
}  # fmt: skip


@pytest.mark.parametrize("kind", LIMIT_WORDS)
def test_limits_in_words(kind):
    """Two digits of the distance from no effect; reason or number of frames behind."""
    limit, words, after = LIMIT_WORDS[kind]
    (row,) = compose_verdict(agree(limits=(limit,)), "small")["limits"]
    assert (row["words"], row["why"], row["more"], row["frames"]) == (words, limit.reason, limit.remark, limit.frames)
    text = f"{words} (95 %)" if words else limit.reason
    assert limits_text({"limits": [row]}) == [f"{limit.effect}: {text}{after}"]


@pytest.mark.parametrize("name", built_in())
def test_every_effect_has_words_for_its_limit(name):
    effect = built_in()[name]
    low, high = ("1 DN", "") if np.isinf(effect.vanishes_at) else ("", "2 DN")
    assert size_text(effect, low, high).endswith(f"{effect.noun} below {low or high}")
    assert size_text(effect, "", "") == ""
    assert size_text(effect, "3 DN", "5 DN") and limit_text(0.123456, "1", effect)


def test_an_effect_without_a_noun_goes_by_its_parameter():
    mine = Effect("mine", "", (Parameter("q", "1"),), {Only.ONLY: ()}, lambda scales: [])
    assert size_text(mine, "1", "") == "q of mine above 1"
    assert limit_text(1.23456, "px", None) == "1.2 px"
