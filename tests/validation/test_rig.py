"""The rig's plan and limits, and a small fixed run through the judge."""

import json
from collections import Counter
from itertools import islice

import numpy as np
import pytest
from scipy import stats

from rig import hidden
from spotcheck import dataset
from tests.validation import judge, outcome, page, records, score
from tests.validation.generators.rig import generator, limit
from tests.validation.protocol import Job


def test_every_beginning_of_the_plan_is_balanced():
    jobs = list(islice(generator.jobs(generator.FIRST), 6000))
    assert len({job.seed for job in jobs}) == len(jobs) and min(job.seed for job in jobs) == generator.FIRST
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


def test_a_data_set_of_the_rig_is_a_folder_and_a_truth(tmp_path):
    """The photon budget that a job asks for is in the data sheet; sensors of 12 bit are passed over in other designs
    than the default; how strong a single effect must be to be found is in the truth."""
    jobs = [Job(0, 2, "none", "one_site", "free"), Job(1, 1, "one:smear:strong", "one_site")]
    for job in jobs:
        folder, truth = tmp_path / f"{job.seed}", tmp_path / f"{job.seed}.json"
        assert generator.write(job, folder, truth)
        known = json.loads(truth.read_text(encoding="utf-8"))
        assert ("limit" in known) == bool(known["effects"])
        found = dataset.load(str(folder))
        assert len(found.spots) == 3 and found.instrument.model.photon_budget == (job.budget or "linear")
    bits = {seed: hidden.draw_case(seed, "none", "one_site").instrument["sensor"]["bit_depth"] for seed in range(8)}
    assert set(bits.values()) == {10, 12}
    for seed, own in bits.items():
        job = Job(0, seed, "none", "one_site")
        assert generator.write(job, tmp_path / f"bits{seed}", tmp_path / "truth.json") == (own == 10)


# All with 10 bit, a linear budget and no top hat.
FIXED = [(2, "none"), (5, "none"), (1, "one:smear:strong"), (3, "one:super_gaussian:strong"),
         (5, "one:dark_offset:strong"), (8, "outside:coma:strong")]  # fmt: skip


@pytest.mark.slow
def test_a_small_fixed_run():
    """From a job to a record and a page."""
    jobs = [Job(k, seed, kind, "one_site") for k, (seed, kind) in enumerate(FIXED)]
    rows = [judge.record_of("rig", job) for job in jobs]
    assert [row["outcome"] for row in rows] == ["right"] * 6, [outcome.line(row) for row in rows]
    assert not any(map(outcome.alarm, rows[:2])) and all(map(outcome.detected, rows[2:]))
    assert outcome.no_wrong_name(rows[5]), outcome.line(rows[5])
    # A machine's times, rounded once or twice, may differ in the last digit.
    rows = [row | {"seconds": 2.0 + k} for k, row in enumerate(rows)]
    text = page.as_markdown(score.figures(rows), rows, "fixed", 2)
    assert text.count("\n| ") > 50
    # What is published of records gives the same scores.
    kept = [json.loads(json.dumps(records.reduced(row), allow_nan=False)) for row in rows]
    assert page.as_markdown(score.figures(kept), kept, "fixed", 2) == text


def test_an_exception_is_an_outcome(monkeypatch):
    """The record says what went wrong and where."""
    job = Job(0, 2, "none", "one_site")

    def broken(*_, **__):
        raise ValueError("no")

    monkeypatch.setattr(judge, "verdict_of", broken)
    own = judge.record_of("rig", job)
    assert own["outcome"] == "error" and own["error"].startswith("ValueError: no (test_rig.py:")
    assert own["verdict"] is None and own["truth"]["seed"] == 2
