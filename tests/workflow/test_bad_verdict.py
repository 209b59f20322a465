"""Folders of frames that hold nothing to judge: the workflow ends well, and verdict and report say why."""

import json

import pytest

from tests.conftest import snakemake
from tests.discrepancy.test_bad_cases import CASES, written

pytestmark = pytest.mark.slow


SATURATED = "none of 12 spot frames can be used (hardly a pixel of the crop reads below full scale)"
NO_SPOT = "the manifest names no frame of kind spot"


@pytest.mark.parametrize(("name", "why"), [("saturated everywhere", SATURATED), ("flats and darks alone", NO_SPOT)])
def test_nothing_to_judge(name, why, tmp_path):
    """Exit status 0, `not_assessed`, and the reason in both places."""
    where = {"dataset": written(CASES[name](), tmp_path), "results": tmp_path / "results"}
    run = snakemake("--until", "report", config=where)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "Traceback" not in run.stdout + run.stderr
    results = tmp_path / "results" / "set"
    verdict = json.loads((results / "verdict.json").read_text(encoding="utf-8"))
    assert verdict["status"] == "not_assessed" and why in verdict["sentence"]
    assert why in (results / "report.html").read_text(encoding="utf-8")
