"""What a part of the benchmark hands back, and how it is printed, judged and written."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from tests.validation.table import markdown


class Limit(NamedTuple):
    """A figure has to be at least (`≥`) or at most (`≤`) a value."""

    sense: str
    value: float
    unit: str = ""

    def reached_by(self, value: float) -> bool:
        """Whether a value keeps the limit; NaN keeps none."""
        return value >= self.value if self.sense == "≥" else value <= self.value

    def __str__(self) -> str:
        return f"{self.sense} {self.value:g}{self.unit}"


class Figure(NamedTuple):
    """A measured number: what it is, the number, how it is shown, and what it must and should be."""

    name: str
    value: float
    shown: str
    must: Limit | None = None
    aim: Limit | None = None

    @property
    def verdict(self) -> str:
        """`reached` or `MISSED` for the must, then the same for the aim."""
        words = []
        if self.must:
            words.append("reached" if self.must.reached_by(self.value) else "MISSED")
        if self.aim:
            words.append("aim reached" if self.aim.reached_by(self.value) else "aim missed")
        return ", ".join(words)


class Table(NamedTuple):
    """A table of details with a sentence under it."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


class Point(NamedTuple):
    """One method for the plot: panel, kind, name, time [ms] with its spread, and rms error in bounds (NaN: none)."""

    panel: str
    kind: str
    name: str
    low: float
    middle: float
    high: float
    rms: float = np.nan


class Part(NamedTuple):
    """All that a part of the benchmark found."""

    title: str
    figures: Sequence[Figure]
    tables: Sequence[Table] = ()
    points: Sequence[Point] = ()


class Spread(NamedTuple):
    """Median and the 10 % and 90 % quantiles of repeated measurements."""

    low: float
    middle: float
    high: float

    def shown(self, digits: int = 2) -> str:
        """`median (10 %–90 %)`."""
        return f"{self.middle:.{digits}f} ({self.low:.{digits}f}–{self.high:.{digits}f})"


def spread(values: Iterable[float]) -> Spread:
    """Median and 10–90 % of values."""
    return Spread(*np.quantile(np.array(list(values), float), [0.1, 0.5, 0.9]))


def ratio_figure(name: str, ratios: Iterable[float], must: Limit | None = None, aim: Limit | None = None) -> Figure:
    """A figure of a ratio that was taken round by round: judged by its median."""
    found = spread(ratios)
    return Figure(name, found.middle, f"× {found.shown(1)}", must, aim)


COLUMNS = ("figure", "measured", "must", "aim", "verdict")


def figure_rows(part: Part) -> list[tuple[str, ...]]:
    """The rows of a part's figures under `COLUMNS`."""
    return [(f.name, f.shown, str(f.must or ""), str(f.aim or ""), f.verdict) for f in part.figures]


def as_markdown(parts: Sequence[Part], head: Sequence[str]) -> str:
    """Tables of figures and details of every part, as Markdown."""
    out = ["# Benchmark", "", *head]
    for part in parts:
        out += ["", f"## {part.title}", ""]
        out += markdown(COLUMNS, figure_rows(part))
        for table in part.tables:
            out += ["", f"**{table.title}**", "", *markdown(table.columns, table.rows)]
            out += ["", table.note] if table.note else []
    return "\n".join([*out, "", summary(parts), ""])


def as_summary(parts: Sequence[Part]) -> str:
    """All figures as one Markdown table with the count under it."""
    rows = [row for part in parts for row in figure_rows(part)]
    return "\n".join([*markdown(COLUMNS, rows), "", f"{summary(parts)}.", ""])


def all_musts_reached(parts: Sequence[Part]) -> bool:
    """Whether no must of any part was missed."""
    return all(f.must.reached_by(f.value) for part in parts for f in part.figures if f.must)


def summary(parts: Sequence[Part]) -> str:
    """How many musts and aims were reached."""
    figures = [f for part in parts for f in part.figures]
    musts = [f.must.reached_by(f.value) for f in figures if f.must]
    aims = [f.aim.reached_by(f.value) for f in figures if f.aim]
    return f"{sum(musts)} of {len(musts)} musts reached, {sum(aims)} of {len(aims)} aims"
