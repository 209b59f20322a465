"""Real frames as data sets, as they are and with an effect put in, and the pages of what became of them."""

import json
import shutil
import sys
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from tests.validation.generators.real import beams, beams_picture, levels, sensor
from tests.validation.protocol import Job, Judge, Record
from tests.validation.records import ROOT

NULL_SETS = 1500
FIRST = 0
JOBS = 50
CCD = "ccd"


def jobs(first: int) -> Iterator[Job]:
    """Every beam and the CCD, as they are and with each effect."""
    for source in (beams.SOURCE, levels.SOURCE):
        if not source.exists():
            sys.exit(f"{source}: is not there; real frames are no part of the repository")
    pairs = [(f"beam {stem}", name) for stem, name in product(beams.stems(), beams.PUT_IN)]
    pairs += [(CCD, name) for name in ("", *levels.PUT_IN)]
    for k, (design, name) in enumerate(pairs):
        yield Job(k, first + k, f"real:{name}" if name else "real", design)


def write(job: Job, folder: Path, truth: Path) -> bool:
    """Frames with an effect put in; the truth knows that one effect and no more."""
    name = job.kind.partition(":")[2]
    if job.design == CCD:
        parameters = levels.write(name, folder)
    else:
        parameters = beams.write(job.design.split()[-1], name, folder)
    effects = [{"name": name, "parameters": parameters, "form": {}}] if name else []
    truth.write_text(json.dumps({"effects": effects}) + "\n", encoding="utf-8")
    return True


def beside(job: Job, folder: Path, results: Path, truth: dict[str, Any], judge: Judge) -> dict[str, Any]:
    """What there is to be seen of a beam."""
    return {} if job.design == CCD else beams.beside(results)


def report(rows: Sequence[Record], folder: Path, name: str, publish: bool) -> str:
    """A page and a picture of the beams, a page of the CCD; those of which every data set was judged."""
    lost = [own for own in rows if own["verdict"] is None]
    spots = [own for own in rows if own["job"]["design"] != CCD]
    flats = {beams.put_in(own): own["verdict"] for own in rows if own["job"]["design"] == CCD}
    if lost or len(rows) < JOBS:
        said = "".join(f"\n{own['job']['kind']} {own['job']['design']}: {own['error']}" for own in lost)
        return f"{len(rows)} of {JOBS} data sets so far, {len(lost)} without a verdict{said}"
    (folder / "real-beams.md").write_text(beams.page(spots), encoding="utf-8")
    beams_picture.draw(beams.seen(spots), folder / "real-beams.png")
    (folder / "real-sensor.md").write_text(sensor.page(flats), encoding="utf-8")
    for file in ("real-beams.md", "real-beams.png", "real-sensor.md") if publish else ():
        shutil.copyfile(folder / file, ROOT / "workflow" / "docs" / file)
    return "\n".join((folder / file).read_text(encoding="utf-8") for file in ("real-beams.md", "real-sensor.md"))
