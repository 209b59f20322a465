"""verdict.json, version 4, from findings: statuses, numbers, and the contract."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spotcheck.discrepancy.conclude import absorbed_noise, error_without_prior
from spotcheck.discrepancy.findings import Consistency, Findings, Gap, MetricChange, Unexplained, UpperLimit
from spotcheck.discrepancy.sentence import summarize_verdict
from spotcheck.discrepancy.verdict import LEARNED_SHAPE, Status, compose_verdict, weigh_candidates
from spotcheck.discrepancy.written import breach_of_verdict, write_verdict
from spotcheck.io.store import ContractError
from tests.samples.findings_cases import (
    BEND,
    CLIP,
    GAIN,
    KINDS,
    LEVELS,
    MOVED,
    NAN,
    NO_LAW,
    NOISE,
    SEPARATES,
    agree,
    closed,
    detected,
    disagree,
    learned,
    left,
    named,
    whole,
)

# Status


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_findings_keeps_the_contract(kind, tmp_path):
    document = whole(kind)
    assert document["status"] == KINDS[kind][1]
    assert breach_of_verdict(document) is None
    write_verdict(document, tmp_path / "verdict.json")
    assert json.loads((tmp_path / "verdict.json").read_text(encoding="utf-8")) == document


def test_every_status_has_findings():
    assert {status for _, status, _ in KINDS.values()} == {status.value for status in Status}


def test_more_remains_only_beyond_three_errors():
    """0.4 % of the peak, with a tolerance of 0.2 %: the square 1.6e-5 must exceed 4e-6 by three of its errors."""
    statuses = [
        compose_verdict(disagree(effects=(BEND,), unexplained=left(size, error)), "small")["status"]
        for size, error in ((0.004, 3.9e-6), (0.004, 4.1e-6), (0.0019, 1e-9), (0.0021, 1e-9), (0.004, np.inf))
    ]
    assert statuses == ["named_more_remains", "named", "named", "named_more_remains", "named"]


def test_alpha_and_tolerance_are_options():
    findings = disagree(p=0.02, unexplained=left(0.004))
    statuses = {options: compose_verdict(findings, "small", alpha=options[0], tolerance=options[1])["status"]
                for options in ((0.01, 0.01), (0.05, 0.01), (0.01, 0.002))}  # fmt: skip
    assert statuses == {(0.01, 0.01): "consistent", (0.05, 0.01): "unknown", (0.01, 0.002): "unknown"}
    document = compose_verdict(findings, "small")
    assert document["detection"]["alpha"] == 0.01 and document["unexplained"]["tolerance"] == 0.002


def test_without_any_test_nothing_is_assessed():
    document = compose_verdict(Findings(), "small")
    assert document["status"] == "not_assessed" and document["not_assessed"][0]["effect"] == "all"
    assert summarize_verdict(document) == "Nothing could be tested: no test was possible."


def test_values_that_did_not_converge_are_not_reported():
    """Only the declared model's own p1 and p2 stay."""
    metric = MetricChange("k", "1", 0.2, 0.1, 0.2)
    findings = disagree(has_converged=False, effects=(CLIP,), light=learned(), law=MOVED, gap=closed(0.9),
                        limits=agree().limits, advice=(SEPARATES,), metrics=(metric,), levels=LEVELS,
                        sensor=(GAIN,))  # fmt: skip
    document = compose_verdict(findings, "small")
    for key in ("effects", "sheet", "limits", "advice", "metrics"):
        assert document[key] == []
    assert document["light"] is None and set(document["gap"].values()) == {None}
    assert document["unexplained"]["size"] is None
    shift = document["baseline_shift"]["p1"]
    assert (shift["before"], shift["after"], shift["stderr"]) == (2.3039, None, None)
    assert document["levels"]["gain_dn_per_e"] == document["levels"]["straight_line"]
    text = json.dumps(document) + summarize_verdict(document)
    assert "520" not in text and "0.1321" not in text


# Keys


@pytest.mark.parametrize("kind", KINDS)
def test_candidates_are_in_the_order_of_their_weights(kind):
    for effect in whole(kind)["effects"]:
        rivals = effect["evidence"]["rivals"]
        weights = [effect["evidence"]["weight"], *(rival["weight"] for rival in rivals)]
        assert sum(weights) == pytest.approx(1.0) and weights == sorted(weights, reverse=True)
        assert effect["candidates"] == [effect["name"], *(rival["name"] for rival in rivals)]


def test_weights_of_candidates():
    """exp(−d/2) : 1 for one that is d behind; the numbers of hopeless candidates do not overflow."""
    weights = weigh_candidates({"first": 0.0, "second": 2 * np.log(3.0)})
    assert weights == pytest.approx({"first": 0.75, "second": 0.25})
    assert weigh_candidates({"first": 0.0, "hopeless": 1e6}) == {"first": 1.0, "hopeless": 0.0}


def test_row_of_an_effect():
    (row,) = whole("one")["effects"]
    assert (row["name"], row["form"], row["gap_closed"]) == ("saturation", "sharp with noise", None)
    assert row["parameters"] == {"level": {"value": 520.7, "stderr": 5.2, "unit": "DN"}}
    evidence = row["evidence"]
    assert (evidence["gain"], evidence["z"], evidence["rivals"]) == (900.0, 30.0, [])
    assert evidence["consistency"] == {"q": 27.0, "cells": 24, "limit": 77.0, "holds": True}


def test_parameters_have_the_strength_first_and_directions_within_one_turn():
    ellipse = named("beam_ellipticity", (1.05, NAN), (30.0 - 1000 * 360.0, 2.0))
    ellipse = replace(ellipse, values=dict(reversed(ellipse.values.items())))
    (row,) = compose_verdict(disagree(effects=(ellipse,)), "small")["effects"]
    assert list(row["parameters"]) == ["ratio", "direction"]
    assert row["parameters"]["ratio"]["stderr"] is None
    assert row["parameters"]["direction"]["value"] == pytest.approx(30.0)


def test_a_learned_light_stands_first_among_effects():
    document = whole("light and one")
    row = document["effects"][0]
    assert [effect["name"] for effect in document["effects"]] == [LEARNED_SHAPE.name, "nonlinearity"]
    assert row["parameters"]["power"] == {"value": 0.06, "stderr": 0.002, "unit": "1"}
    assert row["parameters"]["order"]["value"] == 4 and row["evidence"]["z"] == pytest.approx(30.0)
    assert document["light"]["axes"]["direction_deg"] == pytest.approx(35.0)


def test_the_sheet_is_contradicted_beyond_three_stated_errors():
    """(0.1321 − 0.11)/0.0033 = 6.7 and 0.7/0.6; in √(0.6² − 0.2²) the second is 1.24."""
    gain, noise = whole("sheet")["sheet"]
    assert (gain["contradicts"], noise["contradicts"]) == (True, False)
    assert gain["stated_errors"] == pytest.approx(6.697, abs=1e-3) and noise["z"] == pytest.approx(1.237, abs=1e-3)
    silent = replace(NOISE, fitted=12.0, stderr=0.6)
    assert compose_verdict(agree(sensor=(silent,)), "small")["sheet"][0]["z"] is None


def test_a_value_that_misfit_pulls_away_does_not_contradict_the_sheet():
    """11 errors of the sheet, but 0.7 of its own."""
    pulled = replace(NOISE, fitted=NOISE.stated + 11 * NOISE.stated_stderr, stderr=15 * NOISE.stated_stderr)
    assert not compose_verdict(agree(sensor=(pulled,)), "small")["sheet"][0]["contradicts"]


def test_a_value_from_the_same_frames_is_no_data_sheet_to_contradict():
    """The shift is that of `GAIN`, 6.7 errors; flats and darks are tested and named, spots are not."""
    for source, contradicts in (("flats and darks", True), ("spots", False)):
        document = compose_verdict(agree(sensor=(replace(GAIN, source=source),)), "small")
        (row,) = document["sheet"]
        assert (row["source"], row["contradicts"], row["z"] is not None) == (source, contradicts, contradicts)
        assert ("contradict the flats and darks: the gain" in summarize_verdict(document)) == contradicts
        assert "data sheet" not in summarize_verdict(document)
    # Equal errors of prior and frames: the fit with both has 1/√2 of them, the frames alone all of it.
    assert error_without_prior(0.02 / 2**0.5, 0.02) == pytest.approx(0.02)
    assert error_without_prior(0.03, 0.02) == 0.02


def test_a_free_shape_absorbs_noise_in_proportion_to_its_coefficients():
    """Nodes half a σ of 8 px apart: one in 4 × 4 px, shared by five frames; without a shape none."""
    spots = SimpleNamespace(log_sigma=np.full(5, np.log(8.0)))
    fit: Any = SimpleNamespace(model=SimpleNamespace(grid=SimpleNamespace(step=0.5), spots=spots))
    fit.pixels = SimpleNamespace(share=1.0)
    assert absorbed_noise(fit) == pytest.approx(1 / 80)
    fit.model.grid = None
    assert absorbed_noise(fit) == 0.0


def test_what_remains():
    """The error e of a square gives √(size² + e) − size: for 0.4 % and (0.3 %)², 0.5 % − 0.4 %."""
    row = Unexplained(0.004, 9e-6, 16 / 9, 1.2, 0.04)
    unexplained = compose_verdict(disagree(effects=(BEND,), unexplained=row), "small")["unexplained"]
    assert unexplained == {"size": 0.004, "error": pytest.approx(0.001), "z": pytest.approx(16 / 9),
                           "tolerance": 0.002, "share": 1.0, "p_value": 0.04}  # fmt: skip
    unknown = compose_verdict(disagree(effects=(BEND,), unexplained=left(0.0, np.inf)), "small")["unexplained"]
    assert unknown["size"] is unknown["error"] is unknown["share"] is None


def test_gap_and_metrics():
    metric = MetricChange("width", "px", 12.0, NAN, 12.1)
    document = compose_verdict(disagree(effects=(BEND,), gap=closed(0.75), metrics=(metric,)), "small")
    assert document["gap"] == {"before": 81.0, "after": 21.0, "noise_floor": 1.0, "closed": 0.75, "rms_dn_before": 3.0,
                               "rms_dn_after": 0.1, "gain": 5400.0, "on": "held-out repeats"}  # fmt: skip
    assert document["metrics"] == [
        {"name": "width", "unit": "px", "measured": 12.0, "declared": None, "extended": 12.1}
    ]


def test_detection_names_the_strongest_test():
    detection = compose_verdict(agree(detection=detected(1e-250)), "small")["detection"]
    assert (detection["p_value"], detection["parts"]) == (1e-250, 2)
    assert (detection["worst"]["part"], detection["worst"]["p_value"]) == ("blocks", 5e-251)
    assert detection["rms_residual_percent_of_peak"] == pytest.approx(0.03)


def test_numbers_that_are_not_known_are_null(tmp_path):
    """Findings with NaN in every place where a number may be missing."""
    limit = UpperLimit("speckle", "contrast", "1", "the frames say nothing about it")
    gap = Gap(NAN, NAN, NAN, NAN, NAN, NAN, NAN, "held-out repeats")
    light = learned(stderr=NAN, major=NAN, minor=NAN, direction_deg=NAN, lowest=NAN)
    effect = named("nonlinearity", (NAN, NAN), gain=NAN, z=NAN, consistency=Consistency(NAN, 0, NAN, True))
    findings = disagree(p=NAN, rms=NAN, effects=(effect,), light=light, gap=gap, limits=(limit,), law=NO_LAW,
                        unexplained=Unexplained(NAN, NAN, NAN, NAN, NAN),
                        sensor=(replace(GAIN, stderr=NAN),))  # fmt: skip
    document = compose_verdict(findings, "small")
    document["sentence"] = summarize_verdict(document)
    write_verdict(document, tmp_path / "verdict.json")
    assert "nan" not in document["sentence"].lower() and "None" not in document["sentence"]


def put(path: str, value: Any):
    """Return a change of a verdict: the value at a dotted path."""

    def change(document: dict) -> None:
        *parents, last = path.split(".")
        inner: Any = document
        for key in parents:
            inner = inner[int(key)] if isinstance(inner, list) else inner[key]
        inner[int(last) if isinstance(inner, list) else last] = value

    return change


@pytest.mark.parametrize(
    ("kind", "change", "words"),
    [
        ("one", lambda document: document.pop("metrics"), "'metrics' is a required property"),
        ("one", put("schema", 3), "schema"),
        ("one", put("status", "sure"), "status"),
        ("one", put("sentence", ""), "sentence"),
        ("one", put("detection.p_value", 0), "detection.p_value"),
        ("one", put("effects.0.name", "coma"), "effects.0.name"),
        ("one", put("effects.0.evidence.weight", 1.5), "weight"),
        ("light", put("light.power", 1.5), "light.power"),
        ("sheet", put("sheet.0.name", "quantum_efficiency"), "sheet.0.name"),
        ("pair", put("advice.0.frames", 0), "advice.0.frames"),
        ("agree", put("limits.0.frames", 0), "limits.0.frames"),
        # What a schema cannot say.
        ("four", put("effects.1.name", "saturation"), "holds one twice"),
        ("one", put("effects.0.candidates", ["saturation", "smear"]), "itself and its rivals"),
        ("pair", put("effects.0.evidence.weight", 0.5), "do not add up to 1"),
        ("pair", put("status", "named"), "rivals remain"),
        ("one", put("status", "ambiguous"), "rivals are missing"),
        ("one", put("status", "consistent"), "consistent with effects"),
        ("one", put("status", "not_converged"), "not_converged with effects"),
        ("unknown", put("status", "named"), "named without effects"),
        ("light", put("light", None), "light: described without"),
        ("not assessed", put("not_assessed", []), "without a reason"),
        ("not converged", put("not_assessed", []), "without a reason"),
    ],
)
def test_what_breaks_the_contract_is_not_written(kind, change, words, tmp_path):
    """The message says where; the file stays as it was."""
    document = whole(kind)
    change(document)
    path = tmp_path / "verdict.json"
    path.write_text("before", encoding="utf-8")
    with pytest.raises(ContractError, match=r"verdict\.json: .*") as caught:
        write_verdict(document, path)
    assert words in str(caught.value)
    assert path.read_text(encoding="utf-8") == "before"
