"""Which datasets a run is of: one, or many in one call; and what planning leaves behind."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.conftest import ROOT, planned, snakemake

SAMPLE = ROOT / "data" / "zscan-sample"


def plan(datasets: list[Path], results: Path, *targets: str) -> subprocess.CompletedProcess:
    """A dry run of many datasets."""
    names = json.dumps([str(own) for own in datasets])
    return snakemake("--dry-run", *targets, config={"datasets": names, "results": results})


@pytest.fixture
def flats(tmp_path) -> Path:
    """A dataset with a flat and a dark and no spot; its frames are never decoded here."""
    folder = tmp_path / "flats"
    (folder / "frames").mkdir(parents=True)
    rows = "frames/flat.png,flat,,0.001,0\nframes/dark.png,dark,,0.001,0\n"
    (folder / "manifest.csv").write_text(f"file,kind,angle_deg,exposure_s,repeat\n{rows}")
    for name in ("flat", "dark"):
        shutil.copy(next((SAMPLE / "frames").iterdir()), folder / "frames" / f"{name}.png")
    return folder


def test_each_dataset_gets_the_stages_that_it_can_have(flats, tmp_path):
    """One graph: a scan along z has spots and a caustic; flats have photon transfer and a verdict of their own."""
    twin = shutil.copytree(SAMPLE, tmp_path / "twin")
    run = plan([SAMPLE, twin, flats], tmp_path / "results")
    jobs = planned(run.stdout)
    assert run.returncode == 0, run.stdout + run.stderr
    assert {name: jobs[name] for name in ("ingest", "report", "figures")} == dict.fromkeys(
        ("ingest", "report", "figures"), 3
    )
    assert (jobs["fit"], jobs["caustic"], jobs["judge"]) == (2, 2, 2)
    assert (jobs["transfer"], jobs["flats"]) == (1, 1)
    assert "expose" not in jobs and "paper" not in jobs


def test_names_must_differ(tmp_path):
    """Results are filed by name, so two folders of one name end in a sentence."""
    other = shutil.copytree(SAMPLE, tmp_path / "elsewhere" / SAMPLE.name)
    run = plan([SAMPLE, other], tmp_path / "results")
    assert run.returncode != 0
    said = [line for line in run.stderr.splitlines() if line.startswith("spotcheck: ")]
    assert len(said) == 1 and str(other) in said[0] and "one name" in said[0]


def test_a_dataset_that_is_wrong_is_named(tmp_path):
    """Of many datasets, the one that cannot be read."""
    run = plan([SAMPLE, tmp_path / "nowhere"], tmp_path / "results")
    assert run.returncode != 0
    assert f"spotcheck: {tmp_path / 'nowhere'}: no folder with a manifest.csv" in run.stderr


def test_planning_writes_nothing(tmp_path):
    """A dry run leaves neither results nor notes of whose they are. Snakemake's own folder is its own."""
    folder = shutil.copytree(SAMPLE, tmp_path / "mine")
    before = sorted(tmp_path.rglob("*"))
    run = plan([folder], tmp_path / "results")
    assert run.returncode == 0 and planned(run.stdout), run.stdout + run.stderr
    assert sorted(tmp_path.rglob("*")) == before
