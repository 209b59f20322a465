"""Reference implementation of unweighted least squares of a 2D Gaussian: free centre, two widths, orientation,
amplitude, offset; plain numpy, every pixel in every step, to steps of 1e-6 of a width.

Errors are those of this estimator under the sensor's noise (a sandwich), not the inverse Hessian, which would hold for
white noise alone. The minimum is searched in the elements of the inverse covariance matrix, in which a round spot is no
special point; widths and orientation follow from them.
"""

from typing import NamedTuple

import numpy as np

from spotcheck.io.store import flag
from spotcheck.sensor import ReadingDistribution, SensorModel

MAX_ITERATIONS = 100
# Converged when the step is below this part of the parameters' own scale; far below any standard error.
STEP_TOLERANCE = 1e-6


class SpotFit(NamedTuple):
    """Values and standard errors of amplitude [DN], x, y, long and short width [px], orientation [degrees], offset [DN]
    and mean width [px]; χ² per degree of freedom; status flags."""

    value: np.ndarray
    stderr: np.ndarray
    chi2_reduced: float
    status: int


NO_FIT = SpotFit(np.full(8, np.nan), np.full(8, np.nan), np.nan, flag("not_converged"))


def fit_spot(crop: np.ndarray, exposure_s: float, sensor: SensorModel | None) -> SpotFit:
    """Fit one crop [rows, columns] in DN; NaN pixels are left out.

    Without a sensor model the noise is taken from the residuals, as white, and χ² is NaN.
    """
    rows, columns = np.nonzero(np.isfinite(crop))
    data = crop[rows, columns].astype(float)
    start = _start(crop) if data.size > 7 else None
    if start is None:
        return NO_FIT
    theta, converged = _minimise(columns.astype(float), rows.astype(float), data, start)
    value = _natural(theta)
    if not converged or value is None:
        return NO_FIT
    model, jac = _model(theta, columns, rows)
    residual = data - model
    normal = np.linalg.pinv(jac @ jac.T)
    if sensor is None:
        covariance = normal * (residual @ residual) / (data.size - 7)
        chi2 = np.nan
    else:
        light = np.maximum(model - sensor.black_level_dn, 0.0)
        distribution = ReadingDistribution(sensor, exposure_s=exposure_s)
        variance = distribution.tabulate(float(light.max())).variance(light)
        # A clipped pixel has no variance of its own; rounding is the least that is left.
        variance = np.maximum(variance, 1 / 12)
        covariance = normal @ (jac * variance) @ jac.T @ normal
        chi2 = float(np.sum(residual**2 / variance) / (data.size - 7))
    to_natural = _natural_jacobian(theta)
    stderr = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", to_natural, covariance, to_natural), 0.0))
    return SpotFit(value, stderr, chi2, _limits(value, crop.shape))


def _limits(value: np.ndarray, shape: tuple[int, ...]) -> int:
    amplitude, x, y, major, minor = value[:5]
    trusted = amplitude > 0 and minor > 0.3 and major < max(shape) and 0 <= x < shape[1] and 0 <= y < shape[0]
    return 0 if trusted else flag("at_limit")


def _start(crop: np.ndarray) -> np.ndarray | None:
    """Start from moments of the light above half its maximum: amplitude, x, y, a, b, c, offset; None without light."""
    # A quartile, not the median: in an overexposed crop most pixels read full scale.
    offset = float(np.nanquantile(crop, 0.25))
    filled = np.where(np.isfinite(crop), crop, offset)
    smooth = (
        filled + np.roll(filled, 1, 0) + np.roll(filled, -1, 0) + np.roll(filled, 1, 1) + np.roll(filled, -1, 1)
    ) / 5
    signal = smooth - offset
    if not signal.max() > 0:
        return None
    rows, columns = np.nonzero(signal > signal.max() / 2)
    weight = signal[rows, columns]
    x, y = np.average(columns, weights=weight), np.average(rows, weights=weight)
    # The light above half maximum covers 2 π σ² ln 2: robust where a threshold cuts second moments.
    sigma = max(np.sqrt(rows.size / (2 * np.pi * np.log(2))), 0.5)
    return np.array([float(signal.max()), x, y, sigma**-2, 0.0, sigma**-2, offset])


def _model(theta: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Model values and their derivatives [7, pixels] for θ = amplitude, x0, y0, a, b, c, offset."""
    amplitude, x0, y0, a, b, c, offset = theta
    dx, dy = x - x0, y - y0
    gauss = np.exp(-(a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2)
    light = amplitude * gauss
    jac = np.empty((7, dx.size))
    jac[0] = gauss
    jac[1] = light * (a * dx + b * dy)
    jac[2] = light * (b * dx + c * dy)
    jac[3] = -light * dx * dx / 2
    jac[4] = -light * dx * dy
    jac[5] = -light * dy * dy / 2
    jac[6] = 1.0
    return light + offset, jac


def _minimise(x, y, data, theta) -> tuple[np.ndarray, bool]:
    """Levenberg–Marquardt with Marquardt's scaling. Returns θ and whether the last step was negligible."""
    damping = 1e-3
    model, jac = _model(theta, x, y)
    residual = data - model
    cost = residual @ residual
    for _ in range(MAX_ITERATIONS):
        hessian, gradient = jac @ jac.T, jac @ residual
        scale = np.diag(hessian).copy()
        while True:
            step = np.linalg.solve(hessian + damping * np.diag(scale + 1e-30), gradient)
            trial = theta + step
            positive = trial[3] > 0 and trial[5] > 0 and trial[3] * trial[5] > trial[4] ** 2
            if positive:
                trial_model, trial_jac = _model(trial, x, y)
                trial_residual = data - trial_model
                trial_cost = trial_residual @ trial_residual
                if trial_cost <= cost:
                    break
            damping *= 8
            if damping > 1e12:
                # The undamped step decides: a damped one is small anywhere.
                return theta, _negligible(np.linalg.pinv(hessian) @ gradient, theta)
        negligible = _negligible(step, theta)
        theta, jac, residual, cost = trial, trial_jac, trial_residual, trial_cost
        damping = max(damping / 8, 1e-12)
        if negligible:
            return theta, True
    return theta, False


def _negligible(step: np.ndarray, theta: np.ndarray) -> bool:
    """Compares each step with its parameter's scale: the amplitude, the width, the curvature."""
    amplitude, _, _, a, _, c, _ = np.abs(theta)
    width, curvature = (a * c) ** -0.25, np.sqrt(a * c)
    scale = np.array([amplitude, width, width, curvature, curvature, curvature, amplitude])
    return bool(np.all(np.abs(step) <= STEP_TOLERANCE * scale))


def _natural(theta: np.ndarray) -> np.ndarray | None:
    """From θ to the order of `SpotFit`; None where θ is no Gaussian."""
    amplitude, x0, y0, a, b, c, offset = theta
    if not np.all(np.isfinite(theta)) or a * c <= b * b:
        return None
    covariance = np.linalg.inv([[a, b], [b, c]])
    (small, large), vectors = np.linalg.eigh(covariance)
    major, minor = np.sqrt(large), np.sqrt(small)
    orientation = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])) % 180.0
    return np.array([amplitude, x0, y0, major, minor, orientation, offset, (major + minor) / 2])


def _natural_jacobian(theta: np.ndarray) -> np.ndarray:
    """d natural / d θ [8, 7] by central differences; the orientation of a round spot has no derivative and gets
    infinity."""
    out = np.zeros((8, 7))
    for k in range(7):
        step = 1e-6 * max(abs(theta[k]), np.sqrt(theta[3] * theta[5]) if 3 <= k <= 5 else 1e-3)
        ends = []
        for sign in (1, -1):
            shifted = theta.copy()
            shifted[k] += sign * step
            ends.append(_natural(shifted))
        if ends[0] is None or ends[1] is None:
            return np.full((8, 7), np.nan)
        difference = ends[0] - ends[1]
        difference[5] = (difference[5] + 90) % 180 - 90
        out[:, k] = difference / (2 * step)
    return out
