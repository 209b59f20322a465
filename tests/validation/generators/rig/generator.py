"""The virtual rig's hidden effects as data sets, and the report that is published on them."""

import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from rig import hidden
from tests.validation import page, picture, records, score, times
from tests.validation.generators.rig.limit import limit_of
from tests.validation.generators.rig.plan import plan
from tests.validation.protocol import Job, Record

# The seed of the next scores to be published; what earlier ones showed was mended since.
FIRST = 37_000_000
JOBS = 20_000


def jobs(first: int) -> Iterator[Job]:
    """Jobs without end."""
    return plan(first)


def write(job: Job, folder: Path, truth: Path) -> bool:
    """A case of the rig; with one effect its truth says how strong that must be to be found. Sensors of 12 bit are
    passed over but in the default design: elsewhere they would double the null laws to be made. The data sheet decides
    this, which an analysis may see."""
    case = _case(job)
    if job.design != "default" and case.instrument["sensor"]["bit_depth"] != 10:
        return False
    if job.budget:
        model = case.instrument["model"] | {"photon_budget": job.budget}
        case = replace(case, instrument=case.instrument | {"model": model})
    if len(case.truth["effects"]) == 1:
        case = replace(case, truth=case.truth | {"limit": limit_of(case)})
    hidden.write(case, folder, truth)
    return True


def report(rows: Sequence[Record], folder: Path, name: str, publish: bool) -> str:
    """Scores, by effect too, and the picture of which name was given to what."""
    taken = times.read(folder)
    figures = [*score.figures(rows), *times.figures(taken)]
    first = records.first_of(rows)
    (folder / "blind.md").write_text(page.as_markdown(figures, rows, name, first), encoding="utf-8")
    picture.draw(score.confusion(rows), folder / "blind.png")
    if publish:
        if first < FIRST:
            sys.exit(f"seeds below {FIRST:,} were used for tuning, so they are not published")
        records.publish(rows, name, taken)
        for file in ("blind.md", "blind.png"):
            shutil.copyfile(folder / file, records.ROOT / "workflow" / "docs" / file)
        for quoting in ("README.md", "workflow/docs/verdict.md"):
            check = [sys.executable, "tests/check_readme.py", quoting, "--write"]
            subprocess.run(check, cwd=records.ROOT, check=True)
    return f"{page.summary(figures, rows)}; {folder.relative_to(records.ROOT)}/blind.md"


def _case(job: Job) -> hidden.Case:
    return hidden.draw_case(job.seed, job.kind, job.design)
