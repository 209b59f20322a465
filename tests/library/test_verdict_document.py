"""verdict.json, version 3: every status keeps the contract, and its numbers mean what they say."""

import json
from collections import namedtuple

import numpy as np
import pytest

from spotcheck.old_engine import criteria
from spotcheck.old_engine.conclude.judgement import TIED_WITH_SHAPE, Limit
from spotcheck.old_engine.model.effect import Parameter
from spotcheck.old_engine.model.effects import built_in
from spotcheck.old_engine.search.holds import Holding
from spotcheck.old_engine.verdict.document import LIGHT, NOT_FORETOLD, document, limit_row, weights_of
from spotcheck.old_engine.verdict.sentence import sentence
from spotcheck.old_engine.verdict.words import limits_text
from spotcheck.old_engine.verdict.written import breach_of_verdict, rounded, write_verdict
from spotcheck.schema import read_schema
from spotcheck.store import ContractError
from tests.library.judgements import (
    BEND,
    CLIP,
    GHOST,
    JUDGEMENTS,
    WORDS,
    closed,
    detected,
    found,
    judged,
    learned,
    left,
    off,
)
from tests.validation.generators.light import score


def whole(kind: str) -> dict:
    """A verdict with its sentence."""
    own = document(JUDGEMENTS[kind][1], "small", light_words=WORDS)
    return own | {"sentence": sentence(own)}


def only(judgement) -> dict:
    """The one effect of a verdict."""
    (effect,) = document(judgement, "small")["effects"]
    return effect


@pytest.mark.parametrize("kind", JUDGEMENTS)
def test_every_kind_of_judgement_keeps_the_contract(kind, tmp_path):
    status, _ = JUDGEMENTS[kind]
    own = whole(kind)
    assert own["status"] == status
    assert breach_of_verdict(own) is None
    write_verdict(own, tmp_path / "verdict.json")
    assert json.loads((tmp_path / "verdict.json").read_text(encoding="utf-8")) == rounded(own)


def test_every_status_is_there():
    assert {status for status, _ in JUDGEMENTS.values()} == set(read_schema("verdict")["properties"]["status"]["enum"])


# Status


def test_more_remains_only_where_its_error_leaves_no_doubt():
    """Left: 0.4 % of the peak where 0.2 % is let pass. Its power, 1.6e-5, is certain with an error of 1e-6; with one of
    5e-6 it might be within three errors of nothing."""
    statuses = [
        document(off(found=(BEND,), unexplained=left(size, error)), "small")["status"]
        for size, error in ((0.004, 1e-6), (0.004, 5e-6), (0.0019, 1e-9), (0.0021, 1e-9), (0.004, np.inf))
    ]
    assert statuses == ["named_more_remains", "named", "named", "named_more_remains", "named"]


def test_alpha_and_tolerance_are_the_users():
    judgement = off(p=0.02, unexplained=left(0.004, 1e-7))
    assert document(judgement, "small", tolerance=0.01)["status"] == "consistent"
    assert document(judgement, "small", tolerance=0.01, alpha=0.05)["status"] == "unknown"
    own = document(judgement, "small")
    assert own["status"] == "unknown" and own["detection"]["alpha"] == 0.01 == criteria.ALPHA.value
    assert own["unexplained"]["tolerance"] == 0.002 == criteria.LEFT.value


def test_what_unseen_frames_do_not_bear_out_is_not_named():
    """It goes to the limits, once; another effect beside it stays."""
    own = document(off(found=(CLIP, BEND), beyond=("nonlinearity",)), "small")
    assert [effect["name"] for effect in own["effects"]] == ["saturation"] and own["status"] == "named"
    assert [(row["effect"], row["parameter"], row["high"], row["why"]) for row in own["limits"]] == [
        ("nonlinearity", "q", None, NOT_FORETOLD)
    ]


def test_nothing_was_tested_without_a_reason_given():
    own = document(judged(detection=None, unexplained=None), "small")
    assert own["status"] == "not_assessed" and own["not_assessed"][0]["effect"] == "all"


# Effects


def test_weights_add_up_to_one():
    """Odds of effects that fall behind by d in −2 ln L are exp(−d/2) to 1: 2 ln 3 and 2 ln 6 behind are 1/3 and 1/6."""
    weight = weights_of("a", {"b": 2 * np.log(3), "c": 2 * np.log(6)})
    assert weight == pytest.approx({"a": 2 / 3, "b": 2 / 9, "c": 1 / 9})
    assert weights_of("a", {}) == {"a": 1.0}
    assert sum(weights_of("a", {"b": 1e6, "c": -1e6}).values()) == pytest.approx(1.0)


@pytest.mark.parametrize("kind", JUDGEMENTS)
def test_candidates_stand_by_weight(kind):
    for own in whole(kind)["effects"]:
        weights = [own["evidence"]["weight"], *(rival["weight"] for rival in own["evidence"]["rivals"])]
        assert sum(weights) == pytest.approx(1.0) and weights == sorted(weights, reverse=True)
        assert own["candidates"] == [own["name"], *(rival["name"] for rival in own["evidence"]["rivals"])]


def test_evidence():
    """Of an effect that misses 40 in 24 cells with z = 30: (40 − 23)/900 of its z²."""
    holding = Holding(40.0, 24, 900.0, 0.001)
    evidence = only(off(found=(BEND._replace(holding=holding, gain=1234.5),)))["evidence"]
    assert evidence["gain"] == 1234.5 and evidence["z"] == pytest.approx(30.0)
    assert evidence["consistency"] == {"q": 40.0, "cells": 24, "excess": pytest.approx(17 / 900), "holds": True}


def test_parameters():
    """Constants of a form are left out, errors are the judgement's or the strength's alone, a direction lies within one
    turn."""
    assert set(only(off(found=(CLIP,)))["parameters"]) == {"level"}
    ghost = only(off(found=(GHOST,)))["parameters"]
    assert [own["stderr"] for own in ghost.values()] == [pytest.approx(0.000239), None, None]
    errors = {"ghost_reflection": (0.0004, 0.35, np.nan)}
    ghost = only(off(found=(GHOST,), errors=errors))["parameters"]
    assert [own["stderr"] for own in ghost.values()] == [0.0004, 0.35, None]
    assert [own["unit"] for own in ghost.values()] == ["1", "px", "px"]
    turned = only(off(found=(found("beam_ellipticity", 1.05, 30.0 - 1000 * 360.0),)))["parameters"]["direction"]
    assert turned["value"] == pytest.approx(30.0) and turned["unit"] == "deg"


@pytest.mark.parametrize("level", [319.6, 320.4])
def test_a_level_that_readings_round_is_known_to_a_number(level):
    """Readings that stop at code 332, 12 DN of it black level, tell no more of a level than that it lies from 319.5 to
    320.5 DN: its middle, with the 1/√12 DN of a number that lies anywhere in it. Not so where noise comes after."""
    late = found("saturation", level, 1.0, form="sharp with noise")
    errors = {"saturation": (0.03, np.nan)}
    told = only(off(found=(late,), errors=errors, black_level_dn=12.0))["parameters"]["level"]
    assert told["value"] == pytest.approx(320.0, abs=1e-9)
    assert told["stderr"] == pytest.approx(np.hypot(0.03, 12**-0.5))
    early = found("saturation", level, 1.0, form="sharp")
    told = only(off(found=(early,), errors=errors, black_level_dn=12.0))["parameters"]["level"]
    assert (told["value"], told["stderr"]) == (level, 0.03)


def test_the_light_is_an_effect_in_the_order_of_what_closes():
    """First, second or alone; first where nobody knows."""
    order = {
        share: [own["name"] for own in document(
            off(light=learned(), found=(CLIP, BEND), gap=closed(share, saturation=0.5, nonlinearity=0.1)), "small"
        )["effects"]]
        for share in (0.9, 0.3, 0.01)
    }  # fmt: skip
    assert order == {
        0.9: [LIGHT, "saturation", "nonlinearity"],
        0.3: ["saturation", LIGHT, "nonlinearity"],
        0.01: ["saturation", "nonlinearity", LIGHT],
    }
    own = document(off(light=learned(), found=(CLIP,)), "small")
    assert own["effects"][0]["name"] == LIGHT and own["effects"][0]["gap_closed"] is None
    parameters = own["effects"][0]["parameters"]
    assert parameters["power"] == {"value": 0.06, "stderr": 0.002, "unit": "1"} and parameters["order"]["value"] == 4
    assert own["effects"][0]["evidence"]["z"] == pytest.approx(30.0)
    assert own["light"]["axes"]["direction_deg"] == pytest.approx(35.0)


# The rest


def test_the_sheet_is_contradicted_beyond_three_stated_errors():
    own = whole("sheet")["sheet"]
    assert [(row["name"], row["contradicts"], row["unit"]) for row in own] == [
        ("gain_dn_per_e", True, "DN/e-"),
        ("read_noise_e", False, "e-"),
    ]
    assert own[0]["found"] == pytest.approx(own[0]["stated"] + own[0]["stated_errors"] * own[0]["stated_stderr"])


def test_what_is_left():
    """The error of a power e gives size + error = √(size² + e): for 0.4 % and (0.3 %)², 0.5 % − 0.4 %."""
    own = document(off(found=(BEND,), gap=closed(nonlinearity=0.9), unexplained=left(0.004, 9e-6),
                       rest=detected(0.04)), "small")  # fmt: skip
    assert own["unexplained"] == {"size": 0.004, "error": pytest.approx(0.001), "z": pytest.approx(16 / 9),
                                  "tolerance": 0.002, "share": pytest.approx(0.1), "p_value": 0.04}  # fmt: skip
    unknown = document(off(found=(BEND,), unexplained=left(0.0, np.inf)), "small")["unexplained"]
    assert unknown["size"] is unknown["error"] is unknown["share"] is unknown["p_value"] is None


def test_no_probability_is_zero():
    own = document(judged(detection=detected(0.0)), "small")["detection"]
    assert 0 < own["p_value"] < 1e-200 and 0 < own["worst"]["p_value"] < 1e-200
    assert own["rms_residual_percent_of_peak"] == pytest.approx(0.03) and own["parts"] == 2


def put(path: str, value):
    """A change: the value at a dotted path."""

    def change(own: dict) -> None:
        *parents, last = path.split(".")
        for key in parents:
            own = own[int(key)] if isinstance(own, list) else own[key]
        own[int(last) if isinstance(own, list) else last] = value

    return change


@pytest.mark.parametrize(
    ("kind", "change", "words"),
    [
        ("one", lambda own: own.pop("limits"), "'limits' is a required property"),
        ("one", put("schema", 1), "schema"),
        ("one", put("status", "sure"), "status"),
        ("one", put("sentence", ""), "sentence"),
        ("one", put("detection.p_value", 0), "detection.p_value"),
        ("one", put("effects.0.name", "coma"), "effects.0.name"),
        ("one", put("effects.0.evidence.weight", 1.5), "weight"),
        ("one", put("effects.0.parameters.level.value", float("nan")), "write null"),
        ("light", put("light.power", 1.5), "light.power"),
        ("sheet", put("sheet.0.name", "quantum_efficiency"), "sheet.0.name"),
        ("tied", put("advice.0.frames", 0), "advice.0.frames"),
        # What no schema says.
        ("one", put("effects.0.candidates", ["saturation", "smear"]), "itself and its rivals"),
        ("tied", put("effects.0.evidence.weight", 0.5), "do not add up to 1"),
        ("tied", put("status", "named"), "rivals remain"),
        ("one", put("status", "ambiguous"), "rivals are missing"),
        ("one", put("status", "consistent"), "consistent with effects"),
        ("one", put("status", "unknown"), "unknown with effects"),
        ("stranger", put("status", "named"), "named without effects"),
        ("light", put("light", None), "light: described without"),
        ("untested", put("not_assessed", []), "without a reason"),
    ],
)
def test_what_breaks_the_contract_is_not_written(kind, change, words, tmp_path):
    """The message says where; what lay there stays as it was."""
    own = whole(kind)
    change(own)
    path = tmp_path / "verdict.json"
    path.write_text("before", encoding="utf-8")
    with pytest.raises(ContractError, match=r"verdict\.json: .*") as caught:
        write_verdict(own, path)
    assert words in str(caught.value)
    assert path.read_text(encoding="utf-8") == "before"


# Who reads it


def record(kind: str, *names: str, light: str = "gauss") -> dict:
    """A set of the table's with a verdict, in which effects were hidden."""
    effects = [
        {"name": name, "form": {}, "parameters": {"level": 520.0, "q": 0.11, "fraction": 0.024}, "tied": False}
        for name in names
    ]
    return {"verdict": whole(kind), "truth": {"light": {"kind": light}, "effects": effects}}


def test_the_table_reads_it():
    """Names, rivals, errors and ties, as tests/validation takes them."""
    assert score.exact(record("one", "saturation"))
    assert score.wrong(record("one", "smear")) == {"saturation"} and not score.exact(record("one", "smear"))
    assert score.certain(record("tied", "ghost_reflection")) == set()
    assert score.wrong(record("tied", "scatter_halo")) == set()
    assert score.pulls(record("two", "nonlinearity"))["nonlinearity.q"] == pytest.approx((0.112 - 0.11) / 0.00112)
    assert score.says_tied(record("light", "beam_ellipticity", light="real"))
    own = record("stranger", "smear")
    own["verdict"]["limits"] = [limit_row(Limit("smear", "fraction", "1", TIED_WITH_SHAPE), judged())]
    assert score.says_tied(own) and not score.says_tied(record("agreed", "smear"))
    assert not score.says_tied(record("one", "saturation"))
    assert score.wrong(record("light", light="real")) == set() and score.wrong(record("light")) == {LIGHT}
    figures = score.of_nulls([record("agreed")], [])
    assert [own.value for own in figures if own.name.startswith("null sets: false")] == [0.0]


LIMITS = {
    "smear": (Limit("smear", "fraction", "1", "not found", high=0.000444, times=4.0),
              "light smeared along columns below 0.044 %", 54, ""),
    "bend": (Limit("nonlinearity", "q", "1", "not found", low=-0.0123, high=0.004, times=np.inf, more="no"),
             "bend of the response from −1.2 % to 0.4 %", None, "no"),
    "clip": (Limit("saturation", "level", "DN", "not found", low=930.0), "no clip below 930 DN", None, ""),
    "untold": (Limit("speckle", "contrast", "1", "these frames do not tell"), "", None, ""),
}  # fmt: skip


@pytest.mark.parametrize("kind", LIMITS)
def test_a_limit_in_words(kind):
    """By the effect's own noun; and frames more, of 18, that halve it."""
    own, words, frames, more = LIMITS[kind]
    fits = namedtuple("Fits", "shots")((None,) * 18)
    row = limit_row(own, judged()._replace(fits=fits))
    assert (row["words"], row["frames"], row["more"]) == (words, frames, more)
    told = words + " (95 %)" if words else own.why
    after = "; 54 more frames would halve that" if frames else f"; {more}" if more else ""
    assert limits_text({"limits": [row]}) == [f"{own.effect}: {told}{after}"]


@pytest.mark.parametrize("name", built_in())
def test_every_effect_has_words_for_its_limit(name):
    """A noun of its own in its file, which is not its name; and something to say of every end that it may have."""
    effect = built_in()[name]
    assert effect.noun and effect.noun != name and effect.noun[0].islower() and not effect.noun.endswith(".")
    assert [own.noun for own in built_in().values()].count(effect.noun) == 1
    ends = ("1 DN", "") if np.isinf(effect.neutral) else ("", "2 DN")
    assert effect.size_text(*ends).endswith("below 1 DN" if ends[0] else "below 2 DN")
    assert effect.size_text("", "") == ""
    assert "q of mine" in effect._replace(noun="", name="mine", neutral=0.0, parameters=(Parameter("q", "1", 0, 1),)
                                          ).size_text("", "2")  # fmt: skip
