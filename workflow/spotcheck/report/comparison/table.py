"""Comparison of several datasets: shared numbers, differences from the first dataset, and trends.

A trend is the slope of a straight line through one number of every dataset, over their dates or their order.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spotcheck.dataset.manifest import DATE
from spotcheck.io.number_text import quantity_text
from spotcheck.report.comparison.changes import Change, difference, fit_trend, select_significant
from spotcheck.report.comparison.datasets import DatasetResults, list_shared, list_unit_conflicts, read_datasets
from spotcheck.report.comparison.numbers import ABSENT, Condition, Measurement, QuantityName

SECONDS_PER_DAY = 86400.0
# Design axes whose values are written without the name of the axis, since the unit identifies the axis.
AXES_KNOWN_BY_UNIT = ("angle", "exposure")


@dataclass(frozen=True)
class Row:
    """A number that at least two datasets share; lists have one element for each dataset."""

    name: QuantityName  # what is compared
    numbers: list[Measurement]  # the number in each dataset; `ABSENT` if a dataset lacks it
    changes: list[Change]  # differences from the first dataset that has the number; NaN for that one
    is_changed: list[bool]  # whether the difference is significant
    trend: Change  # slope over the datasets; NaN if too few have the number
    intercept: float  # value of the trend line at place 0 of the trend axis [units]; NaN without a trend
    has_trend: bool  # whether the slope is significant

    @property
    def first(self) -> int:
        """Index of the first dataset that has the number."""
        return _find_first(self.numbers)

    @property
    def units(self) -> str:
        """Unit of the number, which is the same in all datasets."""
        return self.numbers[self.first].units


class TrendAxis(NamedTuple):
    """Abscissa of the trends."""

    places: list[float]  # position of each dataset [unit]
    name: str  # meaning of the axis
    unit: str  # unit of the axis: "day", or "dataset" if the places are 0, 1, 2, …


@dataclass(frozen=True)
class Comparison:
    """Comparison of datasets with the first of them."""

    datasets: list[DatasetResults]  # the datasets, the reference first
    rows: list[Row]  # the shared numbers
    axis: TrendAxis  # abscissa of the trends
    remarks: list[str]  # sentences on what could not be compared, and why

    @property
    def tested_changes(self) -> int:
        """Number of differences that were tested."""
        return sum(np.isfinite(change.p_value) for row in self.rows for change in row.changes)

    @property
    def tested_trends(self) -> int:
        """Number of trends that were tested."""
        return sum(np.isfinite(row.trend.p_value) for row in self.rows)


def compare_datasets(folders: Sequence[Path]) -> Comparison:
    """Return the comparison of the datasets of results folders; raises `InputError` as `read_datasets` does."""
    datasets = read_datasets(folders)
    axis, remarks = _choose_trend_axis(datasets)
    names = list_shared(datasets)
    # The outer lists have one element for each name, the inner ones one for each dataset.
    numbers = [[dataset.numbers.get(name, ABSENT) for dataset in datasets] for name in names]
    changes = [_compare_with_first(row_numbers) for row_numbers in numbers]
    slopes, intercepts = zip(*(_fit_known(axis.places, row_numbers) for row_numbers in numbers), strict=True)
    p_values = [change.p_value for row_changes in changes for change in row_changes]
    is_changed = select_significant(p_values).reshape(len(names), len(datasets)).tolist()
    has_trend = select_significant([slope.p_value for slope in slopes]).tolist()
    # The lists are in the order of the fields of `Row`.
    fields = zip(names, numbers, changes, is_changed, slopes, intercepts, has_trend, strict=True)
    rows = [Row(*row_fields) for row_fields in fields]
    return Comparison(datasets, rows, axis, [*list_unit_conflicts(datasets), *remarks])


def _find_first(numbers: Sequence[Measurement]) -> int:
    """Return the index of the first dataset that has the number."""
    return next(k for k, number in enumerate(numbers) if np.isfinite(number.value))


def _compare_with_first(numbers: Sequence[Measurement]) -> list[Change]:
    """Return the difference of each dataset from the first one that has the number; NaN for the first itself."""
    first = _find_first(numbers)
    return [Change() if k == first else difference(numbers[first], number) for k, number in enumerate(numbers)]


def _fit_known(places: Sequence[float], numbers: Sequence[Measurement]) -> tuple[Change, float]:
    """Return slope and intercept of a line through the datasets that have the number, as `fit_trend` does."""
    known = [k for k, number in enumerate(numbers) if np.isfinite(number.value)]
    return fit_trend([places[k] for k in known], [numbers[k] for k in known])


def _choose_trend_axis(datasets: Sequence[DatasetResults]) -> tuple[TrendAxis, list[str]]:
    """Return the axis of trends, and sentences on why it is not the date.

    The axis is the date in days if all datasets have a date and not all dates are equal, else their order.
    There is a sentence only if some datasets have a date and others have none.
    """
    order = TrendAxis([float(k) for k in range(len(datasets))], "order of the datasets", "dataset")
    times = [dataset.mean_time for dataset in datasets if dataset.mean_time is not None]
    if not times:
        return order, []
    if len(times) < len(datasets):
        undated = ", ".join(dataset.label for dataset in datasets if dataset.mean_time is None)
        reason = f"column {DATE} of {undated} is missing, incomplete or not ISO 8601"
        return order, [f"Trends follow the order of the datasets: {reason}"]
    days = [(time - min(times)).total_seconds() / SECONDS_PER_DAY for time in times]
    return (TrendAxis(days, f"days since {min(times):%Y-%m-%d}", "day") if np.ptp(days) > 0 else order), []


def conditions_text(conditions: Sequence[Condition]) -> str:
    """Return conditions as text: `45°, 100 µs, z_m 200 mm`; "" without conditions."""
    names = ("" if condition.axis in AXES_KNOWN_BY_UNIT else condition.axis for condition in conditions)
    values = (quantity_text(condition.value, None, condition.unit) for condition in conditions)
    return ", ".join(f"{name} {value}".strip() for name, value in zip(names, values, strict=True))


def label_quantity(name: QuantityName) -> str:
    """Return a quantity and its conditions as text: `amplitude, 45°, 100 µs`."""
    return ", ".join(filter(None, (name.quantity, conditions_text(name.conditions))))
