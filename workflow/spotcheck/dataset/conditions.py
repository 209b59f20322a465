"""Merging of exposure times, angles and positions that belong to one condition but were read back separately.

Cameras and stages report actual values, not set values: 0.0100003 s for 0.01 s. Values within a tolerance are one
condition, whose value is the mean of its readings. The manifest is merged when it is read, so that every stage sees the
same conditions.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

# Relative tolerance of exposure times: 0.1 % of the light is less than lamps and lasers drift, and a sweep in such
# small steps could not show a growth.
EXPOSURE_TOLERANCE = 1e-3
# Absolute tolerance of angles [deg], about 1e-3 rad: some ten times the repeatability of a rotation stage.
ANGLE_TOLERANCE_DEG = 0.05
# Tolerance of declared conditions relative to their range: a position has no natural zero.
RANGE_TOLERANCE = 1e-3
# Mostly different values whose relative range is below this look like one set value that was read back. Steps of
# exposure sweeps and of positions are larger.
READ_BACK_RANGE = {"exposure_s": 0.1}
READ_BACK_RANGE_DEFAULT = 1e-3


# Repeats from which on every third one is held out.
FEWEST_REPEATS = 6


def held_out_repeats(repeats: np.ndarray) -> np.ndarray:
    """Return which repeats are held out, for a validation: every third one (2, 5, 8, …) of six or more.

    Parameters
    ----------
    repeats : array
        Number of the repeat of each frame, of any shape.

    Returns
    -------
    array of bool
        True for frames that no search or fit of effects may use, in the shape of `repeats`.
    """
    numbers = np.unique(repeats)
    return np.isin(repeats, numbers[2::3]) & (len(numbers) >= FEWEST_REPEATS)


class MergedValues(NamedTuple):
    """Values of a column after merging."""

    values: list[float | None]  # the mean of its group for each value; None stays None
    unmerged_groups: list[tuple[float, float, int]]  # (lowest, highest, count): small steps, but wider than tolerated


def merge_values(column: str, values: Sequence[float | None]) -> MergedValues:
    """Merge the values of a column that belong to one condition.

    Sorted values with steps below the tolerance form a group. A group wider than the tolerance is not merged.

    Parameters
    ----------
    column : name of the column, which selects the tolerance.
    values : the values in the unit of the column; None where blank.
    """
    known = np.array([value for value in values if value is not None])
    if not known.size:
        return MergedValues(list(values), [])
    distinct = np.unique(known)
    tolerances = _get_tolerances(column, distinct)
    starts = np.flatnonzero(np.diff(distinct) > tolerances[:-1]) + 1
    means: dict[float, float] = {}
    unmerged_groups = []
    for group, group_tolerances in zip(np.split(distinct, starts), np.split(tolerances, starts), strict=True):
        low, high = float(group[0]), float(group[-1])
        if high - low > group_tolerances[0]:
            unmerged_groups.append((low, high, len(group)))
        elif len(group) > 1:
            means |= dict.fromkeys(group.tolist(), float(known[(known >= low) & (known <= high)].mean()))
    return MergedValues([None if value is None else means.get(value, value) for value in values], unmerged_groups)


def _get_tolerances(column: str, distinct: np.ndarray) -> np.ndarray:
    """Return how far above each ascending value of a column another value may lie to belong to its condition."""
    if column == "exposure_s":
        return EXPOSURE_TOLERANCE * distinct
    absolute = ANGLE_TOLERANCE_DEG if column == "angle_deg" else RANGE_TOLERANCE * (distinct[-1] - distinct[0])
    return np.full(distinct.shape, absolute)


def check_spread(column: str, values: Sequence[float | None]) -> list[str]:
    """Return remarks on a column whose merged values still look like readings of fewer set values.

    Parameters
    ----------
    column : name of the column.
    values : merged values of the spot frames; None where blank.
    """
    known = [value for value in values if value is not None]
    distinct = sorted(set(known))
    if len(distinct) < 3:
        return []
    low, high = distinct[0], distinct[-1]
    advice = "write the value that was set, the same in every row that shares it, if they are read back"
    read_back_range = READ_BACK_RANGE.get(column, READ_BACK_RANGE_DEFAULT)
    if len(distinct) > len(known) / 2 and high - low < read_back_range * max(abs(low), abs(high)):
        return [
            f"manifest.csv: {column} has {len(distinct)} different values in {len(known)} spot rows, all from"
            f" {low:.6g} to {high:.6g}: nearly every frame is a condition of its own; {advice}"
        ]
    return [
        f"manifest.csv: {column} has {count} different values from {first:.6g} to {last:.6g} in steps below the"
        f" tolerance: each is a condition of its own; {advice}"
        for first, last, count in merge_values(column, known).unmerged_groups
    ]
