"""A run that was stopped or killed needs nothing but the same call again, and two runs share no results folder."""

import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from spotcheck.io import run_control
from tests.conftest import ROOT, SNAKEMAKE, environment
from tests.workflow.test_bad_input import digests

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("stopped runs")]

SAMPLE = ROOT / "data" / "zscan-sample"


def call(folder: Path, results: Path) -> list[str]:
    """The documented call, as far as the verdict."""
    return [*SNAKEMAKE, "--cores", "2", "--until", "judge", "--config", f"dataset={folder}", f"results={results}"]


def finish(folder: Path, results: Path) -> subprocess.CompletedProcess:
    """The call, to its end."""
    command = call(folder, results)
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment(), check=False)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> dict[str, str]:
    """Digests of the results of a run that nobody disturbs."""
    base = tmp_path_factory.mktemp("undisturbed")
    run = finish(shutil.copytree(SAMPLE, base / "mine"), base / "results")
    assert run.returncode == 0, run.stderr
    return digests(base / "results")


@pytest.fixture
def started(tmp_path):
    """A run that has begun its work; its folder, its results, and the process."""
    folder, results = shutil.copytree(SAMPLE, tmp_path / "mine"), tmp_path / "results"
    command = call(folder, results)
    with subprocess.Popen(command, cwd=ROOT, env=environment(), stdout=-1, stderr=subprocess.STDOUT, text=True) as run:
        deadline = time.monotonic() + 120
        while not (results / "mine" / "crops.nc").exists() and run.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        assert run.poll() is None, run.stdout.read()
        yield folder, results, run
        run.kill()


def test_a_second_run_beside_a_first_says_so(started):
    folder, results, first = started
    second = finish(folder, results)
    assert first.poll() is None, "the first run ended too soon to be disturbed"
    assert second.returncode != 0
    said = [line for line in second.stderr.splitlines() if line.startswith("spotcheck: ")]
    assert len(said) == 1 and "another run is working there" in said[0]
    assert "Traceback" not in second.stderr and "--unlock" not in second.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_the_same_call_goes_on(started, undisturbed, number):
    """Whatever Snakemake was stopped by; what was done is not done again, and all files come out as if undisturbed."""
    folder, results, run = started
    done = (results / "mine" / "frames.nc").stat().st_mtime_ns
    begin = time.monotonic()
    run.send_signal(number)
    assert run.wait(timeout=20) != 0
    assert time.monotonic() - begin < 10
    if number != signal.SIGKILL:
        assert run_control.find_jobs(run_control.get_lock_path(results / "mine").read_text()) == []
    again = finish(folder, results)
    assert again.returncode == 0, again.stdout + again.stderr
    assert (results / "mine" / "frames.nc").stat().st_mtime_ns == done
    assert list(results.rglob("*.part*")) == []
    assert digests(results) == undisturbed | {"mine/.dataset": digests(results)["mine/.dataset"]}
