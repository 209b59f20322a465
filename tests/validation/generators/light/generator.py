"""The data sets on which names that hold on real light are judged, and the report on what became of them."""

import json
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.validation.generators.light import beams, score
from tests.validation.generators.light.draw import write_job
from tests.validation.generators.light.plan import plan
from tests.validation.protocol import Job, Record
from tests.validation.records import ROOT

FIRST = 60_000_000
JOBS = 4000


def jobs(first: int) -> Iterator[Job]:
    """Jobs without end; where the shared folder is missing, those that need no file."""
    if not beams.there():
        print(f"{beams.SHARED} is not there: sets of real beams and real frames are skipped", file=sys.stderr)
    return (job for job in plan(first) if beams.there() or not needs_files(job))


def needs_files(job: Job) -> bool:
    """Whether a job draws from the shared folder."""
    return job.kind.startswith("hene:") or "real" in job.kind.split(":")


def write(job: Job, folder: Path, truth: Path) -> bool:
    """A set and its truth; False where its files are missing."""
    if needs_files(job) and not beams.there():
        return False
    truth.write_text(json.dumps(write_job(job, folder), indent=1, default=float) + "\n", encoding="utf-8")
    return True


def report(rows: Sequence[Record], folder: Path, name: str, publish: bool) -> str:
    """The table, and a line for each set that is not right."""
    text = score.page(rows, name)
    (folder / "light.md").write_text(text, encoding="utf-8")
    if publish:
        shutil.copyfile(folder / "light.md", ROOT / "workflow" / "docs" / "real-light.md")
    return text
