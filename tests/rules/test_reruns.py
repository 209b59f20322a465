"""What runs again after an edit: just what the edit touches."""

import csv
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.conftest import ROOT, SNAKEMAKE, environment, planned

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("reruns")]


@pytest.fixture(scope="module")
def checkout(small_frames, tmp_path_factory):
    """A copy of the repository with a dataset of its own, run once as far as the metrics."""
    copy = tmp_path_factory.mktemp("checkout") / "repository"
    skip = shutil.ignore_patterns(".*", "results", "virtual-rig", "__pycache__", "*.egg-info")
    shutil.copytree(ROOT, copy, ignore=skip)
    shutil.copytree(small_frames, copy / "data" / "mine")
    run = call(copy)
    assert run.returncode == 0, run.stdout + run.stderr
    return copy


def call(copy, *arguments: str) -> subprocess.CompletedProcess:
    """Snakemake on the copy, whose library shadows the installed one."""
    command = [*SNAKEMAKE, "--cores", "2", "--until", "metrics", "bounds", *arguments, "--config", "dataset=mine"]
    env = environment() | {"PYTHONPATH": str(copy / "workflow")}
    return subprocess.run(command, cwd=copy, capture_output=True, text=True, env=env, check=False)


def plan(copy) -> dict[str, int]:
    """Jobs that a run would start now."""
    run = call(copy, "--dry-run")
    assert run.returncode == 0, run.stdout + run.stderr
    return planned(run.stdout + run.stderr)


def test_nothing_edited_is_nothing_to_do(checkout):
    """Nor where an edit was taken back, which leaves a newer file with the old text."""
    path = checkout / "workflow" / "spotcheck" / "metrics" / "crop_metrics.py"
    path.write_text(path.read_text())
    assert plan(checkout) == {}


AFTER_FIT = {"calibrate", "simulate", "ingest_simulated", "crop_simulated", "fit_simulated", "metrics", "bounds"}


@pytest.mark.parametrize(
    ("leaf", "expected"),
    [
        ("metrics/crop_metrics.py", {"metrics"}),
        ("fitting/fisher.py", {"bounds"}),
        ("fitting/likelihood.py", {"calibrate"}),
        ("report/figures/style.py", set()),
    ],
)
def test_edit_of_one_leaf(checkout, leaf, expected):
    """An edit of one module plans the stages that import it, and what takes their outputs, and nothing before them."""
    path = checkout / "workflow" / "spotcheck" / leaf
    before = path.read_text()
    path.write_text(before + "\n# edited\n")
    jobs = set(plan(checkout))
    path.write_text(before)
    downstream = AFTER_FIT if "calibrate" in expected else set()
    # `read_width_law` of the calibration is imported by what follows it, so that its code counts there too.
    assert expected <= jobs <= expected | downstream, jobs
    assert not jobs & {"ingest", "crop", "sensor", "fit"}


def test_one_new_frame(checkout):
    """A new frame plans one job of each stage that sees it, none of the rig's and none twice."""
    folder = checkout / "data" / "mine"
    rows = list(csv.DictReader((folder / "manifest.csv").read_text().splitlines()))
    shutil.copy(folder / rows[0]["file"], folder / "frames" / "new.tif")
    manifest = (folder / "manifest.csv").read_bytes()
    more = f"frames/new.tif,spot,0,{rows[0]['exposure_s']},99\n"
    (folder / "manifest.csv").write_bytes(manifest + more.encode())
    jobs = plan(checkout)
    (folder / "frames" / "new.tif").unlink()
    (folder / "manifest.csv").write_bytes(manifest)
    stages = {"ingest", "crop", "sensor", "fit"} | AFTER_FIT
    assert jobs == dict.fromkeys(stages, 1)


def of_equal_age(checkout, kind: str) -> tuple[Path, Path]:
    """A file of the dataset, and another one of its size and times with other content."""
    folder = checkout / "data" / "mine"
    frames = sorted((folder / "frames").iterdir())
    own = {"frame": frames[0], "instrument": folder / "instrument.yaml"}[kind]
    other = checkout / f"other{own.suffix}"
    if kind == "frame":
        shutil.copy2(frames[1], other)
    else:
        other.write_text(own.read_text().replace("read_noise_e: 13.0", "read_noise_e: 12.0"))
    status = own.stat()
    os.utime(other, ns=(status.st_atime_ns, status.st_mtime_ns))
    return own, other


@pytest.mark.parametrize("kind", ["frame", "instrument"])
@pytest.mark.parametrize("how", ["cp -p", "mv"])
def test_another_content_of_equal_age_is_stale(checkout, kind, how):
    """Times tell nothing of a file that was unpacked, copied or moved into place: its digest does."""
    own, other = of_equal_age(checkout, kind)
    before = own.read_bytes(), own.stat()
    shutil.copy2(other, own) if how == "cp -p" else other.replace(own)
    jobs = plan(checkout)
    own.write_bytes(before[0])
    os.utime(own, ns=(before[1].st_atime_ns, before[1].st_mtime_ns))
    assert {"ingest", "crop", "sensor", "fit"} <= set(jobs)
    assert plan(checkout) == {}


def test_touched_files_are_what_they_were(checkout):
    for path in [*(checkout / "data" / "mine" / "frames").iterdir(), checkout / "data" / "mine" / "manifest.csv"]:
        path.touch()
    assert plan(checkout) == {}


def test_instrument_edit_leaves_the_frames_alone(checkout):
    """Another read noise is no reason to expose or to draw the rule graph again."""
    path = checkout / "data" / "mine" / "instrument.yaml"
    before = path.read_text()
    path.write_text(before.replace("read_noise_e: 13.0", "read_noise_e: 12.0"))
    jobs = plan(checkout)
    path.write_text(before)
    assert {"sensor", "fit"} <= set(jobs)
    assert not {"expose", "tables"} & set(jobs)
