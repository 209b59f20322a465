"""Differences and trends of numbers, and which of them are significant.

The standard error of a mean of few values is uncertain itself. Differences and slopes are therefore tested with
Student's t distribution at the degrees of freedom of Welch and Satterthwaite (B. L. Welch, Biometrika 34, 28, 1947).
A page tests many numbers. Holm's correction (S. Holm, Scand. J. Statist. 6, 65, 1979) keeps the probability that it
marks anything by chance below `FALSE_ALARM_RATE`, whatever the correlation of the numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from spotcheck.report.comparison.numbers import Measurement

# Family-wise error rate of all differences of a page, and of all its trends. Weekly comparisons give one false alarm
# in two years.
FALSE_ALARM_RATE = 0.01
# Datasets that a trend needs: two points always lie on a line.
MIN_TREND_POINTS = 3


@dataclass(frozen=True)
class Change:
    """A difference or a slope with its two-sided test against zero; NaN if there is no standard error."""

    value: float = np.nan  # difference, or slope per unit of place
    stderr: float = np.nan  # its standard error
    degrees: float = np.nan  # degrees of freedom of the standard error
    z: float = np.nan  # normal deviate with the same p-value and the sign of the value
    p_value: float = np.nan  # two-sided p-value


def difference(reference: Measurement, other: Measurement) -> Change:
    """Return the difference of a number from the reference; its error is NaN if either has none."""
    parts = [(number.stderr**2, number.degrees) for number in (reference, other)]
    return _test_change(other.value - reference.value, *_combine_variances(parts))


def fit_trend(places: Sequence[float], numbers: Sequence[Measurement]) -> tuple[Change, float]:
    """Fit a straight line through numbers.

    All points have equal weight, since standard errors from few repeats are too uncertain for weights. The standard
    error of the slope is the larger of two: the error propagated from the numbers, and that of the scatter about
    the line.

    Parameters
    ----------
    places : sequence of float
        Abscissa of each number.
    numbers : sequence of Measurement
        The numbers.

    Returns
    -------
    slope : Change
        Slope per unit of place; NaN with fewer than `MIN_TREND_POINTS` points.
    intercept : float
        Value of the line at place 0.
    """
    x, y = np.array(places, float), np.array([number.value for number in numbers])
    if len(x) < MIN_TREND_POINTS or np.ptp(x) == 0:
        return Change(), np.nan
    weights = (x - x.mean()) / np.sum((x - x.mean()) ** 2)
    slope = float(weights @ y)
    intercept = float(y.mean() - slope * x.mean())
    parts = [((weight * n.stderr) ** 2, n.degrees) for weight, n in zip(weights, numbers, strict=True)]
    stderr, degrees = _combine_variances(parts)
    residual_variance = np.sum((y - intercept - slope * x) ** 2) / (len(x) - 2)
    scatter_stderr = float(np.sqrt(residual_variance * np.sum(weights**2)))
    # Written so that a NaN of the propagated error gives way to the scatter.
    if not scatter_stderr <= stderr:
        stderr, degrees = scatter_stderr, len(x) - 2.0
    return _test_change(slope, stderr, degrees), intercept


def select_significant(p_values: Sequence[float]) -> np.ndarray:
    """Return which p-values are significant by Holm's step-down procedure [bool]; NaN never is.

    The k-th smallest of n p-values is compared with `FALSE_ALARM_RATE` / (n − k + 1), until the first one is larger.
    """
    p = np.array(p_values, float)
    order = np.argsort(p)[: int(np.isfinite(p).sum())]
    is_below = p[order] <= FALSE_ALARM_RATE / np.arange(len(order), 0, -1)
    is_significant = np.zeros(len(p), bool)
    is_significant[order[np.logical_and.accumulate(is_below)]] = True
    return is_significant


def _combine_variances(parts: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the standard error of a sum and its degrees of freedom, from those of its terms (variance, degrees)."""
    variances, degrees = np.array(parts, float).T
    total = variances.sum()
    if not total > 0:
        return np.nan, np.nan
    inverse = float(np.sum((variances / total) ** 2 / degrees))
    return float(np.sqrt(total)), 1 / inverse if inverse > 0 else np.inf


def _test_change(value: float, stderr: float, degrees: float) -> Change:
    """Test a value against zero."""
    if not stderr > 0:
        return Change(value)
    t = value / stderr
    if np.isinf(degrees):
        return Change(value, stderr, degrees, t, float(2 * stats.norm.sf(abs(t))))
    p = float(2 * stats.t.sf(abs(t), degrees))
    # The p-value may underflow to 0, for which z would be infinite.
    z = float(np.copysign(stats.norm.isf(max(p, np.finfo(float).tiny) / 2), t))
    return Change(value, stderr, degrees, z, p)
