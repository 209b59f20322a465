"""The paragraph that a person reads first: every status says what it must, and nothing that it may not."""

import json
import re

import pytest

from spotcheck.discrepancy.extend import Tolerance
from spotcheck.discrepancy.sentence import condition_text, place_text, sentence, value_text
from spotcheck.model.effects import vocabulary

GHOST = {
    "fraction": {"value": 0.0239, "stderr": 0.0004, "unit": "1"},
    "dx": {"value": -29.2, "stderr": 0.35, "unit": "px"},
}
ROW = {
    "block": "mean",
    "angle_deg": 45.0,
    "exposure_s": 9e-4,
    "bin": {"quantity": "radius", "low": 20.0, "high": 24.0, "unit": "px"},
    "z": -31.5,
    "p_adjusted": 1e-200,
    "share": 0.2,
}


def verdict(status: str = "named", **changes) -> dict:
    """A whole verdict: one ghost, named."""
    effect = {"name": "ghost_reflection", "candidates": ["ghost_reflection"], "parameters": GHOST, "gap_closed": 0.99}
    found = status in ("named", "ambiguous")
    nothing = dict.fromkeys(("before", "after", "noise_floor", "closed", "rms_dn_before", "rms_dn_after", "on"))
    gap = {"before": 28.0, "after": 1.02, "noise_floor": 1.0, "closed": 0.9993, "rms_dn_before": 1.09,
           "rms_dn_after": 0.02, "on": "unseen repeats"}  # fmt: skip
    after = 7.3443 if found else None
    own = {
        "schema": 1,
        "dataset": "small",
        "status": status,
        "detection": {"p_value": 1 / 1501, "n_simulations": 1500, "alpha": 0.01, "rms_residual_percent_of_peak": 0.316,
                      "excess_variance_fraction": 0.0245},
        "where": [ROW, ROW | {"block": "line"}],
        "effects": [effect] if found else [],
        "explanations": [["ghost_reflection"]] if found else [],
        "baseline_shift": {
            "p1": {"before": 7.3931, "after": after, "stderr": 0.0034, "unit": "px"},
            "p2": {"before": 86.81, "after": 86.194 if found else None, "stderr": 0.029, "unit": "px"},
        },
        "unexplained": {"p_value": 0.42 if found else 1 / 1501, "share": 0.0 if found else 1.0},
        "gap": gap if found else nothing,
        "advice": [],
        "not_assessed": [{"effect": "laser_drift", "why": "the order of acquisition is not known"}],
        "sentence": "",
    }  # fmt: skip
    return json.loads(json.dumps(own | changes))  # nothing shared


def ambiguous() -> dict:
    own = verdict("ambiguous")
    own["effects"][0]["candidates"].append("scatter_halo")
    own["explanations"].append(["scatter_halo"])
    own["advice"] = [{"condition": {"exposure_s": 1.8e-3, "angle_deg": 22.5},
                      "separates": ["ghost_reflection", "scatter_halo"], "frames": 12}]  # fmt: skip
    return own


@pytest.mark.parametrize(
    ("value", "stderr", "unit", "text"),
    [
        (0.0239, 0.0004, "1", "0.02390 ± 0.00040"),
        (-29.2, 0.35, "px", "−29.20 ± 0.35 px"),
        (1.23e-5, 4.2e-7, "s", "12.30 ± 0.42 µs"),
        (12.3, 1.4, "deg", "12.3 ± 1.4°"),
        (851.3, None, "DN", "851.3 DN"),
        (851.3, 0.0, "DN", "851.3 DN"),
        (4567.0, 123.0, "px/s", "4567 ± 123 px/s"),
        (None, 0.1, "px", "no value"),
        (float("nan"), 0.1, "px", "no value"),
    ],
)
def test_values_with_their_errors(value, stderr, unit, text):
    assert value_text(value, stderr, unit) == text


def test_conditions_in_words():
    given = {"exposure_s": 1.8e-3, "angle_deg": 22.5}
    assert condition_text(given) == "an exposure of 1.8 ms and 22.5°"
    assert condition_text({"z_m": 0.168}) == "z_m 0.168"
    dark = "an exposure of 2 ms with the beam blocked and the room as it was"
    assert condition_text({"exposure_s": 2e-3, "blocked": True}) == dark


@pytest.mark.parametrize(
    ("block", "own", "words"),
    [
        ("mean", ("radius", 20.0, 24.0, "px"), "ring at 20 to 24 px"),
        ("mean", ("radius", 6.0, None, "σ_g"), "ring at over 6 σ_g"),
        ("mean", ("radius, azimuthal order 2", 2.0, 2.5, "σ_g"), "twofold pattern at 2 to 2.5 σ_g"),
        ("mean", ("grey level", 100.0, 120.0, "DN"), "gives 100 to 120 DN"),
        ("variance", ("level of light", 0.0, 0.01, "of the peak"), "noise at 0 to 1 % of the peak"),
        ("spectrum", ("period", 15.4, 22.2, "px"), "periods of 15.4 to 22.2 px"),
        ("spectrum", ("stripes", 18.0, 18.0, "px"), "period of 18 px"),
        ("line", ("rows of a frame", None, None, "1"), "scatter of the rows of a frame"),
        ("frame", ("scatter of brightness", None, None, "1"), "scatter of brightness from frame to frame"),
        ("frame", ("code of the converter", 8.0, 8.0, "DN"), "code of the converter (8 DN)"),
    ],
)
def test_places_in_words(block, own, words):
    assert words in place_text(
        ROW | {"block": block, "bin": dict(zip(("quantity", "low", "high", "unit"), own, strict=True))}
    )


def test_named():
    text = sentence(verdict())
    for part in (
        "none of 1500",
        "0.32 % of the spot's peak",
        "28 times what noise alone leaves",
        "+2.5 %",
        "20 to 24 px",
        "45° and 900 µs",
        "z = −31.5",
        "whole rows or columns",
        "One effect of the vocabulary is named: ghost_reflection",
        vocabulary()["ghost_reflection"].sentence,
        "fraction 0.02390 ± 0.00040",
        "dx −29.20 ± 0.35 px",
        "unseen repeats the mean squared residual falls from 28 to 1.02",
        "99.9 % of the gap is closed",
        "p1 from 7.3931 to 7.3443 ± 0.0034 px",
        "p2 from 86.810 to 86.194 ± 0.029 px",
        "so far the effect had shifted them",
        "no more than chance brings (p = 0.42)",
        "does not prove the name",
        "laser_drift (the order of acquisition is not known)",
    ):
        assert part in text, part
    assert "cannot tell" not in text


def test_ambiguous_names_the_rival_and_the_measurement():
    text = sentence(ambiguous())
    assert "explains it best: ghost_reflection" in text and "is named" not in text
    assert f"cannot tell this from scatter_halo ({vocabulary()['scatter_halo'].sentence}) in place of" in text
    assert "12 frames at an exposure of 1.8 ms and 22.5° would tell ghost_reflection from" in text
    assert "No next measurement" not in text and "does not prove the name" in text
    without = ambiguous() | {"advice": []}
    assert "No next measurement was found" in sentence(without)


def test_two_effects_and_a_rival_for_one_of_them():
    own = ambiguous()
    own["effects"].append(own["effects"][0] | {"name": "row_noise", "candidates": ["row_noise"], "parameters": {}})
    own["explanations"] = [["ghost_reflection", "row_noise"], ["scatter_halo", "row_noise"]]
    text = sentence(own)
    assert "Two effects of the vocabulary explain it best together: ghost_reflection" in text
    assert "row_noise (whole rows scatter together, anew in every frame)." in text
    assert "in place of ghost_reflection" in text and "in place of row_noise" not in text
    assert "does not prove the names" in text


def test_unknown_names_nothing():
    text = sentence(verdict("unknown"))
    assert "nothing is named" in text and "p1 and p2 may be off" in text and "p1 = 7.3931 ± 0.0034 px" in text
    assert not re.search(r"ghost|gap is closed|does not prove", text)


def test_unknown_keeps_what_was_rightly_named():
    own = verdict("named") | {"status": "unknown", "unexplained": {"p_value": 1 / 1501, "share": 0.031}}
    text = sentence(own)
    assert "Part of it is explained by ghost_reflection" in text and "does not prove a name" in text
    assert "3.1 % of the first excess" in text and "no effect explains it" in text


def test_consistent_by_chance():
    own = verdict("consistent", where=[])
    own["detection"] |= {"p_value": 0.54, "rms_residual_percent_of_peak": 0.0, "excess_variance_fraction": 0.0004}
    text = sentence(own)
    assert text.startswith("Simulation and measurement agree: p = 0.54 among 1500")
    assert "does not stand out of the noise" in text and "too little" not in text


def test_consistent_by_tolerance_says_both():
    """That chance does not bring it, and how small it is beside what is let pass."""
    own = verdict("consistent")
    own["detection"]["rms_residual_percent_of_peak"] = 0.051
    text = sentence(own, Tolerance())
    assert "more than chance (p = 0.00067, alpha = 0.01)" in text
    assert "0.051 % of the spot's peak in the mean image (tolerance 0.2 %)" in text
    assert "2.5 % of the noise's variance (tolerance 4 %)" in text and "too little to matter" in text
    assert "tolerance" not in sentence(own)


def test_not_assessed_says_why():
    own = verdict("not_assessed", where=[])
    own["detection"]["p_value"] = None
    own["not_assessed"].append({"effect": "all", "why": "there is no usable spot frame"})
    text = sentence(own)
    assert text.startswith("Nothing could be tested: there is no usable spot frame.")
    assert "Not assessed: laser_drift" in text and "all (" not in text


def test_an_effect_that_only_scatters_closes_no_gap_in_the_mean():
    own = verdict()
    own["gap"] |= {"before": 1.003, "after": 1.001, "closed": 0.4}
    text = sentence(own)
    assert "shows in the scatter, and closes no gap" in text and "%  of the gap" not in text and "40 %" not in text


def test_what_happens_to_p1_and_p2():
    own = verdict()
    own["baseline_shift"]["p1"]["after"] = own["baseline_shift"]["p2"]["after"] = None
    assert "p1 and p2 have no meaning" in sentence(own)
    own = verdict()
    own["baseline_shift"]["p1"] = dict.fromkeys(("before", "after", "stderr")) | {"unit": "px"}
    own["baseline_shift"]["p2"]["before"] = own["baseline_shift"]["p2"]["after"] + 0.001
    text = sentence(own)
    assert "p1" not in text and "moves p2 from 86.195 to 86.194 ± 0.029 px, within its error" in text


@pytest.mark.parametrize("status", ["consistent", "named", "ambiguous", "unknown", "not_assessed"])
def test_missing_numbers_leave_no_trace(status):
    """Whatever may be null is; the paragraph is still whole sentences, without a word of Python in it."""
    own = ambiguous() | {"status": status} if status == "ambiguous" else verdict(status)
    own["detection"] |= {"p_value": None, "rms_residual_percent_of_peak": None, "excess_variance_fraction": None}
    own["gap"] = dict.fromkeys(own["gap"])
    own["unexplained"] = {"p_value": None, "share": None}
    own["where"] = [ROW | {"angle_deg": None, "exposure_s": None, "share": None}]
    for shift in own["baseline_shift"].values():
        shift |= {"stderr": None}
    for effect in own["effects"]:
        effect["gap_closed"] = None
        for parameter in effect["parameters"].values():
            parameter["stderr"] = None
    text = sentence(own)
    assert not re.search(r"None|nan|inf\b|\{|  |\.\.|\( ", text), text
    assert text.endswith(".") and text[0].isupper()
