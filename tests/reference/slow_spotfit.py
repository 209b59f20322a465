"""Reference for unweighted least squares of a 2D Gaussian, by scipy's Levenberg–Marquardt on all pixels.

Errors are those of this estimator under the sensor's noise (a sandwich), not the inverse Hessian, which would hold for
white noise alone.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from spotcheck.sensor import ReadingDistribution, SensorModel

# Relative tolerance of the minimum, far below any standard error.
TOLERANCE = 1e-12


class SpotFit(NamedTuple):
    """Values and standard errors of amplitude [DN], x, y, long and short width [px], orientation [degrees], offset [DN]
    and mean width [px]; χ² per degree of freedom."""

    value: np.ndarray
    stderr: np.ndarray
    chi2_reduced: float


def fit_spot(crop: np.ndarray, sensor: SensorModel | None, start: np.ndarray) -> SpotFit:
    """Fit one crop [rows, columns] in DN from a start [7], the first values of `SpotFit`; NaN pixels are left out.

    Without a sensor model the noise is taken from the residuals, as white, and χ² is NaN.
    """
    y, x = np.nonzero(np.isfinite(crop))
    data = crop[y, x]

    def model(values: np.ndarray) -> np.ndarray:
        amplitude, x0, y0, major, minor, orientation, offset = values
        cos, sin = np.cos(np.radians(orientation)), np.sin(np.radians(orientation))
        along, across = (x - x0) * cos + (y - y0) * sin, (y - y0) * cos - (x - x0) * sin
        return amplitude * np.exp(-((along / major) ** 2 + (across / minor) ** 2) / 2) + offset

    fit = least_squares(
        lambda values: model(values) - data, start, jac="3-point", method="lm",
        xtol=TOLERANCE, ftol=TOLERANCE, gtol=TOLERANCE,
    )  # fmt: skip
    normal, degrees = np.linalg.inv(fit.jac.T @ fit.jac), data.size - 7
    if sensor is None:
        covariance, chi2 = normal * (fit.fun @ fit.fun) / degrees, np.nan
    else:
        light = np.maximum(model(fit.x) - sensor.black_level_dn, 0.0)
        # A clipped pixel has no variance of its own; rounding is the least that is left.
        variance = np.maximum(ReadingDistribution(sensor).tabulate(float(light.max())).variance(light), 1 / 12)
        covariance = normal @ (fit.jac.T * variance) @ fit.jac @ normal
        chi2 = float(np.sum(fit.fun**2 / variance) / degrees)
    # The mean width is the mean of both widths.
    with_mean = np.vstack([np.eye(7), [0, 0, 0, 0.5, 0.5, 0, 0]])
    return SpotFit(with_mean @ fit.x, np.sqrt(np.diag(with_mean @ covariance @ with_mean.T)), chi2)
