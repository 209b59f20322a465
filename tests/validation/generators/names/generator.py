"""The data sets of the table of names, and the report on what became of them."""

import json
from collections.abc import Iterator
from pathlib import Path

from tests.validation.generators.light import generator as light
from tests.validation.generators.names import before
from tests.validation.generators.rig import generator as rig
from tests.validation.protocol import Job

FIRST, JOBS, report = light.FIRST, light.JOBS, light.report
# After every so many sets on real light comes one of the suite before.
EVERY = 5


def jobs(first: int) -> Iterator[Job]:
    """Jobs without end."""
    old = iter(before.jobs(first))
    for k, job in enumerate(light.jobs(first), 1):
        yield job
        if k % EVERY == 0 and (own := next(old, None)):
            yield own._replace(number=job.number)


def write(job: Job, folder: Path, truth: Path) -> bool:
    """A set and its truth; of a set on which the engine before was scored, that knows what became of it."""
    if not job.kind.startswith(f"{before.WORD}:"):
        return light.write(job, folder, truth)
    made = rig.write(job._replace(kind=job.kind.removeprefix(f"{before.WORD}:")), folder, truth)
    known = json.loads(truth.read_text(encoding="utf-8")) if made else {}
    truth.write_text(json.dumps(known | {"before": before.rows()[job.seed]["outcome"]}) + "\n", encoding="utf-8")
    return made
