"""Flats of a real CCD as data sets, as they are and with an effect put in, and the page of what became of them."""

import json
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.validation.generators.real import levels, sensor
from tests.validation.protocol import Job, Record
from tests.validation.records import ROOT

FIRST = 0
CCD = "ccd"
JOBS = 1 + len(levels.PUT_IN)


def jobs(first: int) -> Iterator[Job]:
    """The CCD as it is and with each effect."""
    if not levels.SOURCE.exists():
        sys.exit(f"{levels.SOURCE}: is not there; real frames are no part of the repository")
    for k, name in enumerate(("", *levels.PUT_IN)):
        yield Job(k, first + k, f"real:{name}" if name else "real", CCD)


def write(job: Job, folder: Path, truth: Path) -> bool:
    """Frames with an effect put in; the truth knows that one effect and no more."""
    name = job.kind.partition(":")[2]
    parameters = levels.write(name, folder)
    effects = [{"name": name, "parameters": parameters, "form": {}}] if name else []
    truth.write_text(json.dumps({"effects": effects}) + "\n", encoding="utf-8")
    return True


def unaltered(record: Record) -> None:
    """Flats and darks are judged as they are."""


def report(rows: Sequence[Record], folder: Path, name: str, publish: bool) -> str:
    """The page, once every data set was judged."""
    lost = [own for own in rows if own["verdict"] is None]
    if lost or len(rows) < JOBS:
        said = "".join(f"\n{own['job']['kind']}: {own['error']}" for own in lost)
        return f"{len(rows)} of {JOBS} data sets so far, {len(lost)} without a verdict{said}"
    text = sensor.page({own["job"]["kind"].partition(":")[2]: own["verdict"] for own in rows})
    (folder / "real-sensor.md").write_text(text, encoding="utf-8")
    if publish:
        shutil.copyfile(folder / "real-sensor.md", ROOT / "workflow" / "docs" / "real-sensor.md")
    return text
