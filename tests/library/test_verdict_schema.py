"""verdict.json: what keeps the contract is written, byte for byte alike; what breaks it is not written at all."""

import json

import numpy as np
import pytest

from spotcheck.discrepancy.locate import where
from spotcheck.discrepancy.sentence import sentence
from spotcheck.discrepancy.verdict import parameters_of
from spotcheck.discrepancy.written import breach_of_verdict, rounded, write_verdict
from spotcheck.model.effects import vocabulary
from spotcheck.store import ContractError
from tests.library import small_verdict as small
from tests.library.test_sentence import ambiguous, verdict

STATUSES = ("consistent", "named", "ambiguous", "unknown", "not_assessed")


def whole(status: str) -> dict:
    """A verdict that keeps the contract."""
    own = ambiguous() if status == "ambiguous" else verdict(status)
    return own | {"sentence": sentence(own)}


@pytest.mark.parametrize("status", STATUSES)
def test_every_status_can_be_written(status, tmp_path):
    own = whole(status)
    assert breach_of_verdict(own) is None
    write_verdict(own, tmp_path / "verdict.json")
    assert json.loads((tmp_path / "verdict.json").read_text(encoding="utf-8")) == rounded(own)


@pytest.mark.parametrize("level", [319.6, 320.4])
def test_a_level_that_readings_round_is_known_to_a_number(level):
    """Readings that stop at code 332, 12 DN of it black level, tell of a level no more than that it lies from 319.5 to
    320.5 DN: its middle, and at least the 1/√12 DN of a number that lies anywhere in it."""
    late = small.present("saturation", level, 0.03, form="sharp with noise")
    found = small.judgement("named", small.plain, late, after=lambda image, rng: np.minimum(image, 332)).findings
    look, own = found.best
    own = own._replace(refit=own.refit._replace(model=own.refit.model._replace(present=(late,))))
    told = parameters_of(found._replace(best=(look, own)), "saturation")["level"]
    assert told["value"] == pytest.approx(320.0, abs=1e-9) and told["stderr"] >= 12**-0.5


def test_a_direction_lies_within_one_turn():
    """A fit may leave it any number of turns on; numbers of a file have nine digits."""
    own = small.judgement("named", small.ghost, small.present("beam_ellipticity", 1.05, 30.0 - 1000 * 360.0))
    assert 0 <= parameters_of(own.findings, "beam_ellipticity")["direction"]["value"] < 360


@pytest.mark.parametrize("status", ["named", "unknown", "not_assessed"])
def test_what_the_judgement_says_keeps_the_contract(status, tmp_path):
    """The stage's own dictionary, with table and sentence, as it is written."""
    if status == "not_assessed":
        own = small.nothing()
    else:
        effects = [small.present("ghost_reflection", 0.05, 11.0, -4.0)] if status == "named" else []
        own = small.judgement(status, small.ghost, *effects)
    found = small.verdict_of(own)
    if own.findings is not None:
        found["where"] = where(own.findings.look, own.findings.base, 0.01, own.findings.detection)
    found["sentence"] = sentence(found)
    write_verdict(found, tmp_path / "verdict.json")
    again = json.loads((tmp_path / "verdict.json").read_text(encoding="utf-8"))
    assert again["status"] == status
    if status == "named":
        assert again["effects"][0]["parameters"]["fraction"]["value"] == pytest.approx(0.06, rel=0.05)


def put(path: str, value):
    """A change: the value at a dotted path."""

    def change(own: dict) -> None:
        *parents, last = path.split(".")
        for key in parents:
            own = own[int(key)] if isinstance(own, list) else own[key]
        own[int(last) if isinstance(own, list) else last] = value

    return change


def drop(key: str):
    return lambda own: own.pop(key)


@pytest.mark.parametrize(
    ("status", "change", "words"),
    [
        ("named", drop("advice"), "'advice' is a required property"),
        ("named", put("extra", 1), "extra"),
        ("named", put("schema", 2), "schema"),
        ("named", put("status", "sure"), "status"),
        ("named", put("sentence", ""), "sentence"),
        ("named", put("detection.p_value", 0), "detection.p_value"),
        ("named", put("detection.p_value", 1.2), "detection.p_value"),
        ("named", put("detection.alpha", None), "detection.alpha"),
        ("named", put("detection.n_simulations", 3.5), "detection.n_simulations"),
        ("named", put("where.0.block", "edge"), "where.0.block"),
        ("named", put("where.0.bin.unit", ""), "where.0.bin.unit"),
        ("named", put("where.0.z", None), "where.0.z"),
        ("named", put("where.0.share", 1.4), "where.0.share"),
        ("named", put("effects.0.name", "coma"), "effects.0.name"),
        ("named", put("effects.0.parameters.fraction.stderr", -1.0), "stderr"),
        ("named", put("effects.0.parameters.fraction.value", float("nan")), "write null"),
        ("named", put("gap.after", float("inf")), "gap.after"),
        ("named", put("gap.on", "seen repeats"), "gap.on"),
        ("named", put("baseline_shift.p1.unit", None), "baseline_shift.p1.unit"),
        ("ambiguous", put("advice.0.frames", 0), "advice.0.frames"),
        ("ambiguous", put("advice.0.separates", ["a"]), "advice.0.separates"),
        ("ambiguous", put("explanations.1", ["coma"]), "explanations.1.0"),
        ("named", put("not_assessed.0.effect", "coma"), "not_assessed.0.effect"),
        # What no schema says.
        ("named", put("explanations", []), "the first is not effects"),
        ("named", put("explanations", [["scatter_halo"]]), "the first is not effects"),
        ("named", put("effects.0.candidates", ["scatter_halo"]), "its own candidates"),
        ("named", put("effects.0.candidates", ["ghost_reflection", "scatter_halo"]), "rivals remain"),
        ("named", put("explanations", [["ghost_reflection"], ["scatter_halo"]]), "rivals remain"),
        ("ambiguous", put("explanations", [["ghost_reflection"]]), "one explanation"),
        ("ambiguous", put("explanations.1", ["ghost_reflection"]), "stands twice"),
        ("named", put("status", "consistent"), "consistent with effects"),
        ("unknown", put("status", "named"), "without an effect"),
        ("not_assessed", put("not_assessed", []), "without a reason"),
    ],
)
def test_what_breaks_the_contract_is_not_written(status, change, words, tmp_path):
    """The message says where; what lay there stays as it was."""
    own = whole(status)
    change(own)
    path = tmp_path / "verdict.json"
    path.write_text("before", encoding="utf-8")
    with pytest.raises(ContractError, match=r"verdict\.json: .*") as caught:
        write_verdict(own, path)
    assert words in str(caught.value)
    assert path.read_text(encoding="utf-8") == "before" and {p.name for p in tmp_path.iterdir()} == {"verdict.json"}


def test_every_name_of_the_vocabulary_is_allowed():
    """Nothing has to be told to the schema when an effect is added."""
    for name in vocabulary():
        own = whole("named")
        own["effects"][0] |= {"name": name, "candidates": [name]}
        own["explanations"] = [[name]]
        own["not_assessed"] = [{"effect": name, "why": "as a test"}, {"effect": "all", "why": "as a test"}]
        assert breach_of_verdict(own) is None, name


def test_equal_verdicts_are_equal_files(tmp_path):
    """Numpy's numbers, tuples and digits beyond what is known change no byte."""
    one, two = whole("named"), whole("named")
    two["detection"]["n_simulations"] = np.int64(1500)
    two["gap"]["before"] = np.float64(28.0 * (1 + 1e-13))
    two["effects"] = tuple(two["effects"])
    for name, own in (("one", one), ("two", two)):
        write_verdict(own, tmp_path / name)
    text = (tmp_path / "one").read_bytes()
    assert text == (tmp_path / "two").read_bytes() and text.endswith(b"}\n")
    assert "±" in text.decode("utf-8")
    two["gap"]["before"] = 28.1
    write_verdict(two, tmp_path / "two")
    assert text != (tmp_path / "two").read_bytes()
