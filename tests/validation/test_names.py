"""The sets of the table of names: those on real light, and between them those of the suite before."""

import json
from itertools import islice

import pytest

from tests.validation.generators.names import before, generator


def test_every_sixth_set_is_one_of_the_suite_before():
    """The others are those of the plan on real light, with their own seeds."""
    jobs = list(islice(generator.jobs(1), 120))
    old = [job for job in jobs if job.kind.startswith("before:")]
    assert jobs[5::6] == old and len(old) == 20
    assert all(job.seed == 1 + job.number for job in jobs if job not in old)


def test_a_set_of_the_suite_before_is_the_rigs_and_knows_its_outcome(tmp_path):
    """The same frames as the rig makes of that seed, in an order that another seed changes."""
    jobs = before.jobs(3)
    assert len(jobs) == 3422 and jobs != before.jobs(4) and sorted(jobs) == sorted(before.jobs(4))
    job = next(job for job in jobs if job.design == "single_frame" and ":one:" in job.kind)
    folder, truth = tmp_path / "set", tmp_path / "truth.json"
    assert generator.write(job, folder, truth)
    known, own = json.loads(truth.read_text(encoding="utf-8")), before.rows()[job.seed]
    assert known["before"] == own["outcome"]
    assert [effect["name"] for effect in known["effects"]] == [effect["name"] for effect in own["truth"]["effects"]]
    assert known["base"]["peak_dn"] == pytest.approx(own["truth"]["base"]["peak_dn"], rel=1e-3)
