"""Outcomes, scores and pages of records made by hand."""

import numpy as np
import pytest

from rig import hidden
from tests.validation import figure, intervals, outcome, page, picture, score

BASE = {"p1": 4.0, "p2": 50.0, "sigma_px": [15.0, 20.0], "peak_dn": 600.0, "top_hat": False, "bit_depth": 10,
        "photon_budget": "linear"}  # fmt: skip


def effect(name, snr=300.0, parameters=None, form=None, **more):
    """One effect of a truth file."""
    return {"name": name, "snr": snr, "parameters": parameters or {"q": 0.1}, "form": form or {}, **more}


def record(kind, sets=(), status=None, p=0.5, effects=None, **more):
    """A record of a kind, with the sets of names that the verdict holds possible, best first."""
    names = [] if kind.split(":")[0] in ("none", "outside", kind) else kind.split(":")[1].split("+")
    effects = [effect(n) for n in names] if effects is None else effects
    truth = {"effects": effects, "base": dict(BASE), "snr": 300.0, "limit": 30.0}
    status = status or ("named" if len(sets) == 1 else "ambiguous" if sets else "consistent")
    first = sets[0] if sets else ()
    given = [
        {"name": n, "candidates": [n, *(o for own in sets[1:] for o in own if o not in first)], "parameters": {}}
        for n in first
    ]
    verdict = {"status": status, "detection": {"p_value": p}, "effects": given,
               "gap": {"closed": 0.99 if sets else None}}  # fmt: skip
    job = {"number": 0, "seed": 5_000_000, "kind": kind, "design": "default", "budget": ""}
    own = {"job": job, "truth": truth, "verdict": verdict, "seconds": None}
    return own | {"outcome": outcome.word_for(own)} | more


def one(name, sets, status=None, **more):
    """A strong single effect and its verdict."""
    return record(f"one:{name}:strong", sets, status, p=0.001, **more)


def broken(kind):
    """A record of an exception before anything was known."""
    job = {"number": 0, "seed": 5_000_000, "kind": kind, "design": "default", "budget": ""}
    return {"job": job, "outcome": "error", "error": "ValueError: no", "truth": None, "verdict": None}


def found(rows, name):
    """The figure whose name begins so."""
    return next(f for f in score.figures(rows) if f.name.startswith(name))


# What becomes of a data set


@pytest.mark.parametrize(
    "kind, sets, status, expected",
    [
        ("none", [], None, "right"),
        ("none", [], "unknown", "unknown"),
        ("none", [["smear"]], None, "wrong"),
        ("none", [], "not_assessed", "wrong"),
        ("one:smear:strong", [["smear"]], None, "right"),
        ("one:smear:strong", [["smear"]], "named_more_remains", "right"),
        ("one:smear:strong", [["speckle"], ["smear"]], None, "tied"),
        ("one:smear:strong", [["speckle"], ["row_noise"]], None, "wrong"),
        ("one:smear:strong", [["smear", "speckle"]], None, "wrong"),
        ("one:smear:strong", [], None, "unseen"),
        ("one:smear:strong", [], "not_assessed", "unknown"),
        ("two:smear+speckle:strong", [["speckle", "smear"]], None, "right"),
        ("two:smear+speckle:strong", [], "unknown", "unknown"),
        ("outside:donut:strong", [], "unknown", "right"),
        ("outside:donut:strong", [], None, "unseen"),
        ("outside:donut:strong", [["super_gaussian"]], None, "wrong"),
        ("outside:donut:strong", [["beam_profile"]], None, "right"),
        ("outside:donut:strong", [], "not_assessed", "wrong"),
        ("real", [["smear"]], None, "open"),
        ("real:smear", [["smear"]], None, "right"),
        ("real:smear", [], "unknown", "unknown"),
    ],
)
def test_what_becomes_of_a_set(kind, sets, status, expected):
    own = record(kind, sets, status)
    assert own["outcome"] == expected
    assert bool(outcome.line(own)) == (expected not in ("right", "open"))


def test_sets_are_counted_by_what_was_hidden():
    rows = [record("none"), record("none", [["smear"]]), one("smear", [["smear"]]), broken("one:smear:strong"),
            record("none") | {"outcome": "passed over"}]  # fmt: skip
    assert outcome.by_kind(rows) == [("none", "2", "1", "0", "0", "0", "1", "0"), ("one", "2", "1", *"0000", "1")]


# Scores


def test_right_answers_are_right():
    right = one("smear", [["smear"]])
    assert outcome.named_exactly(right) and outcome.right_first(right) and outcome.among_candidates(right)
    assert outcome.line(right) == ""
    unsure = one("smear", [["nonlinearity"], ["smear"]])
    assert outcome.ambiguous_with_truth(unsure) and outcome.among_candidates(unsure)
    assert not outcome.right_first(unsure) and not outcome.named_exactly(unsure)
    assert outcome.no_wrong_name(record("outside:coma:strong", status="unknown"))
    assert outcome.named_exactly(record("two:smear+speckle:strong", [["speckle", "smear"]]))


@pytest.mark.parametrize(
    "wrong",
    [
        one("smear", [["nonlinearity"]]),
        one("smear", [["smear", "speckle"]]),
        one("smear", [["smear"]], status="unknown"),
        one("smear", [["smear"], ["speckle"]]),
        one("smear", []),
        broken("one:smear:strong"),
    ],
)
def test_other_answers_are_not_that_one_name(wrong):
    assert not outcome.named_exactly(wrong)
    assert wrong["verdict"] is None or outcome.first_name(wrong) == "smear" or not outcome.right_first(wrong)


@pytest.mark.parametrize(
    "wrong",
    [
        record("outside:coma:strong", [["super_gaussian"]]),
        record("outside:coma:strong", [["beam_profile", "smear"]], status="named_more_remains"),
        broken("outside:coma:strong"),
    ],
)
def test_an_unknown_effect_must_not_have_a_listed_name(wrong):
    assert not outcome.no_wrong_name(wrong) and outcome.line(wrong)
    assert found([wrong], "outside").value == 0


def test_two_effects_need_both_names_and_no_more():
    kind = "two:smear+speckle:strong"
    rows = [record(kind, own) for own in ([["smear"]], [["smear", "speckle", "row_noise"]], [["smear", "row_noise"]])]
    rows += [
        record(kind, [["smear", "speckle"], ["smear", "row_noise"]]),
        record(kind, [["smear", "speckle"]]),
        broken(kind),
    ]
    figure_ = found(rows, "two effects")
    assert figure_.value == pytest.approx(1 / 6) and figure_.verdict() == "short"
    # A tie that holds the truth says nothing wrong.
    assert found(rows, "two effects: both named, or").value == pytest.approx(2 / 6)


def test_ambiguous_must_hold_the_truth():
    rows = [
        one("spread_law", own) for own in ([["row_noise"], ["smear"]], [["spread_law"]], [["smear"], ["spread_law"]])
    ]
    for own in rows:
        own["truth"]["base"]["photon_budget"] = "spot_area"
    assert found(rows, "strong, tied in its design").value == pytest.approx(1 / 3)
    assert found(rows, "strong, not tied").sets == 0
    assert found([*rows, broken("one:smear:strong")], "strong, not tied").value == 0


def test_a_simpler_effect_may_stand_for_one_that_cannot_be_told_from_it():
    for beyond, right in ((2.0, True), (30.0, False)):
        hidden_one = [effect("background_gradient", snr_beyond={"dark_offset": beyond})]
        said = record("one:background_gradient:strong", [["dark_offset"]], p=0.001, effects=hidden_one)
        assert outcome.right_first(said) is right and outcome.ambiguous_with_truth(said) is right


def test_ties_of_the_contract_count_where_they_occur():
    law = one("spread_law", [["spread_law"]])
    assert not outcome.tied(law)
    law["truth"]["base"]["photon_budget"] = "spot_area"
    assert outcome.tied(law)
    lone = record("one:beam_ellipticity:strong")
    assert not outcome.tied(lone)
    lone["job"]["design"] = "one_exposure"
    assert outcome.tied(lone)


def test_false_alarms_count_failures_and_need_enough_sets():
    rows = [record("none", p=0.001 if k % 100 == 0 else 0.4) for k in range(2000)]
    for k, row in enumerate(rows):
        row["job"]["design"] = hidden.DESIGNS[k % 4]
        row["truth"]["base"] |= {"peak_dn": 300.0 + k % 97, "sigma_px": [14 + k % 89 / 10]}
    overall = found(rows, "false alarms at")
    assert overall.value == 0.01 and overall.verdict() == "ok, aim"
    assert "too few" in found(rows[:500], "false alarms at").verdict()
    assert found(rows, "false alarms, worst tenth of width").verdict().startswith("ok")
    for row in rows[::20]:
        row["verdict"] = None
    assert found(rows, "false alarms at").verdict() == "short"
    # One design that is never right hides in no average.
    for row in rows:
        row["verdict"] = {"status": "consistent", "detection": {"p_value": 0.4}}
        row["verdict"]["detection"]["p_value"] = 0.001 if row["job"]["design"] == "default" else 0.4
    worst = found(rows, "false alarms, worst design")
    assert worst.note == "default" and worst.verdict() == "short"


def test_null_sets_by_tenths_of_width():
    rows = [record("none", p=0.4) for _ in range(1000)]
    for k, row in enumerate(rows):
        row["truth"]["base"]["sigma_px"] = [10 + k / 50]
        row["verdict"]["detection"]["p_value"] = 0.001 if k >= 900 and k % 5 == 0 else 0.4
    worst = found(rows, "false alarms, worst tenth of width")
    assert worst.value == pytest.approx(0.2) and worst.verdict() == "short" and worst.note.startswith("28")


def test_the_worst_effect_passes_by_its_upper_limit():
    rows = [one(name, [[name]]) for name in hidden.EFFECTS for _ in range(50)]
    for k in range(5):
        rows[k] = one(hidden.EFFECTS[0], [["smear"]])
    worst = found(rows, "the same, worst effect")
    assert worst.note == hidden.EFFECTS[0] and worst.value == 0.9 and worst.verdict() == "ok, aim"
    for k in range(12):
        rows[k] = one(hidden.EFFECTS[0], [["smear"]])
    assert found(rows, "the same, worst effect").verdict() == "short"
    assert "too few" in found(rows[50:], "the same, worst effect").verdict()


def test_gap_and_strength():
    good = one("nonlinearity", [["nonlinearity"]])
    good["verdict"]["effects"][0]["parameters"] = {"q": {"value": 0.103, "stderr": 0.002, "unit": "1"}}
    assert outcome.closed_share(good) == pytest.approx(0.99)
    assert outcome.strength_error(good) == pytest.approx(1.5)
    missed = one("nonlinearity", [], status="unknown")
    assert outcome.closed_share(missed) == 0.0 and outcome.strength_error(missed) is None
    soft = one("saturation", [["saturation"]], effects=[effect("saturation", form={"knee": "soft"})])
    assert not outcome.of_contract(soft["truth"]["effects"][0])
    rows = [good, missed]
    assert found(rows, "gap closed").value == pytest.approx(0.495)
    assert found(rows, "error of the strength").verdict() == "short"


def test_the_weakest_effect_at_ninety_percent():
    rng = np.random.default_rng(3)
    strength = np.exp(rng.uniform(-1.5, 2, 3000))
    chance = 1 / (1 + np.exp(-4 * (np.log(strength) - 0.2)))
    value, (low, high) = intervals.weakest(
        [(s, float(f)) for s, f in zip(strength, rng.random(3000) < chance, strict=True)]
    )
    expected = np.exp(0.2 + np.log(9) / 4)
    # Three standard errors, by repetition with other seeds.
    assert low < expected < high and value == pytest.approx(expected, rel=0.22)
    # A tenth found whatever its strength does not move the point.
    lucky = (rng.random(3000) < chance) | (rng.random(3000) < 0.1)
    assert intervals.weakest(list(zip(strength, lucky.astype(float), strict=True)))[0] == pytest.approx(
        expected, rel=0.22
    )
    assert np.isnan(intervals.weakest([(1.0, 1.0)] * 5)[0])
    assert intervals.weakest([(s, float(s > 1)) for s in np.geomspace(0.3, 3, 60)])[0] == pytest.approx(1.0, rel=0.15)


def test_intervals_of_shares_are_exact():
    assert intervals.clopper_pearson(0, 10) == pytest.approx((0.0, 0.3085), abs=1e-4)
    assert intervals.clopper_pearson(10, 10) == pytest.approx((0.6915, 1.0), abs=1e-4)
    assert intervals.clopper_pearson(5, 10) == pytest.approx((0.1871, 0.8129), abs=1e-4)
    assert figure.share("x", [], outcome.judged).verdict() == "not measured"


# Page, picture, records


def test_table_and_picture_of_mixed_records(tmp_path):
    rows = [record("none"), one("smear", [["smear"]]), one("smear", [["row_noise"]]), broken("one:saturation:strong"),
            record("outside:coma:strong", [["super_gaussian"]]), record("two:smear+speckle:strong", [["smear"]]),
            record("none") | {"outcome": "passed over"}]  # fmt: skip
    text = page.as_markdown(score.figures(rows), rows, "abc", 5_000_000)
    assert "| `smear` | 2 | 2 | 1/2 | 1/2 | 1/2 |" in text and "named super_gaussian 1" in text
    assert "ValueError: no" in text and text.startswith("# Scores on hidden effects\n\n6 sets")
    matrix = score.confusion(rows)
    assert matrix["smear"] == {"smear": 1, "row_noise": 1} and matrix["(coma)"] == {"super_gaussian": 1}
    assert matrix["saturation"] == {"error": 1} and matrix["none"] == {"consistent": 1}
    picture.draw(matrix, tmp_path / "blind.png")
    assert (tmp_path / "blind.png").stat().st_size > 10_000
    assert "short" in page.summary(score.figures(rows), rows)
