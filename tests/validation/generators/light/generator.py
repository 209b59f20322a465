"""The data sets of the score table, and the report on what became of them."""

import json
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.validation.generators.light import beams, page, whole
from tests.validation.generators.light.draw import UNALTERED, write_job
from tests.validation.generators.light.plan import COUNTS, plan
from tests.validation.generators.light.reading import false_names
from tests.validation.protocol import Job, Record
from tests.validation.records import ROOT

FIRST = 60_000_000
JOBS = sum(COUNTS.values())
PAGE = "validation.md"


def jobs(first: int) -> Iterator[Job]:
    """All jobs; where the shared folder is missing, those that need no file of it."""
    if not beams.there():
        print(f"{beams.SHARED} is not there: sets of real beams and real frames are skipped", file=sys.stderr)
    return (job for job in plan(first) if beams.there() or not needs_files(job))


def needs_files(job: Job) -> bool:
    """Whether a job draws from the shared folder."""
    row, _, light = _words_of(job)
    return row in ("frame", "frames at 600 px") or light == "real"


def _words_of(job: Job) -> tuple[str, str, str]:
    """Row, names of effects and light of a job; "" for what its kind does not have."""
    row, names, light, *_ = [*job.kind.split(":"), "", ""]
    return row, names, light


def write(job: Job, folder: Path, truth: Path) -> bool:
    """A set and its truth; False where its files are missing."""
    if needs_files(job) and not beams.there():
        return False
    row = job.kind.split(":")[0]
    makers = {"default dataset": whole.write_default, "frames at 600 px": whole.write_wide_frames}
    known = makers[row](folder) if row in makers else write_job(job, folder)
    truth.write_text(json.dumps(known, indent=1, default=float) + "\n", encoding="utf-8")
    return True


def unaltered(record: Record) -> Job | None:
    """The same beam without effects, for a set that names what was not put in: a real beam has effects of its own."""
    job = Job(**record["job"])
    row, names, light = _words_of(job)
    if light != "real" or not names or not false_names(record):
        return None
    return job._replace(kind=f"{UNALTERED}:{row}:{names}:{light}")


def report(rows: Sequence[Record], folder: Path, name: str, publish: bool) -> str:
    """The table, and a line for each set that is not right."""
    text = page.as_markdown(rows, name)
    (folder / PAGE).write_text(text, encoding="utf-8")
    if publish:
        shutil.copyfile(folder / PAGE, ROOT / "workflow" / "docs" / PAGE)
    return text
