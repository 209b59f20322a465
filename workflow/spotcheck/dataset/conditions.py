"""Which readings of an exposure, an angle or a position are one condition, though each was read back anew.

Cameras and stages report what they did, not what they were told: 0.0100003 s for 0.01 s. Values that differ by no more
than a tolerance are one condition, whose value is the mean of its readings. This is done once, where the manifest is
read, so that every stage sees the same conditions.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

# Exposures are one if the longest is longer than the shortest by no more than this part: their light then differs by
# 0.1 %, less than lamps and lasers drift; a sweep in steps as small could not be seen to grow.
EXPOSURE_PART = 1e-3
# Angles are one within this [deg], about 1e-3 rad: some ten times the repeatability of a rotation stage.
ANGLE_DEG = 0.05
# Values of a declared condition are one within this part of the range that they span: a position has no natural zero
# that it could be measured from.
RANGE_PART = 1e-3
# Values of which most are different, and that span less than this part of themselves, look like one that was read back:
# exposures of a sweep differ by more, and so do positions. By chance some of them lie within the tolerance.
ALIKE = {"exposure_s": 0.1}
ALIKE_OTHERS = 1e-3


class Readings(NamedTuple):
    """Values of a column, each the mean of its group; and groups [lowest, highest, count] that hang together by steps
    below the tolerance, but are wider than it, so that their values were left as they are."""

    values: list[float | None]
    too_wide: list[tuple[float, float, int]]


def tolerance_of(column: str, values: Sequence[float]) -> Callable[[float], float]:
    """How far above a value of a column another may lie and be the same, in the column's unit."""
    if column == "exposure_s":
        return lambda value: EXPOSURE_PART * value
    if column == "angle_deg":
        return lambda value: ANGLE_DEG
    span = max(values) - min(values)
    return lambda value: RANGE_PART * span


def grouped(column: str, values: Sequence[float | None]) -> Readings:
    """The values of a column with those that are one condition made equal; None stays None."""
    known = np.array([value for value in values if value is not None])
    if not known.size:
        return Readings(list(values), [])
    tolerance = tolerance_of(column, known.tolist())
    distinct = np.unique(known)
    steps = [k for k in range(1, len(distinct)) if distinct[k] - distinct[k - 1] > tolerance(distinct[k - 1])]
    common: dict[float, float] = {}
    too_wide = []
    for group in np.split(distinct, steps):
        low, high = float(group[0]), float(group[-1])
        if high - low > tolerance(low):
            too_wide.append((low, high, len(group)))
        elif len(group) > 1:
            common |= dict.fromkeys(group.tolist(), float(known[(known >= low) & (known <= high)].mean()))
    return Readings([None if value is None else common.get(value, value) for value in values], too_wide)


def remarks_on(column: str, values: Sequence[float | None]) -> list[str]:
    """What is odd about the values of the spots in a column, once they are grouped: sentences for the user."""
    known = [value for value in values if value is not None]
    distinct = sorted(set(known))
    if len(distinct) < 3:
        return []
    low, high = distinct[0], distinct[-1]
    right = "write the value that was set, the same in every row that shares it, if they are read back"
    alike = ALIKE.get(column, ALIKE_OTHERS)
    if len(distinct) > len(known) / 2 and high - low < alike * max(abs(low), abs(high)):
        return [
            f"manifest.csv: {column} has {len(distinct)} different values in {len(known)} spot rows, all from"
            f" {low:.6g} to {high:.6g}: nearly every frame is a condition of its own; {right}"
        ]
    return [
        f"manifest.csv: {column} has {count} different values from {first:.6g} to {last:.6g} in steps below the"
        f" tolerance: each is a condition of its own; {right}"
        for first, last, count in grouped(column, known).too_wide
    ]
