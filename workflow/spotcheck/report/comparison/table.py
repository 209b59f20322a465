"""The comparison of several datasets: every number they share, what differs from the first, and trends."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spotcheck.dataset.manifest import DATE
from spotcheck.discrepancy.words import value_text
from spotcheck.report.comparison.changes import Change, beyond_chance, difference, trend
from spotcheck.report.comparison.numbers import ABSENT, Condition, Name, Number
from spotcheck.report.comparison.sets import Set, common, in_other_units, read_sets

DAY_S = 86400.0
# Axes of the grid that a person tells by their unit alone.
PLAIN_AXES = ("angle", "exposure")
UNKNOWN = Change(*[np.nan] * 5)


class Row(NamedTuple):
    """A number that datasets share: by dataset its value (`ABSENT` where one has none), its difference from the first
    dataset that has it and whether that is beyond chance; its trend, its line's value at place 0, and whether the trend
    is beyond chance."""

    name: Name
    numbers: list[Number]
    changes: list[Change]
    changed: list[bool]
    trend: Change
    level: float
    rising: bool

    @property
    def first(self) -> int:
        """Place of the first dataset that has the number."""
        return next(k for k, own in enumerate(self.numbers) if np.isfinite(own.value))

    @property
    def units(self) -> str:
        """Unit of the number."""
        return self.numbers[self.first].units


class Comparison(NamedTuple):
    """The datasets, the rows, where each dataset lies on the axis of trends with that axis in words and its unit, and
    remarks on what could not be compared."""

    sets: list[Set]
    rows: list[Row]
    places: list[float]
    along: str
    per: str
    remarks: list[str]

    @property
    def tested(self) -> int:
        """Differences that have an error, among which those beyond chance were looked for."""
        return sum(np.isfinite(own.p_value) for row in self.rows for own in row.changes)

    @property
    def trends(self) -> int:
        """The same of trends."""
        return sum(np.isfinite(row.trend.p_value) for row in self.rows)


def compare(folders: Sequence[Path]) -> Comparison:
    """Compare the datasets of results folders with the first of them. Raises `InputError` as `read_sets` does."""
    sets = read_sets(folders)
    places, along, per, remarks = _places(sets)
    names = common(sets)
    numbers = [[own.numbers.get(name, ABSENT) for own in sets] for name in names]
    changes = [_changes(own) for own in numbers]
    lines = [_trend(places, own) for own in numbers]
    changed = beyond_chance([own.p_value for row in changes for own in row]).reshape(len(names), len(sets))
    rising = beyond_chance([own.p_value for own, _ in lines])
    rows = [
        Row(name, own, change, beyond.tolist(), line[0], line[1], bool(rises))
        for name, own, change, beyond, line, rises in zip(names, numbers, changes, changed, lines, rising, strict=True)
    ]
    return Comparison(sets, rows, places, along, per, [*in_other_units(sets), *remarks])


def _changes(numbers: Sequence[Number]) -> list[Change]:
    """Differences from the first dataset that has the number."""
    first = next(k for k, own in enumerate(numbers) if np.isfinite(own.value))
    return [UNKNOWN if k == first else difference(numbers[first], own) for k, own in enumerate(numbers)]


def _trend(places: Sequence[float], numbers: Sequence[Number]) -> tuple[Change, float]:
    """Slope over the datasets that have the number."""
    known = [(place, own) for place, own in zip(places, numbers, strict=True) if np.isfinite(own.value)]
    return trend([place for place, _ in known], [own for _, own in known])


def _places(sets: Sequence[Set]) -> tuple[list[float], str, str, list[str]]:
    """Places of the datasets on the axis of trends: days since the first where all have dates that differ, else the
    order in which they were given; the axis in words, its unit, and remarks."""
    order = [float(k) for k in range(len(sets))], "order of the datasets", "dataset"
    times = [own.taken for own in sets]
    dated = [own for own in times if own is not None]
    if not dated:
        return *order, []
    if len(dated) < len(sets):
        without = ", ".join(own.label for own in sets if own.taken is None)
        why = f"column {DATE} of {without} is missing, incomplete or not ISO 8601"
        return *order, [f"Trends follow the order of the datasets: {why}"]
    days = [(own - min(dated)).total_seconds() / DAY_S for own in dated]
    if np.ptp(days) == 0:
        return *order, []
    return days, f"days since {min(dated):%Y-%m-%d}", "day", []


def where_text(where: Sequence[Condition]) -> str:
    """A condition in words: `45°, 100 µs, z_m 200 mm`."""
    return ", ".join(
        f"{'' if axis in PLAIN_AXES else axis} {value_text(value, None, unit)}".strip() for axis, value, unit in where
    )


def full_text(name: Name) -> str:
    """What a number is of, with its condition."""
    return ", ".join(filter(None, (name.what, where_text(name.where))))
