"""The judge: from a dataset folder to its verdict, by the command line, as a user would have it."""

import json
import signal
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import Any

from spotcheck.cli import main
from tests.validation.protocol import Job, Record, generator, manifest_of

# A verdict that takes more time of its process is stopped [s].
PATIENCE = 220.0


def verdict_of(folder: Path, results: Path) -> dict[str, Any]:
    """verdict.json of a dataset folder by the subcommands that the workflow's rules call, in this process.
    RuntimeError with what the command said where it refuses."""
    results.mkdir(parents=True, exist_ok=True)
    spots = any(row["kind"] == "spot" for row in manifest_of(folder))
    for command, options in (_of_spots if spots else _of_flats)(results):
        said = StringIO()
        try:
            with redirect_stdout(said), redirect_stderr(said):
                main([command, str(folder), *map(str, options)])
        except SystemExit:
            raise RuntimeError(f"spotcheck {command}: {said.getvalue().strip().splitlines()[-1]}") from None
    return json.loads((results / "verdict.json").read_text(encoding="utf-8"))


def _of_spots(results: Path) -> Iterator[tuple[str, list[Any]]]:
    frames, crops, sensor = (results / name for name in ("frames.nc", "crops.nc", "sensor.nc"))
    yield "ingest", ["--output", frames]
    yield "crop", ["--frames", frames, "--output", crops]
    yield "sensor", ["--crops", crops, "--frames", frames, "--output", sensor]
    yield "judge", ["--crops", crops, "--sensor", sensor, "--pictures", results / "discrepancy.nc", "--model",
                    results / "model.yaml", "--light", results / "light.nc", "--output",
                    results / "verdict.json"]  # fmt: skip


def _of_flats(results: Path) -> Iterator[tuple[str, list[Any]]]:
    yield "ingest", ["--output", results / "frames.nc"]
    yield "flats", ["--frames", results / "frames.nc", "--output", results / "verdict.json"]


def record_of(name: str, job: Job) -> Record:
    """Make and judge one data set of a generator. An exception is an outcome like others."""
    own = generator(name)
    record: Record = {"job": job._asdict(), "truth": None, "verdict": None, "outcome": "error", "cpu_seconds": None,
                      "memory_mb": None}  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="spotcheck-") as scratch:
        base = Path(scratch)
        folder, results, truth = base / f"set{job.seed}", base / "results", base / "truth.json"
        try:
            if not own.write(job, folder, truth):
                return record | {"outcome": "passed over"}
            record["truth"] = json.loads(truth.read_text(encoding="utf-8"))
            forget_peak_memory()
            start = time.process_time()
            with within(PATIENCE):
                # Whatever is recorded must be fit for a file.
                record["verdict"] = json.loads(json.dumps(verdict_of(folder, results), allow_nan=False))
            record |= {"outcome": "judged", "cpu_seconds": time.process_time() - start, "memory_mb": peak_memory()}
            if job := own.unaltered(record):
                own.write(job, base / "unaltered", base / "nothing.json")
                verdict = verdict_of(base / "unaltered", base / "results of unaltered")
                record["unaltered"] = [effect["name"] for effect in verdict["effects"]]
        except Exception as error:
            record |= {"outcome": "error", "verdict": None, "error": said(error)}
    return record


def forget_peak_memory() -> None:
    """Let the kernel count the process's peak memory from here on; without Linux's `proc` nothing happens."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory() -> float | None:
    """Peak resident memory of this process since it was last forgotten [MB]; None where it is not known."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
    except OSError:
        return None
    return float(status.partition("VmHWM:")[2].split()[0]) / 1024


def said(error: Exception) -> str:
    """An exception in one line, with where it was raised."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno} in {where.name})"


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in what takes more time of this process."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"longer than {seconds:g} s")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
