"""One run at a time in a folder of results, and what a killed run leaves behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from spotcheck.errors import InputError
from spotcheck.io import run_control
from tests.samples.small_datasets import ROOT

# A run with two jobs, one of which takes no hint; it says so when they are there.
RUN = """
import os, subprocess, sys, time
from pathlib import Path
from spotcheck.io import run_control
token = run_control.make_token()
held = run_control.lock_results(Path(sys.argv[1]), token)
os.environ[run_control.TOKEN_VARIABLE] = token
deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(1, flush=True); time.sleep(60)"
jobs = [subprocess.Popen([sys.executable, "-c", "import time; print(1, flush=True); time.sleep(60)"], stdout=-1)]
jobs += [subprocess.Popen([sys.executable, "-c", deaf], stdout=-1)]
for job in jobs:
    job.stdout.readline()
run_control.end_jobs_on_signal(token)
try:
    print(token, flush=True)
    while True:
        time.sleep(0.1)
except KeyboardInterrupt:
    for job in jobs:
        job.wait()
    sys.exit(1)
"""


@pytest.fixture
def run(tmp_path):
    """A run that works in `tmp_path`, and its token."""
    with subprocess.Popen([sys.executable, "-c", RUN, tmp_path], cwd=ROOT, stdout=-1, stderr=-1, text=True) as process:
        token = process.stdout.readline().strip()
        yield process, token
        process.kill()
    run_control.end_jobs(token)


def test_a_second_run_is_refused(run, tmp_path):
    with pytest.raises(InputError, match=rf"^{tmp_path}: another run is working there; "):
        run_control.lock_results(tmp_path, "second")
    assert len(run_control.find_jobs(run[1])) == 2


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_run_that_is_stopped_ends_with_its_jobs(run, number):
    """Within 10 s, also where a job takes no hint."""
    process, token = run
    start = time.monotonic()
    process.send_signal(number)
    assert process.wait(timeout=10) == 1
    assert time.monotonic() - start < 10
    assert run_control.find_jobs(token) == []
    assert process.stderr.read() == f"spotcheck: stopped by {number.name}; the same command continues from here\n"


def test_after_a_killed_run_the_next_one_ends_its_jobs(run, tmp_path):
    process, token = run
    process.kill()
    process.wait()
    assert len(run_control.find_jobs(token)) == 2
    with run_control.lock_results(tmp_path, "next"):
        assert run_control.find_jobs(token) == []
        assert run_control.get_lock_path(tmp_path).read_text() == "next"


def test_parts_go_with_their_writers(tmp_path):
    """What a living process writes stays, and so does what only looks like a part."""
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    notebooks = [tmp_path / "notebooks" / f"spot.part.{suffix}" for suffix in ("ipynb", "html")]
    gone = [tmp_path / f".crops.nc.{dead.pid}.part", *notebooks]
    kept = [tmp_path / f".fits.nc.{os.getpid()}.part", tmp_path / "a.part", tmp_path / "my.parts.csv"]
    (tmp_path / "notebooks").mkdir()
    for path in (*gone, *kept):
        path.touch()
    run_control.remove_scratch_files(tmp_path)
    assert not any(path.exists() for path in gone)
    assert all(path.exists() for path in kept)


def test_writers_name_their_parts_alike(tmp_path):
    """So that what they leave is found, wherever it is written."""
    writers = [*(ROOT / "workflow" / "spotcheck").rglob("*.py"), *(ROOT / "workflow" / "rig").rglob("*.py")]
    named = [line for path in writers for line in path.read_text().splitlines() if '.part")' in line]
    assert len(named) == 2
    assert all(".{os.getpid()}.part" in line for line in named)
    assert run_control.SCRATCH_NAME.fullmatch(Path(f".frames.nc.json.{os.getpid()}.part").name)
