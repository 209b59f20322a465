"""A figure of the table: a number with its interval, what it must and should be, and whether it is."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from tests.validation.intervals import clopper_pearson
from tests.validation.protocol import Record


class Range(NamedTuple):
    """What a figure has to be: from low to high, and how that is written."""

    low: float
    high: float
    text: str

    def holds(self, value: float) -> bool:
        """Whether a value lies within; NaN does not."""
        return self.low <= value <= self.high


class Figure(NamedTuple):
    """A measured figure of so many sets. `judged` is the number that must and aim are held against (if not the value
    itself); `short_of` says what is missing for it to count."""

    name: str
    value: float
    interval: tuple[float, float]
    sets: int
    unit: str
    must: Range | None = None
    aim: Range | None = None
    judged: float | None = None
    short_of: str = ""
    note: str = ""

    def verdict(self) -> str:
        """`ok` or `short` by the must, with `aim` where that is reached too; `too few` where nothing can be said."""
        if not self.sets or np.isnan(self.value):
            return "not measured"
        if self.must is None:
            return ""
        held = self.value if self.judged is None else self.judged
        word = "ok" if self.must.holds(held) else "short"
        aim = ", aim" if self.aim and self.aim.holds(held) and word == "ok" and not self.short_of else ""
        return word + aim + (f" (too few: {self.short_of})" if self.short_of else "")


def at_least(must: float, aim: float) -> tuple[Range, Range]:
    """Shares that have to be large."""
    return Range(must, np.inf, f"≥ {100 * must:g} %"), Range(aim, np.inf, f"≥ {100 * aim:g} %")


def at_most(must: float, aim: float) -> tuple[Range, Range]:
    """Numbers that have to be small."""
    return Range(-np.inf, must, f"≤ {must:g}"), Range(-np.inf, aim, f"≤ {aim:g}")


def share(
    name: str,
    records: Sequence[Record],
    test: Callable[[Record], bool],
    wanted: tuple[Range | None, Range | None] = (None, None),
    short_of: str = "",
) -> Figure:
    """How many of the records pass a test."""
    hits = sum(map(test, records))
    value = hits / len(records) if records else np.nan
    must, aim = wanted
    interval = clopper_pearson(hits, len(records))
    return Figure(name, value, interval, len(records), "%", must, aim, short_of=short_of)
