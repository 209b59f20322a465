"""Differences and trends of numbers of several datasets, and which of them are significant.

A trend is the slope of a straight line through one number of every dataset, over their dates or their order. The
standard error of a mean of few values is uncertain itself. Differences and slopes are therefore tested with
Student's t distribution at the degrees of freedom of Welch and Satterthwaite (B. L. Welch, Biometrika 34, 28, 1947).
A comparison tests many numbers. Holm's correction (S. Holm, Scand. J. Statist. 6, 65, 1979) keeps the probability that
any of them is significant by chance below `FALSE_ALARM_RATE`, whatever the correlation of the numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from spotcheck.report.comparison.numbers import Measurement

# Family-wise error rate of all differences of a page, and separately of all its trends: weekly comparisons of equal
# datasets mark a difference by chance once in two years.
FALSE_ALARM_RATE = 0.01
# Smallest number of datasets for a trend: two points always lie on a line, so that their scatter is unknown.
MIN_TREND_POINTS = 3


@dataclass(frozen=True)
class Change:
    """A difference or a slope with its two-sided test against zero.

    Everything is NaN if there is no value, and everything but the value if it has no standard error.
    """

    value: float = np.nan  # difference [unit of the number], or slope [that per unit of the trend axis]
    stderr: float = np.nan  # standard error [unit of the value]
    degrees: float = np.nan  # degrees of freedom of the standard error; infinite if it is not from scatter
    z: float = np.nan  # normal deviate with the same p-value and the sign of the value
    p_value: float = np.nan  # two-sided p-value


def difference(reference: Measurement, other: Measurement) -> Change:
    """Return `other` − `reference` with its test; only the value is known if either has no standard error."""
    terms = [(number.stderr**2, number.degrees) for number in (reference, other)]
    return _test_change(other.value - reference.value, *_combine_variances(terms))


def fit_trend(places: Sequence[float], numbers: Sequence[Measurement]) -> tuple[Change, float]:
    """Fit a straight line through a number of several datasets, and test its slope.

    All points have equal weight, since standard errors from few repeats are too uncertain for weights. The standard
    error of the slope is the larger of two: the error propagated from the numbers, and that of the scatter about
    the line.

    Parameters
    ----------
    places : sequence of float
        Position of each dataset on the trend axis, in days or as index of the dataset.
    numbers : sequence of Measurement
        The number in each dataset, with finite values.

    Returns
    -------
    slope : Change
        Slope per unit of the trend axis; NaN with fewer than `MIN_TREND_POINTS` points or if all places are equal.
    intercept : float
        Value of the line at place 0; NaN without a slope.
    """
    x, y = np.array(places, float), np.array([number.value for number in numbers])
    if len(x) < MIN_TREND_POINTS or np.ptp(x) == 0:
        return Change(), np.nan
    # The slope of least squares is the sum of y times these weights.
    weights = (x - x.mean()) / np.sum((x - x.mean()) ** 2)
    slope = float(weights @ y)
    intercept = float(y.mean() - slope * x.mean())
    terms = [((weight * number.stderr) ** 2, number.degrees) for weight, number in zip(weights, numbers, strict=True)]
    stderr, degrees = _combine_variances(terms)
    residual_variance = np.sum((y - intercept - slope * x) ** 2) / (len(x) - 2)
    scatter_stderr = float(np.sqrt(residual_variance * np.sum(weights**2)))
    # The comparison is also true if the propagated error is NaN: the scatter is then the only error.
    if not scatter_stderr <= stderr:
        stderr, degrees = scatter_stderr, len(x) - 2.0
    return _test_change(slope, stderr, degrees), intercept


def select_significant(p_values: Sequence[float]) -> np.ndarray:
    """Return a mask of the p-values that are significant by Holm's step-down procedure; NaN never is.

    The k-th smallest of n finite p-values is significant if it and all smaller ones pass their tests: each must not
    exceed `FALSE_ALARM_RATE` / (n − k + 1).
    """
    p = np.array(p_values, float)
    order = np.argsort(p)[: int(np.isfinite(p).sum())]
    is_below = p[order] <= FALSE_ALARM_RATE / np.arange(len(order), 0, -1)
    is_significant = np.zeros(len(p), bool)
    is_significant[order[np.logical_and.accumulate(is_below)]] = True
    return is_significant


def _combine_variances(terms: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the standard error of a sum and its degrees of freedom, by Welch and Satterthwaite.

    A term is (variance, degrees of freedom). Both results are NaN if a variance is NaN or all are 0.
    """
    variances, degrees = np.array(terms, float).T
    total = variances.sum()
    if not total > 0:
        return np.nan, np.nan
    inverse_degrees = float(np.sum((variances / total) ** 2 / degrees))
    return float(np.sqrt(total)), 1 / inverse_degrees if inverse_degrees > 0 else np.inf


def _test_change(value: float, stderr: float, degrees: float) -> Change:
    """Return a value with its two-sided t test against zero; without a positive `stderr`, only the value."""
    if not stderr > 0:
        return Change(value)
    t = value / stderr
    if np.isinf(degrees):
        return Change(value, stderr, degrees, t, float(2 * stats.norm.sf(abs(t))))
    p = float(2 * stats.t.sf(abs(t), degrees))
    # The p-value may underflow to 0, for which z would be infinite.
    z = float(np.copysign(stats.norm.isf(max(p, np.finfo(float).tiny) / 2), t))
    return Change(value, stderr, degrees, z, p)
