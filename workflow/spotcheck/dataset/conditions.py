"""Merging of exposure times, angles and positions that belong to one condition but were read back separately.

Cameras and stages report actual values, not set values: 0.0100003 s for 0.01 s. Values within a tolerance are one
condition, whose value is the mean of its readings. The manifest is merged when it is read, so that every stage sees the
same conditions.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

# Relative tolerance of exposure times. Lamps and lasers drift by more than 0.1 %, so no sweep has such small steps.
EXPOSURE_TOLERANCE = 1e-3
# Absolute tolerance of angles [deg], about 1e-3 rad: some ten times the repeatability of a rotation stage.
ANGLE_TOLERANCE_DEG = 0.05
# Tolerance of declared conditions relative to their range: a position has no natural zero.
RANGE_TOLERANCE = 1e-3
# Largest range of a column [relative to its largest value] at which values that mostly differ look like readings of one
# set value: by column, and for all other columns. Sweeps of exposures and of positions have larger ranges.
READ_BACK_RANGE, READ_BACK_RANGE_DEFAULT = {"exposure_s": 0.1}, 1e-3
# Fewest distinct values of a column that may look like readings of fewer set values.
FEWEST_VALUES = 3
# Fewest repeats of a dataset of which some are held out.
FEWEST_REPEATS = 6


def held_out_repeats(repeats: np.ndarray) -> np.ndarray:
    """Return which frames are held out for a validation: every third repeat (2, 5, 8, …) if there are six or more.

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

    values: list[float | None]  # for each value the mean of its group, in the unit of the column; None stays None
    unmerged_groups: list[tuple[float, float, int]]  # (lowest, highest, number of distinct values) of too wide groups


def merge_values(column: str, values: Sequence[float | None]) -> MergedValues:
    """Merge the values of a column that belong to one condition: replace them by their mean.

    Sorted values with steps below the tolerance form a group. A group wider than the tolerance may be a fine sweep, so
    it is not merged.

    Parameters
    ----------
    column : name of the column, which selects the tolerance.
    values : the values in the unit of the column; None where blank.

    Returns
    -------
    MergedValues
        The merged values in the order of `values`, and the groups that are too wide to be merged.
    """
    known_values = np.array([value for value in values if value is not None])
    if not known_values.size:
        return MergedValues(list(values), [])
    distinct = np.unique(known_values)
    tolerances = _get_tolerances(column, distinct)
    # A group starts behind each step that exceeds the tolerance of the value below it.
    starts = np.flatnonzero(np.diff(distinct) > tolerances[:-1]) + 1
    means: dict[float, float] = {}
    unmerged_groups = []
    for group, group_tolerances in zip(np.split(distinct, starts), np.split(tolerances, starts), strict=True):
        low, high = float(group[0]), float(group[-1])
        if high - low > group_tolerances[0]:
            unmerged_groups.append((low, high, len(group)))
        elif len(group) > 1:
            # The mean of all rows, in which a value may occur several times.
            in_group = (known_values >= low) & (known_values <= high)
            means |= dict.fromkeys(group.tolist(), float(known_values[in_group].mean()))
    return MergedValues([None if value is None else means.get(value, value) for value in values], unmerged_groups)


def _get_tolerances(column: str, distinct: np.ndarray) -> np.ndarray:
    """Return the largest distance at which another value still belongs to the same condition, for each value [value].

    `distinct` are the distinct values of a column in ascending order [value]; tolerances are in their unit.
    """
    if column == "exposure_s":
        return EXPOSURE_TOLERANCE * distinct
    absolute = ANGLE_TOLERANCE_DEG if column == "angle_deg" else RANGE_TOLERANCE * (distinct[-1] - distinct[0])
    return np.full(distinct.shape, absolute)


def check_spread(column: str, values: Sequence[float | None]) -> list[str]:
    """Return remarks on a column whose values, although merged, look like scattered readings of fewer set values.

    Parameters
    ----------
    column : name of the column.
    values : merged values of the spot frames, in the unit of the column; None where blank.

    Returns
    -------
    list of str
        One sentence for the whole column or for each unmerged group; empty if nothing is suspicious.
    """
    known_values = [value for value in values if value is not None]
    distinct = sorted(set(known_values))
    if len(distinct) < FEWEST_VALUES:
        return []
    low, high = distinct[0], distinct[-1]
    advice = "if a device reported them, write in each row the value that was set"
    read_back_range = READ_BACK_RANGE.get(column, READ_BACK_RANGE_DEFAULT)
    if len(distinct) > len(known_values) / 2 and high - low < read_back_range * max(abs(low), abs(high)):
        return [
            f"manifest.csv: {column} has {len(distinct)} different values in {len(known_values)} spot rows, all from"
            f" {low:.6g} to {high:.6g}: nearly every frame is a condition of its own; {advice}"
        ]
    return [
        f"manifest.csv: {column} has {count} different values from {first:.6g} to {last:.6g} in steps below the"
        f" tolerance: each is a condition of its own; {advice}"
        for first, last, count in merge_values(column, known_values).unmerged_groups
    ]
