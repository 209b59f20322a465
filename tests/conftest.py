"""What tests share: a small run of the whole workflow, made once a session by whichever worker needs it first."""

import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"
# Sums of small matrices: more threads of BLAS would do nothing but wait. It reads this when numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
SNAKEMAKE = [sys.executable, "-m", "snakemake"]


def snakemake(*arguments: str, cwd: Path = ROOT, config: dict | None = None) -> subprocess.CompletedProcess:
    """Run Snakemake as a user would, on two cores; returns what it printed."""
    command = [*SNAKEMAKE, "--cores", "2", "--nolock", *arguments]
    command += ["--config", *(f"{key}={value}" for key, value in config.items())] if config else []
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, env=environment(), check=False)


def environment() -> dict[str, str]:
    """The environment without what would change how jobs run."""
    return {k: v for k, v in os.environ.items() if not k.startswith(("SNAKEMAKE", "PYTEST"))}


def planned(output: str) -> dict[str, int]:
    """Rule → number of jobs, from the job statistics of a dry run."""
    # Two lines of heading stand below the title, and the total ends the table.
    rows = output.partition("Job stats:\n")[2].partition("\ntotal")[0].splitlines()[2:]
    return {name: int(count) for name, count in map(str.split, rows)}


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
    rows = [
        f"frames/a{angle}_r{repeat}_t{t:g}.tif,spot,{angle},{t},{repeat}\n"
        for repeat, angle, t in product(range(repeats), angles, exposures)
    ]
    (folder / "manifest.csv").write_text("file,kind,angle_deg,exposure_s,repeat\n" + "".join(rows))
    return folder


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What looks at the small run sits on one worker; slow tests come first, so that the workers end together."""
    for item in items:
        if "small_run" in getattr(item, "fixturenames", ()):
            item.add_marker("slow")
            item.add_marker(pytest.mark.xdist_group("small run"))
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


@contextmanager
def alone(lock: Path) -> Iterator[None]:
    """Let one process at a time do what follows."""
    lock.parent.mkdir(parents=True, exist_ok=True)
    with lock.open("w") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        yield


@pytest.fixture(scope="session")
def shared(tmp_path_factory) -> Path:
    """A folder that all workers of this session share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


def made_once(folder: Path, make: Callable[[Path], None]) -> Path:
    """A folder that the first worker makes and the others find."""
    with alone(folder.with_suffix(".lock")):
        done = folder / ".made"
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            done.touch()
    return folder


def run_whole(dataset: Path, results: Path) -> None:
    """Run the whole workflow on a dataset; an AssertionError with its output where it fails."""
    done = snakemake(config={"dataset": dataset, "results": results})
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="session")
def small_run(shared) -> Path:
    """Results folder of a small dataset of the virtual rig, after one complete run."""

    folder = made_once(shared / "run", lambda base: run_whole(small_rig_dataset(base / "small"), base / "results"))
    return folder / "results" / "small"


@pytest.fixture(scope="session")
def sample_run(shared) -> Path:
    """Results folder of the sample of a scan along z, which has no exposures, after one complete run."""

    sample = ROOT / "data" / "zscan-sample"
    return made_once(shared / "sample", lambda base: run_whole(sample, base)) / "zscan-sample"


@pytest.fixture(scope="session")
def flats_run(shared) -> Path:
    """Results folder of flats and darks of a drawn sensor without faults, after one complete run."""

    from tests.samples.example_datasets import flats

    folder = made_once(shared / "flats", lambda base: run_whole(flats(base / "set"), base / "results"))
    return folder / "results" / "set"


@pytest.fixture(scope="session")
def small_frames(shared) -> Path:
    """The small dataset as a user's own folder: frames, manifest, instrument, and no rig."""

    def expose(base: Path) -> None:
        folder = small_rig_dataset(base / "small")
        rig = Path(sys.executable).parent / "rig"
        settings, truth = folder / "rig.yaml", folder / "truth.json"
        command = [rig, "expose", folder, "--settings", settings, "--truth", truth]
        subprocess.run(command, check=True, capture_output=True)
        settings.unlink()
        truth.unlink()

    return made_once(shared / "frames", expose) / "small"


@pytest.fixture
def frames_only(small_frames, tmp_path) -> Path:
    """A copy of the small dataset that a test may spoil."""
    return shutil.copytree(small_frames, tmp_path / "mine")


@pytest.fixture
def instrument():
    """The instrument of the default dataset."""
    from spotcheck.dataset.instrument import read_instrument

    return read_instrument(ROOT / "data" / "virtual-rig" / "instrument.yaml")


@pytest.fixture(scope="session")
def shelf(tmp_path_factory) -> Path:
    """A folder with the two datasets that the documentation of the public names uses."""
    from spotcheck.model.design import simulate_dataset
    from tests.samples.example_datasets import LAW, design, flats

    base = tmp_path_factory.mktemp("shelf")
    simulate_dataset(design(base / "design"), base / "my-frames", **LAW, seed=1)
    flats(base / "my-flats")
    return base


@pytest.fixture
def there(shelf, monkeypatch):
    """The same as the working directory; what an example simulates is deleted afterwards."""
    monkeypatch.chdir(shelf)
    yield shelf
    shutil.rmtree(shelf / "simulated", ignore_errors=True)
