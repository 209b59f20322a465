"""Straight lines through points with standard errors, as photon transfer needs them."""

from dataclasses import dataclass

import numpy as np

# Least number of different abscissae from which a line is fitted.
MIN_POINTS = 3
# Least standard error of a point [its unit]: smaller ones count as this, which keeps weights finite.
MIN_ERROR = 1e-9


@dataclass(frozen=True)
class Line:
    """A fitted line y = slope x + intercept."""

    slope: float  # [y/x]
    slope_error: float  # standard error of the slope [y/x]
    intercept: float  # [y]
    intercept_error: float  # standard error of the intercept [y]


def fit_through_zero(x: np.ndarray, y: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """Return slope and standard error of the unweighted least-squares line through the origin.

    Parameters
    ----------
    x, y : coordinates of the points [point].
    error : standard errors of `y` [point]. The error of the slope is inflated by √χ² per degree of freedom if the
        residuals are larger than these.
    """
    error = np.maximum(error, MIN_ERROR)
    square = float(x @ x)
    slope = float(x @ y) / square
    residual = y - slope * x
    reduced_chi2 = float(np.mean(residual**2 / error**2)) * len(x) / max(len(x) - 1, 1)
    slope_error = float(np.sqrt((x**2) @ error**2)) / square
    return slope, slope_error * float(np.sqrt(max(reduced_chi2, 1.0)))


def fit_line(x: np.ndarray, y: np.ndarray, error: np.ndarray) -> Line:
    """Return the weighted least-squares line through points [point].

    The standard errors follow from `error`, the standard errors of `y`. With three points or more they are inflated by
    √χ² per degree of freedom if that exceeds 1.
    """
    error = np.maximum(error, MIN_ERROR)
    (slope, intercept), covariance = np.polyfit(x, y, 1, w=1 / error, cov="unscaled")
    if len(x) > 2:
        reduced_chi2 = float(np.sum(((y - intercept - slope * x) / error) ** 2)) / (len(x) - 2)
        covariance = covariance * max(reduced_chi2, 1.0)
    slope_error, intercept_error = np.sqrt(np.diag(covariance))
    return Line(float(slope), float(slope_error), float(intercept), float(intercept_error))


def extrapolate_to_zero(x: np.ndarray, y: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """Return y and its standard error at x = 0.

    This is the intercept of the line if x has three different values or more; otherwise the weighted mean of y at the
    smallest x. NaN in `x` counts as 0.
    """
    x = np.nan_to_num(x)
    if len(np.unique(x)) >= MIN_POINTS:
        line = fit_line(x, y, error)
        return line.intercept, line.intercept_error
    lowest = x == x.min()
    weight = 1 / np.maximum(error[lowest], MIN_ERROR) ** 2
    return float(np.average(y[lowest], weights=weight)), float(weight.sum() ** -0.5)
