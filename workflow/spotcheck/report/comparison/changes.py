"""Which numbers of two datasets differ beyond their errors, and which of several follow a line.

An error that comes from the scatter of few values is itself known badly, so differences and slopes are judged by
Student's law at the degrees of freedom of Welch and Satterthwaite (B. L. Welch, Biometrika 34, 28, 1947). Many numbers
are looked at together: Holm's steps (S. Holm, Scand. J. Statist. 6, 65, 1979) keep the rate at which a page marks
anything by chance at `FALSE_ALARMS`, however the numbers hang together.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from spotcheck.report.comparison.numbers import Number

# Part of the pages of equal datasets that mark any difference; and again, that mark any trend. One in a hundred: who
# compares every week is misled once in two years.
FALSE_ALARMS = 0.01
# Points that show a trend: through two of them there is always a line.
FEWEST = 3


class Change(NamedTuple):
    """A difference or a slope with its standard error and the degrees of freedom of that, and how odd it would be by
    chance: p-value (two-sided), and z, the deviate of a normal law that is as odd, with the sign of the value. NaN
    where an error is not known."""

    value: float
    stderr: float
    degrees: float
    z: float
    p_value: float


def difference(first: Number, other: Number) -> Change:
    """The other number less the first; without error where one of them has none."""
    parts = [(own.stderr**2, own.degrees) for own in (first, other)]
    return _judged(other.value - first.value, *_combined(parts))


def trend(at: Sequence[float], numbers: Sequence[Number]) -> tuple[Change, float]:
    """Slope of the straight line through numbers at places `at`, per unit of place, and the line's value at place 0.

    All points weigh alike, since errors from few repeats are no weights. The slope's error is the larger of two: that
    which follows from the numbers' errors, and that which their scatter about the line shows.
    """
    x, y = np.array(at, float), np.array([own.value for own in numbers])
    if len(x) < FEWEST or np.ptp(x) == 0:
        return _judged(np.nan, np.nan, np.nan), np.nan
    weights = (x - x.mean()) / np.sum((x - x.mean()) ** 2)
    slope = float(weights @ y)
    level = float(y.mean() - slope * x.mean())
    error, degrees = _combined(
        [((weight * own.stderr) ** 2, own.degrees) for weight, own in zip(weights, numbers, strict=True)]
    )
    scattered = float(np.sqrt(np.sum((y - level - slope * x) ** 2) / (len(x) - 2) * np.sum(weights**2)))
    if not scattered <= error:
        error, degrees = scattered, len(x) - 2.0
    return _judged(slope, error, degrees), level


def beyond_chance(p_values: Sequence[float]) -> np.ndarray:
    """Which of many p-values count, by Holm: the smallest below FALSE_ALARMS over their number, the next below
    FALSE_ALARMS over one less, until one is not. NaN never counts."""
    p = np.array(p_values, float)
    order = np.argsort(p)[: int(np.isfinite(p).sum())]
    steps = p[order] <= FALSE_ALARMS / np.arange(len(order), 0, -1)
    out = np.zeros(len(p), bool)
    out[order[np.logical_and.accumulate(steps)]] = True
    return out


def _combined(parts: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Standard error of a sum, and its degrees of freedom, from the variances and degrees of freedom of its parts."""
    variances, degrees = np.array(parts, float).T
    total = variances.sum()
    if not total > 0:
        return np.nan, np.nan
    inverse = float(np.sum((variances / total) ** 2 / degrees))
    return float(np.sqrt(total)), 1 / inverse if inverse > 0 else np.inf


def _judged(value: float, stderr: float, degrees: float) -> Change:
    if not stderr > 0:
        return Change(value, *[np.nan] * 4)
    t = value / stderr
    if np.isinf(degrees):
        return Change(value, stderr, degrees, t, float(2 * stats.norm.sf(abs(t))))
    p = float(2 * stats.t.sf(abs(t), degrees))
    # A p-value may underflow, z may not.
    z = float(np.copysign(stats.norm.isf(max(p, np.finfo(float).tiny) / 2), t))
    return Change(value, stderr, degrees, z, p)
