"""The blind suite's plan, scorer and table on records made by hand; and a small fixed run of the suite itself."""

import itertools
import json
from collections import Counter

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from rig import hidden
from spotcheck import provenance, store
from tests.blind import figure, intervals, limit, outcome, picture, power, records, score, table, times
from tests.blind.judge_case import BY_COMMAND, Nulls, compared, record_of
from tests.blind.plan import PUBLISHED, Job, plan

BASE = {"p1": 4.0, "p2": 50.0, "sigma_px": [15.0, 20.0], "peak_dn": 600.0, "top_hat": False, "bit_depth": 10,
        "photon_budget": "linear"}  # fmt: skip


def effect(name, snr=300.0, parameters=None, form=None, **more):
    """One effect of a truth file."""
    return {"name": name, "snr": snr, "parameters": parameters or {"q": 0.1}, "form": form or {}, **more}


def record(kind, sets=(), status=None, p=0.5, effects=None, **more):
    """A record of a kind, with the sets of names that the verdict holds possible, best first."""
    names = [] if kind == "none" or kind.startswith("outside") else kind.split(":")[1].split("+")
    truth = {"effects": [effect(n) for n in names] if effects is None else effects, "base": dict(BASE), "snr": 300.0}
    status = status or ("named" if len(sets) == 1 else "ambiguous" if sets else "consistent")
    first = sets[0] if sets else ()
    given = [
        {"name": n, "candidates": [n, *(o for own in sets[1:] for o in own if o not in first)], "parameters": {}}
        for n in first
    ]
    verdict = {"status": status, "detection": {"p_value": p}, "effects": given, "explanations": [list(s) for s in sets],
               "gap": {"closed": 0.99 if sets else None}}  # fmt: skip
    job = {"number": 0, "seed": 5_000_000, "kind": kind, "design": "default", "budget": ""}
    return {"job": job, "outcome": "judged", "truth": truth, "verdict": verdict, "told": None} | more


def one(name, sets, status=None, isolation=400.0, **more):
    """A strong single effect and its verdict; `isolation` of its nearest rival."""
    told = {"isolation": {"smear": isolation}, "closed": 1.0, "limit": 30.0}
    return record(f"one:{name}:strong", sets, status, p=0.001, told=told, **more)


def broken(kind):
    """A record of an exception before anything was known."""
    job = {"number": 0, "seed": 5_000_000, "kind": kind, "design": "default", "budget": ""}
    return {"job": job, "outcome": "error", "error": "ValueError: no", "truth": None, "verdict": None, "told": None}


def found(rows, name):
    """The figure whose name begins so."""
    return next(f for f in score.figures(rows) if f.name.startswith(name))


# The plan


def test_every_beginning_of_the_plan_is_balanced():
    jobs = list(itertools.islice(plan(), 6000))
    assert len({job.seed for job in jobs}) == len(jobs) and min(job.seed for job in jobs) == PUBLISHED
    assert all(hidden.possible(job.kind, job.design) for job in jobs)
    for end in (100, 600, 6000):
        kinds = Counter(job.kind.split(":")[0] for job in jobs[:end])
        assert abs(kinds["none"] / end - 0.48) < 0.02 and abs(kinds["outside"] / end - 0.07) < 0.02
    nulls = Counter(job.design for job in jobs if job.kind == "none")
    assert nulls.total() >= 2000 and min(nulls.values()) > 150 and len(nulls) >= 4
    strong = Counter(job.kind for job in jobs if job.kind.endswith(":strong") and job.kind.startswith("one"))
    assert set(strong) == {f"one:{name}:strong" for name in hidden.EFFECTS} and min(strong.values()) >= 65
    assert {job.kind for job in jobs[:250]} >= set(strong)
    outside = Counter(job.kind for job in jobs if job.kind.startswith("outside"))
    assert len(outside) == len(hidden.OUTSIDE)
    assert {job.design for job in jobs if job.kind.startswith("one")} == set(hidden.DESIGNS)
    assert next(plan(5, tuning=True)).seed == 5
    with pytest.raises(ValueError, match="used for tuning"):
        next(plan(5))


# Scores


def test_right_answers_are_right():
    right = one("smear", [["smear"]])
    assert outcome.named_exactly(right) and outcome.right_first(right) and outcome.among_candidates(right)
    assert outcome.isolable(right) and score.wrong(right) == ""
    unsure = one("smear", [["nonlinearity"], ["smear"]], isolation=4.0)
    assert outcome.ambiguous_with_truth(unsure) and outcome.among_candidates(unsure) and not outcome.isolable(unsure)
    assert not outcome.right_first(unsure) and not outcome.named_exactly(unsure)
    assert outcome.unknown_and_empty(record("outside:coma:strong", status="unknown"))
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
        record("outside:coma:strong", [["super_gaussian"]], status="unknown"),
        record("outside:coma:strong"),
        broken("outside:coma:strong"),
    ],
)
def test_an_unknown_effect_must_stay_without_a_name(wrong):
    assert not outcome.unknown_and_empty(wrong) and score.wrong(wrong)
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
        one("smear", own, isolation=2.0)
        for own in ([["row_noise"], ["speckle"]], [["smear"]], [["row_noise"], ["smear"]])
    ]
    assert found(rows, "strong, not isolable").value == pytest.approx(1 / 3)
    assert found(rows, "strong, isolable").sets == 0
    assert found([*rows, broken("one:smear:strong")], "strong, isolable").value == 0


def test_a_simpler_effect_may_stand_for_one_that_cannot_be_told_from_it():
    for beyond, right in ((2.0, True), (30.0, False)):
        hidden_one = [effect("background_gradient", snr_beyond={"dark_offset": beyond})]
        said = record("one:background_gradient:strong", [["dark_offset"]], p=0.001, effects=hidden_one)
        assert outcome.right_first(said) is right and outcome.ambiguous_with_truth(said) is right


def test_ties_of_the_contract_count_where_they_occur():
    """What the nearest rival says goes first; the contract's list where that was not computed."""
    tied = one("spread_law", [["spread_law"]])
    tied["truth"]["base"]["photon_budget"] = "spot_area"
    assert outcome.isolable(tied)
    assert outcome.isolable(one("smear", [["smear"]], isolation=24.0)) is False
    # A rival that is ahead, as a law is that has a number for every frame, leaves nothing to isolate.
    ahead = one("power_fluctuation", [["laser_drift"]], isolation=-30.0)
    assert outcome.isolable(ahead) is False and not outcome.ambiguous_with_truth(ahead)
    # A model that was told the truth and missed it says nothing of rivals, nor of the gap.
    lost = one("smear", [["smear"]], isolation=0.0)
    lost["told"]["closed"] = 1e-14
    assert outcome.isolable(lost) is None and outcome.closed_share(lost) is None
    tied["told"] = None
    assert outcome.isolable(tied) is False
    lone = record("one:beam_ellipticity:strong")
    assert outcome.isolable(lone) is None
    lone["job"]["design"] = "one_exposure"
    assert outcome.isolable(lone) is False


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
        row["outcome"] = "error"
    assert found(rows, "false alarms at").verdict() == "short"
    # One design that is never right hides in no average.
    for row in rows:
        row["outcome"] = "judged"
        row["verdict"]["detection"]["p_value"] = 0.001 if row["job"]["design"] == "default" and row["job"] else 0.4
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


def test_gap_and_strength_are_held_against_a_model_told_the_truth():
    good = one("nonlinearity", [["nonlinearity"]])
    good["told"] |= {"parameters": {"nonlinearity": {"q": {"value": 0.1, "stderr": 0.002, "unit": "1"}}}}
    good["verdict"]["effects"][0]["parameters"] = {"q": {"value": 0.103, "stderr": 0.002, "unit": "1"}}
    assert outcome.closed_share(good) == pytest.approx(0.99)
    assert outcome.strength_error(good) == pytest.approx(1.5)
    missed = one("nonlinearity", [], status="unknown")
    assert outcome.closed_share(missed) == 0.0 and outcome.strength_error(missed) is None
    soft = one("saturation", [["saturation"]], effects=[effect("saturation", form={"knee": "soft"})])
    assert not outcome.of_contract(soft["truth"]["effects"][0])
    rows = [good, missed]
    assert found(rows, "gap closed").value == pytest.approx(0.495)
    assert found(rows, "strength error").verdict() == "short"


def test_the_weakest_effect_at_ninety_percent():
    rng = np.random.default_rng(3)
    strength = np.exp(rng.uniform(-1.5, 2, 3000))
    chance = 1 / (1 + np.exp(-4 * (np.log(strength) - 0.2)))
    value, (low, high) = power.weakest(
        [(s, float(f)) for s, f in zip(strength, rng.random(3000) < chance, strict=True)]
    )
    expected = np.exp(0.2 + np.log(9) / 4)
    # Three standard errors, by repetition with other seeds.
    assert low < expected < high and value == pytest.approx(expected, rel=0.22)
    # A tenth found whatever its strength does not move the point.
    lucky = (rng.random(3000) < chance) | (rng.random(3000) < 0.1)
    assert power.weakest(list(zip(strength, lucky.astype(float), strict=True)))[0] == pytest.approx(expected, rel=0.22)
    assert np.isnan(power.weakest([(1.0, 1.0)] * 5)[0])
    assert power.weakest([(s, float(s > 1)) for s in np.geomspace(0.3, 3, 60)])[0] == pytest.approx(1.0, rel=0.15)


def test_no_test_finds_hot_pixels_without_their_places():
    """A single pixel has one place: there the most powerful test asks whether its reading passes a level, and the part
    of the heights that do is known. Among many, more is needed, and nothing is found of what is not there."""
    heights = np.linspace(0.3, 2.0, 2001)
    for scale in (1.5, 2.5):
        expected = stats.norm.cdf(scale * heights - stats.norm.isf(0.01)).mean()
        # The level is that of 40 draws in 4000, known to 0.06: up to 0.02 of the power; three times that.
        assert limit.power_of_hot(scale, 1, 1) == pytest.approx(expected, abs=0.06)
    powers = [limit.power_of_hot(scale, 50, 57_600) for scale in (1e-3, 1.0, 1.6, 2.3)]
    # At most 1 % by chance, four standard errors of 4000 draws.
    assert powers[0] < 0.01 + 4 * np.sqrt(0.01 / 4000) and np.all(np.diff(powers) > 0) and powers[-1] > 0.98


def test_intervals_of_shares_are_exact():
    assert intervals.clopper_pearson(0, 10) == pytest.approx((0.0, 0.3085), abs=1e-4)
    assert intervals.clopper_pearson(10, 10) == pytest.approx((0.6915, 1.0), abs=1e-4)
    assert intervals.clopper_pearson(5, 10) == pytest.approx((0.1871, 0.8129), abs=1e-4)
    assert figure.share("x", [], outcome.judged).verdict() == "not measured"


# Table, picture, records


def test_table_and_picture_of_mixed_records(tmp_path):
    rows = [record("none"), one("smear", [["smear"]]), one("smear", [["row_noise"]]), broken("one:saturation:strong"),
            record("outside:coma:strong", [["super_gaussian"]]), record("two:smear+speckle:strong", [["smear"]]),
            record("none") | {"outcome": "passed over"}]  # fmt: skip
    text = table.as_markdown(score.figures(rows), rows, "abc", PUBLISHED)
    assert "| `smear` | 2 | 2 | 1/2 | 1/2 | 1/2 |" in text and "named super_gaussian 1" in text
    assert "ValueError: no" in text and text.startswith("# Blind suite\n\n6 sets")
    matrix = score.confusion(rows)
    assert matrix["smear"] == {"smear": 1, "row_noise": 1} and matrix["(coma)"] == {"super_gaussian": 1}
    assert matrix["saturation"] == {"error": 1} and matrix["none"] == {"consistent": 1}
    picture.draw(matrix, tmp_path / "blind.png")
    assert (tmp_path / "blind.png").stat().st_size > 10_000
    assert "short" in table.summary(score.figures(rows), rows)


def test_records_outlive_a_crash(tmp_path):
    path = tmp_path / "new" / "jobs.jsonl"
    assert records.read(path) == []
    writer = records.Writer(path)
    writer.add({"a": 1})
    writer.close()
    path.write_text(path.read_text() + '{"a": 2, "b"')
    writer = records.Writer(path)
    writer.add({"a": 3})
    writer.close()
    assert records.read(path) == [{"a": 1}, {"a": 3}]
    with pytest.raises(ValueError):
        records.Writer(path).add({"a": float("nan")})


def test_a_clone_goes_on_from_what_is_published(tmp_path, monkeypatch):
    """With the records of the same commit alone, and with null laws of any, while the code that made them stands."""
    monkeypatch.setattr(records, "KEPT", tmp_path / "published")
    assert records.published() is None
    code = provenance.code_digest("spotcheck.discrepancy.calibration")
    for name, row in (("old", {"a": 1}), ("new", {"a": 2})):
        path = records.begin(tmp_path / name)
        writer = records.Writer(path)
        writer.add(row)
        writer.close()
        (tmp_path / name / "times.json").write_text("{}")
        for law, made_by in ((name, code), (f"{name} code", "another")):
            law_path = tmp_path / name / records.LAWS / law / "null.nc"
            law_path.parent.mkdir(parents=True)
            store.write(xr.Dataset(attrs={"title": "a law", "dataset": "none"}), law_path, code=made_by)
        records.keep(tmp_path / name)
    assert records.published() == tmp_path / "published" / "new"
    for name, rows in (("new", [{"a": 2}]), ("old", [])):
        cloned = tmp_path / "clone" / name
        assert records.read(records.begin(cloned)) == rows and (cloned / "times.json").exists() == bool(rows)
        assert {path.parent.name for path in cloned.rglob("null.nc")} == {"old", "new"}


def test_the_published_scores_follow_from_their_records():
    kept = records.published()
    assert kept is not None
    rows = records.read(kept / "jobs.jsonl.xz")
    figures = [*score.figures(rows), *times.figures(kept)]
    base = records.base_of(rows)
    assert {row["job"]["seed"] for row in rows} <= {job.seed for job in itertools.islice(plan(base), 20_000)}
    page = (records.ROOT / "workflow/docs/blind.md").read_text(encoding="utf-8")
    assert page == table.as_markdown(figures, rows, kept.name, base)


# A small fixed run

# All with 10 bit, a linear budget and no top hat: one null law serves them.
FIXED = [(2, "none"), (5, "none"), (1, "one:smear:strong"), (3, "one:super_gaussian:strong"),
         (5, "one:dark_offset:strong"), (8, "outside:coma:strong")]  # fmt: skip


@pytest.mark.slow
def test_a_small_fixed_run(tmp_path):
    nulls = Nulls(tmp_path, 110)
    jobs = [Job(BY_COMMAND, seed, kind, "one_site") for seed, kind in FIXED]
    rows = [record_of(job, nulls.null_for) for job in jobs]
    assert [(row["outcome"], row.get("error"), row.get("told_error")) for row in rows] == [("judged", None, "")] * 6
    json.dumps(rows, allow_nan=False)
    assert not any(map(outcome.alarm, rows[:2])) and all(map(outcome.detected, rows[2:]))
    assert all(map(outcome.among_candidates, rows[2:5])), [score.wrong(row) for row in rows]
    assert outcome.unknown_and_empty(rows[5]), score.wrong(rows[5])
    assert all(row["told"]["isolation"] for row in rows[2:5])
    assert table.as_markdown(score.figures(rows), rows, "fixed", 2).count("\n| ") > 50
    # What a folder, TIFF and the command line make of it.
    assert not compared(rows[2], nulls)["command"]["differences"]
