"""The second generator's data sets, and what becomes of them."""

import json
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path

import numpy as np

from tests.validation import outcome
from tests.validation.generators.second.case import DESIGNS
from tests.validation.generators.second.draw import write_case
from tests.validation.generators.second.effects import VOCABULARY
from tests.validation.generators.second.outside import MECHANISMS
from tests.validation.protocol import Job, Record
from tests.validation.table import markdown

FIRST = 9_000_000
JOBS = 100
# Designs in which every effect can show.
FULL = ("default", "default", "default", "three_repeats", "eight_angles")


def jobs(first: int) -> Iterator[Job]:
    """Sets without end; of ten, six hide one effect, two a pair, one a mechanism outside the vocabulary, one none."""
    names, outside, designs = list(VOCABULARY), list(MECHANISMS), list(DESIGNS)
    for k in count():
        turn, place = divmod(k, 10)
        rng = np.random.default_rng([first, k])
        if place < 6:
            at = 6 * turn + place
            kind, design = f"one:{names[at % len(names)]}:strong", FULL[at // len(names) % len(FULL)]
        elif place < 8:
            kind, design = f"two:{'+'.join(rng.choice(names, 2, replace=False))}:strong", "default"
        elif place == 8:
            kind, design = f"outside:{outside[turn % len(outside)]}:strong", "default"
        else:
            kind, design = "none", designs[turn % len(designs)]
        yield Job(k, first + k, kind, design)


def write(job: Job, folder: Path, truth: Path) -> bool:
    """A set of the second generator."""
    number, *names = job.kind.split(":")[:2]
    hidden = [name for own in names for name in own.split("+")]
    hidden = [f"outside:{name}" for name in hidden] if number == "outside" else hidden
    truth.write_text(json.dumps(write_case(job.seed, hidden, job.design, folder), indent=2) + "\n", encoding="utf-8")
    return True


def report(rows: Sequence[Record], folder: Path, name: str, publish: bool) -> str:
    """Sets by what was hidden and what became of them, and a line for each that is not right."""
    table = markdown(("hidden", "sets", *outcome.COUNTED), outcome.by_kind(rows))
    lines = [f"- {said}" for said in map(outcome.line, rows) if said]
    text = "\n".join([*table, "", *lines, ""])
    (folder / "second.md").write_text(text, encoding="utf-8")
    return text
