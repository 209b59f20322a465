"""What a generator of data sets is.

A data set is a folder as the dataset contract has it (frames, manifest.csv, instrument.yaml), and a truth file that
lies elsewhere and is read by scorers alone. A truth has `effects`, a list of objects with `name`, `parameters` and
`form`; what else it holds is its generator's own.
"""

import csv
import importlib
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast

Record = dict[str, Any]


class Job(NamedTuple):
    """One data set to be made and judged: its number in the plan, its seed, what is put into it in the words of its
    generator, and its design."""

    number: int
    seed: int
    kind: str
    design: str


class Generator(Protocol):
    """A module that makes data sets: tests.validation.generators.<name>.generator."""

    # ASSUME: seeds from FIRST on had no part in tuning.
    FIRST: int
    # How many jobs a call looks at.
    JOBS: int

    def jobs(self, first: int) -> Iterator[Job]:
        """Jobs in an order of which every beginning is balanced, with seeds from `first` on."""

    def write(self, job: Job, folder: Path, truth: Path) -> bool:
        """Write a dataset folder and the truth; False where the job is passed over."""

    def unaltered(self, record: Record) -> Job | None:
        """The job of a judged set without what was put in, whose names count as there; None where it tells nothing."""

    def report(self, records: Sequence[Record], folder: Path, name: str, publish: bool) -> str:
        """Write pages into a folder of results, with `publish` into the repository too; returns what to print."""


def generator(name: str) -> Generator:
    """The generator of a name."""
    return cast(Generator, importlib.import_module(f"tests.validation.generators.{name}.generator"))


def deal(shares: dict[str, int]) -> Iterator[str]:
    """Names without end, each as often as its share wants and spread evenly: the most overdue comes next."""
    total, given = sum(shares.values()), dict.fromkeys(shares, 0)
    for number in count(1):
        name = max(shares, key=lambda own: shares[own] * number / total - given[own])
        given[name] += 1
        yield name


def manifest_of(folder: Path) -> list[dict[str, str]]:
    """The rows of a folder's manifest as they stand."""
    with (folder / "manifest.csv").open(encoding="utf-8") as stream:
        return list(csv.DictReader(line for line in stream if not line.startswith("#")))
