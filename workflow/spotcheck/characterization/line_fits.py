"""Fits of straight lines to points with standard errors, for photon transfer.

Errors are inflated by √(χ²/degrees of freedom) if this exceeds 1: the points then scatter more than their errors say.
"""

from dataclasses import dataclass

import numpy as np

# Least number of different abscissae from which a line is fitted.
MIN_POINTS = 3
# Least standard error of a point, in the unit of the point: smaller ones count as this, which keeps weights finite.
MIN_ERROR = 1e-9


@dataclass(frozen=True)
class Line:
    """A fitted line y = slope x + intercept."""

    slope: float  # [y/x]
    slope_error: float  # standard error of the slope [y/x]
    intercept: float  # [y]
    intercept_error: float  # standard error of the intercept [y]


def fit_through_zero(x: np.ndarray, y: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """Return slope [y/x] and its standard error of the unweighted least-squares line through the origin.

    Parameters
    ----------
    x, y : coordinates of the points [point]; not all x may be 0.
    error : standard errors of `y` [point].
    """
    error = np.maximum(error, MIN_ERROR)
    square = float(x @ x)
    slope = float(x @ y) / square
    residual = y - slope * x
    # One parameter is fitted; a single point has no degree of freedom and the residual 0.
    reduced_chi2 = float(np.mean(residual**2 / error**2)) * len(x) / max(len(x) - 1, 1)
    slope_error = float(np.sqrt((x**2) @ error**2)) / square
    return slope, slope_error * float(np.sqrt(max(reduced_chi2, 1.0)))


def fit_line(x: np.ndarray, y: np.ndarray, error: np.ndarray) -> Line:
    """Return the weighted least-squares line through points.

    Parameters
    ----------
    x, y : coordinates of the points [point], with two different x or more.
    error : standard errors of `y` [point], which also give the weights. With two points no error is inflated.
    """
    error = np.maximum(error, MIN_ERROR)
    (slope, intercept), covariance = np.polyfit(x, y, 1, w=1 / error, cov="unscaled")
    degrees = len(x) - 2
    if degrees > 0:
        reduced_chi2 = float(np.sum(((y - intercept - slope * x) / error) ** 2)) / degrees
        covariance = covariance * max(reduced_chi2, 1.0)
    slope_error, intercept_error = np.sqrt(np.diag(covariance))
    return Line(float(slope), float(slope_error), float(intercept), float(intercept_error))


def extrapolate_to_zero(x: np.ndarray, y: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """Return y at x = 0 and its standard error.

    This is the intercept of `fit_line` if x has three different values or more. Otherwise it is the weighted mean of y
    at the smallest x. NaN in `x` counts as 0; no value of x is negative. All arrays have the shape [point].
    """
    x = np.nan_to_num(x)
    if len(np.unique(x)) >= MIN_POINTS:
        line = fit_line(x, y, error)
        return line.intercept, line.intercept_error
    is_lowest = x == x.min()
    weight = 1 / np.maximum(error[is_lowest], MIN_ERROR) ** 2
    return float(np.average(y[is_lowest], weights=weight)), float(weight.sum() ** -0.5)
