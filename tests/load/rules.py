"""Memory and time of each rule beside what it asks of a cluster, and how large the page becomes:
`python -m tests.load.rules [--repeats 10,167]`.

Datasets of more and more frames run through the whole workflow; Snakemake measures each job and says what its rule
asked for.
"""

import argparse
import ast
import csv
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tests.conftest import small_rig_dataset, snakemake
from tests.load.rows import Row, write

# Frames of one repeat of the small dataset.
EACH = 6


class Job(NamedTuple):
    """Peak memory [MB] and time [min] of a rule's job, and what it had asked for of both."""

    megabytes: float
    minutes: float
    asked_mb: float
    asked_min: float


def main() -> None:
    """Measure and write the rows."""
    parser = argparse.ArgumentParser(prog="python -m tests.load.rules", description=__doc__)
    parser.add_argument("--repeats", default="10,167", help="repeats of the six frames of the sets (default 10,167)")
    repeats = [int(number) for number in parser.parse_args().repeats.split(",")]
    with tempfile.TemporaryDirectory(prefix="rules-") as base:
        folders = [small_rig_dataset(Path(base, f"set{count}"), repeats=count) for count in repeats]
        measured = [jobs_of(folder) for folder in folders]
        pages = [(results_of(folder) / "report.html").stat().st_size for folder in folders]
    frames = [EACH * count for count in repeats]
    write("rules", [*rows(frames, measured), page_row(frames, pages)])


def jobs_of(folder: Path) -> dict[str, Job]:
    """The jobs of a whole run on a dataset, by rule. RuntimeError with its last lines where it fails."""
    results = results_of(folder).parent
    run = snakemake("--benchmark-extended", config={"dataset": folder, "results": results})
    if run.returncode:
        raise RuntimeError(f"the run on {folder.name} failed:\n" + "\n".join(run.stderr.splitlines()[-30:]))
    return {path.stem: job_of(path) for path in sorted((results_of(folder) / "benchmarks").glob("*.tsv"))}


def results_of(folder: Path) -> Path:
    """Where the results of a dataset lie."""
    return folder.with_name("results") / folder.name


def job_of(path: Path) -> Job:
    """One of Snakemake's extended benchmark files."""
    with path.open(newline="", encoding="utf-8") as stream:
        (row,) = csv.DictReader(stream, delimiter="\t")
    asked = ast.literal_eval(row["resources"])
    return Job(float(row["max_rss"]), float(row["s"]) / 60, float(asked["mem_mb"]), float(asked["runtime"]))


def rows(frames: Sequence[int], measured: Sequence[dict[str, Job]]) -> list[Row]:
    """A row a rule; what took more than was asked for is said."""
    out = []
    for rule in measured[-1]:
        own = [jobs[rule] for jobs in measured]
        over = any(job.megabytes > job.asked_mb or job.minutes > job.asked_min for job in own)
        peaks, asked, times = (
            ", ".join(f"{value:.0f}" for value in values)
            for values in ([job.megabytes for job in own], [job.asked_mb for job in own],
                           [60 * job.minutes for job in own])
        )  # fmt: skip
        said = f"{peaks} MB of {asked}; {times} s of {own[-1].asked_min:.0f} min"
        what = f"{rule}, {' and '.join(f'{count:,}' for count in frames)} frames"
        out.append(Row(what, len(own), f"{said}{'; MORE than asked' if over else ''}"))
    return out


def page_row(frames: Sequence[int], sizes: Sequence[int]) -> Row:
    """A row on the page of each set, by its size [byte]."""
    what = f"report.html, {' and '.join(f'{count:,}' for count in frames)} frames"
    return Row(what, len(sizes), f"{', '.join(f'{size / 1e6:.1f}' for size in sizes)} MB")


if __name__ == "__main__":
    main()
