"""A small run of the whole workflow, made once a session, that rule, artefact and workflow tests look at."""

import csv
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"
SNAKEMAKE = [sys.executable, "-m", "snakemake"]


def snakemake(*arguments: str, cwd: Path = ROOT, config: dict | None = None) -> subprocess.CompletedProcess:
    """Run Snakemake as a user would, on two cores; returns what it printed."""
    command = [*SNAKEMAKE, "--cores", "2", "--nolock", *arguments]
    # The fewest null sets that can tell one in a hundred: p-values are not what a run of the workflow tests.
    config = {"null_simulations": 200} | (config or {})
    command += ["--config", *(f"{key}={value}" for key, value in config.items())]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, env=environment(), check=False)


def environment() -> dict[str, str]:
    """The environment without what would change how jobs run."""
    return {k: v for k, v in os.environ.items() if not k.startswith(("SNAKEMAKE", "PYTEST"))}


def planned(output: str) -> dict[str, int]:
    """Rule → number of jobs, from the job statistics of a dry run."""
    lines = output.splitlines()
    if "Job stats:" not in output:
        return {}
    start = next(k for k, line in enumerate(lines) if line.startswith("Job stats:")) + 3
    jobs: dict[str, int] = {}
    for line in lines[start:]:
        if not line.strip() or line.startswith("total"):
            break
        name, count = line.split()
        jobs[name] = int(count)
    return jobs


def small_rig_dataset(folder: Path, angles=(0, 90), exposures=(1e-4, 5e-4, 9e-4), repeats=3) -> Path:
    """A dataset folder for the virtual rig: the default one's physics on frames of 400 × 360 px and crops of 120 px."""
    folder.mkdir(parents=True)
    default = ROOT / "data" / "virtual-rig"
    settings = yaml.safe_load((default / "rig.yaml").read_text())
    settings["frame"] |= {"width_px": 400, "height_px": 360, "window_px": 200}
    settings["pointing"] |= {"offset_x_px": 12.0, "offset_y_px": -9.0, "wander_px": 6.0, "border_px": 70.0}
    (folder / "rig.yaml").write_text(yaml.safe_dump(settings))
    instrument = (default / "instrument.yaml").read_text().replace("crop_px: 240", "crop_px: 120")
    (folder / "instrument.yaml").write_text(instrument)
    with (folder / "manifest.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["file", "kind", "angle_deg", "exposure_s", "repeat"])
        for repeat in range(repeats):
            for angle in angles:
                for t in exposures:
                    writer.writerow([f"frames/a{angle}_r{repeat}_t{t:g}.tif", "spot", angle, t, repeat])
    return folder


@pytest.fixture(scope="session")
def small_run(tmp_path_factory) -> Path:
    """Results folder of a small dataset of the virtual rig, after one complete run."""
    base = tmp_path_factory.mktemp("small")
    dataset = small_rig_dataset(base / "small")
    run = snakemake(config={"dataset": dataset, "results": base / "results"})
    assert run.returncode == 0, run.stdout + run.stderr
    return base / "results" / "small"


@pytest.fixture(scope="session")
def small_frames(tmp_path_factory) -> Path:
    """The small dataset as a user's own folder: frames, manifest, instrument, and no rig."""
    folder = small_rig_dataset(tmp_path_factory.mktemp("frames") / "small")
    rig = Path(sys.executable).parent / "rig"
    settings, truth = folder / "rig.yaml", folder / "truth.json"
    subprocess.run([rig, "expose", folder, "--settings", settings, "--truth", truth], check=True, capture_output=True)
    settings.unlink()
    truth.unlink()
    return folder


@pytest.fixture
def frames_only(small_frames, tmp_path) -> Path:
    """A copy of the small dataset that a test may spoil."""
    return shutil.copytree(small_frames, tmp_path / "mine")
