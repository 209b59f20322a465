"""The judge: from a dataset folder to its verdict, by the command line, as a user would have it."""

import fcntl
import hashlib
import json
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import yaml

from spotcheck import provenance
from spotcheck.cli import main
from tests.validation.outcome import word_for
from tests.validation.protocol import Job, Record, generator, manifest_of
from tests.validation.records import ROOT

# As in config/config.yaml.
SEED = 20210
# A verdict that takes more time of its process has failed [s].
PATIENCE = 400.0


class Busy(Exception):
    """Another process makes the null law that this data set needs."""


def verdict_of(folder: Path, results: Path, laws: Path, null_sets: int) -> dict[str, Any]:
    """verdict.json of a dataset folder by the subcommands that the workflow's rules call, in this process; `laws` keeps
    null laws from one call to the next. RuntimeError with what the command said where it refuses."""
    results.mkdir(parents=True, exist_ok=True)
    spots = any(row["kind"] == "spot" for row in manifest_of(folder))
    for command, options in (_of_spots if spots else _of_flats)(results, laws, null_sets):
        said = StringIO()
        try:
            with redirect_stdout(said), redirect_stderr(said):
                main([command, str(folder), *map(str, options)])
        except SystemExit:
            raise RuntimeError(f"spotcheck {command}: {said.getvalue().strip().splitlines()[-1]}") from None
    return json.loads((results / "verdict.json").read_text(encoding="utf-8"))


def _of_spots(results: Path, laws: Path, null_sets: int) -> Iterator[tuple[str, list[Any]]]:
    frames, crops, sensor, findings, gap, advice = (
        results / name for name in ("frames.nc", "crops.nc", "sensor.nc", "findings.json", "gap.nc", "advice.json")
    )
    seen = ["--crops", crops, "--sensor", sensor]
    found = [*seen, "--findings", findings]
    yield "ingest", ["--output", frames]
    yield "crop", ["--frames", frames, "--output", crops]
    yield "sensor", ["--crops", crops, "--frames", frames, "--output", sensor]
    yield "discrepancy", [*seen, *_nulls(null_sets), "--calibrations", laws, "--output", findings]
    yield "verify", [*found, "--output", gap]
    yield "advise", [*found, "--output", advice]
    yield "verdict", [*found, "--gap", gap, "--advice", advice, "--pictures", results / "discrepancy.nc",
                      "--output", results / "verdict.json"]  # fmt: skip


def _of_flats(results: Path, laws: Path, null_sets: int) -> Iterator[tuple[str, list[Any]]]:
    yield "ingest", ["--output", results / "frames.nc"]
    yield "flats", ["--frames", results / "frames.nc", *_nulls(null_sets), "--output", results / "verdict.json"]


def _nulls(null_sets: int) -> list[Any]:
    return ["--simulations", null_sets, "--seed", SEED]


def by_workflow(folder: Path, results: Path, cores: int) -> dict[str, Any]:
    """The same by the workflow's target, in a process of its own."""
    config = [f"dataset={folder}", f"results={results}"]
    command = [sys.executable, "-m", "snakemake", "--cores", str(cores), "--nolock", "verdict", "--config", *config]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if run.returncode:
        raise RuntimeError(f"snakemake: {(run.stdout + run.stderr).strip().splitlines()[-1]}")
    return json.loads((results / folder.name / "verdict.json").read_text(encoding="utf-8"))


def record_of(name: str, job: Job, laws: Path) -> Record:
    """Make and judge one data set of a generator. An exception is an outcome like others; only `Busy` passes."""
    own = generator(name)
    record: Record = {"job": job._asdict(), "truth": None, "verdict": None, "outcome": "error", "seconds": None}
    with tempfile.TemporaryDirectory(prefix="spotcheck-") as base:
        folder, results, truth = Path(base, f"set{job.seed}"), Path(base, "results"), Path(base, "truth.json")
        judge = partial(verdict_of, laws=laws, null_sets=own.NULL_SETS)
        try:
            if not own.write(job, folder, truth):
                return record | {"outcome": "passed over"}
            record["truth"] = json.loads(truth.read_text(encoding="utf-8"))
            start = time.perf_counter()
            with _alone(laws, folder, own.NULL_SETS) as first, within(None if first else PATIENCE):
                record["verdict"] = judge(folder, results)
            # The time of a null law is that of its design, not of this data set.
            record["seconds"] = None if first else time.perf_counter() - start
            record["outcome"] = word_for(record)
            more = own.beside(job, folder, results, record["truth"], judge)
            # Whatever is recorded must be fit for a file.
            record |= json.loads(json.dumps(more, allow_nan=False))
        except Busy:
            raise
        except Exception as error:
            record |= {"outcome": "error", "verdict": None, "error": said(error)}
    return record


def said(error: Exception) -> str:
    """An exception in one line, with where it was raised."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno} in {where.name})"


@contextmanager
def _alone(laws: Path, folder: Path, null_sets: int) -> Iterator[bool]:
    """Let one process alone judge the first data set of a design, for that makes the null law; yields whether it is
    the first. Raises `Busy` while another process is at it."""
    rows = sorted([value for key, value in row.items() if key not in ("file", "page")] for row in manifest_of(folder))
    sheet = yaml.safe_load((folder / "instrument.yaml").read_text(encoding="utf-8"))
    camera = sheet.get("crop_px"), sheet["sensor"].get("bit_depth"), sheet.get("model")
    parts = [rows, camera, null_sets, provenance.code_digest("spotcheck.cli.discrepancy")]
    key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]
    laws.mkdir(parents=True, exist_ok=True)
    made = laws / f"{key}.made"
    with (laws / f"{key}.lock").open("w") as lock:
        if not made.exists():
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise Busy from None
        first = not made.exists()
        yield first
        made.touch()


@contextmanager
def within(seconds: float | None) -> Iterator[None]:
    """Raise TimeoutError in what takes more time of this process; None: let it take what it takes."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"longer than {seconds:g} s")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds or 0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
