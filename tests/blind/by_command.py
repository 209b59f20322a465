"""The same case as a user would have it judged: a folder of TIFF files, the command line, and verdict.json."""

import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from rig import hidden
from spotcheck.cli import main
from tests.blind.plan import Job
from tests.blind.records import ROOT

# Numbers of two ways to the same verdict may differ by this part of themselves, or by so little.
RELATIVE, ABSOLUTE = 1e-6, 1e-9
# What only the command adds, and the name of the folder.
BESIDE = ("dataset", "where", "sentence")


def differences(job: Job, verdict: dict[str, Any], calibrations: Path, count: int, seed: int, whole: bool) -> list[str]:
    """Where the verdict of the command line departs from the one made in memory; `whole` by the workflow, else by its
    subcommands one after another."""
    case = hidden.draw_case(job.seed, job.kind, job.design)
    with tempfile.TemporaryDirectory(prefix="spotcheck-blind-") as base:
        folder, results = Path(base, f"set{job.seed}"), Path(base, "results")
        hidden.write(case, folder, Path(base, "truth.json"))
        if whole:
            (results / "_calibration").parent.mkdir()
            (results / "_calibration").symlink_to(calibrations.resolve())
            workflow(folder, results, 1, null_simulations=count, seed=seed)
        else:
            by_subcommands(folder, results / folder.name, calibrations, count, seed)
        written = json.loads((results / folder.name / "verdict.json").read_text(encoding="utf-8"))
    kept = {key: value for key, value in written.items() if key not in BESIDE}
    return list(_apart("", {key: value for key, value in verdict.items() if key not in BESIDE}, kept))


def workflow(folder: Path, results: Path, cores: int, **keys: int) -> None:
    """The workflow's target, in a process of its own, with some keys of its config."""
    config = [f"{key}={value}" for key, value in {"dataset": folder, "results": results, **keys}.items()]
    command = [sys.executable, "-m", "snakemake", "--cores", str(cores), "--nolock", "verdict", "--config", *config]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if run.returncode:
        raise RuntimeError(f"snakemake: {(run.stdout + run.stderr).strip().splitlines()[-1]}")


def by_subcommands(folder: Path, out: Path, calibrations: Path, count: int, seed: int) -> None:
    """The subcommands as the rules call them."""
    at = {name: str(out / name) for name in ("frames.nc", "crops.nc", "sensor.nc", "findings.json", "gap.nc")}
    at |= {name: str(out / name) for name in ("advice.json", "discrepancy.nc", "verdict.json")}
    seen = ["--crops", at["crops.nc"], "--sensor", at["sensor.nc"]]
    found = [*seen, "--findings", at["findings.json"]]
    simulations = ["--calibrations", str(calibrations), "--simulations", str(count), "--seed", str(seed)]
    out.mkdir(parents=True)
    for command, options in {
        "ingest": ["--output", at["frames.nc"]],
        "crop": ["--frames", at["frames.nc"], "--output", at["crops.nc"]],
        "sensor": ["--crops", at["crops.nc"], "--frames", at["frames.nc"], "--output", at["sensor.nc"]],
        "discrepancy": [*seen, *simulations, "--output", at["findings.json"]],
        "verify": [*found, "--output", at["gap.nc"]],
        "advise": [*found, "--output", at["advice.json"]],
        "verdict": [*found, "--gap", at["gap.nc"], "--advice", at["advice.json"], "--pictures", at["discrepancy.nc"],
                    "--output", at["verdict.json"]],
    }.items():  # fmt: skip
        said = StringIO()
        try:
            with redirect_stdout(said), redirect_stderr(said):
                main([command, str(folder), *options])
        except SystemExit:
            raise RuntimeError(f"spotcheck {command}: {said.getvalue().strip().splitlines()[-1]}") from None


def _apart(where: str, one: Any, other: Any) -> Iterator[str]:
    """Sentences about what differs, by place."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in {**one, **other}:
            yield from _apart(f"{where}.{key}".lstrip("."), one.get(key), other.get(key))
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for k, (a, b) in enumerate(zip(one, other, strict=True)):
            yield from _apart(f"{where}[{k}]", a, b)
    elif isinstance(one, float | int) and isinstance(other, float | int) and not isinstance(one, bool):
        if not math.isclose(one, other, rel_tol=RELATIVE, abs_tol=ABSOLUTE):
            yield f"{where}: {one!r} in memory, {other!r} by the command"
    elif one != other:
        yield f"{where}: {one!r} in memory, {other!r} by the command"
