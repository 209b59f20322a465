"""Optimization of a spot fit: damped least squares from the start, then Fisher scoring to the root of the score.

Damped least squares cannot diverge. A root counts as reached if the next step is a small fraction of the standard
errors, never because the cost stopped falling.

A point of the search [7] is either θ itself (see `spot_score`), or amplitude, x0, y0, two widths [px], orientation
[rad] and offset (`Parametrization.uses_widths`).
"""

import math
from typing import NamedTuple

import numpy as np

from spotcheck.fitting.reading_kernel import compiled
from spotcheck.fitting.spot_score import EQUAL, multiply, score_spot, transform_information

MAX_ITERATIONS = 60
# Squared distance to the root in standard errors below which the last step is taken, which reduces it much further. If
# the model does not fit, errors and this distance grow by the root of χ² per degree of freedom.
CONVERGED_DECREMENT = 2.5e-3
# Standard deviation [px] below which all light is within one pixel, so that the width has no effect.
NARROWEST = 0.2


class Parametrization(NamedTuple):
    """Coordinates of the search in the form of the compiled code."""

    free: np.ndarray  # which of the seven coordinates are free [7]
    uses_widths: bool  # whether they are widths and orientation, as fixed parameters need, and not θ
    is_circular: bool  # whether both widths are equal; only with `uses_widths`


@compiled
def convert_widths(major, minor, orientation):
    """Return the inverse covariance a, b, c [1/px²] of widths [px] and orientation [rad]."""
    cos, sin = math.cos(orientation), math.sin(orientation)
    p, q = 1 / (major * major), 1 / (minor * minor)
    return cos * cos * p + sin * sin * q, cos * sin * (p - q), sin * sin * p + cos * cos * q


@compiled
def convert_inverse_covariance(a, b, c):
    """Return long and short width [px] and orientation [rad] of the inverse covariance a, b, c [1/px²]."""
    mean, half, cross = (a + c) / 2, (a - c) / 2, b
    spread = math.hypot(half, cross)
    return 1 / math.sqrt(mean - spread), 1 / math.sqrt(mean + spread), 0.5 * math.atan2(-cross, -half)


@compiled
def compute_theta(point, coordinates):
    """Return θ of a point of the search."""
    theta = point.copy()
    if coordinates.uses_widths:
        theta[3], theta[4], theta[5] = convert_widths(point[3], point[4], point[5])
    return theta


@compiled
def _compute_full_jacobian(point, coordinates):
    """Return ∂θ/∂point [7, 7]; with equal widths the first width changes both."""
    jacobian = np.eye(7)
    if not coordinates.uses_widths:
        return jacobian
    major, minor = point[3], point[4]
    cos, sin = math.cos(point[5]), math.sin(point[5])
    u, v, w = 2 / major**3, 2 / minor**3, 1 / major**2 - 1 / minor**2
    jacobian[3, 3], jacobian[4, 3], jacobian[5, 3] = -cos * cos * u, -cos * sin * u, -sin * sin * u
    jacobian[3, 4], jacobian[4, 4], jacobian[5, 4] = -sin * sin * v, cos * sin * v, -cos * cos * v
    jacobian[3, 5], jacobian[4, 5], jacobian[5, 5] = -2 * cos * sin * w, (cos * cos - sin * sin) * w, 2 * cos * sin * w
    if coordinates.is_circular:
        jacobian[3:6, 3] += jacobian[3:6, 4]
    return jacobian


@compiled
def _apply_step(point, step, coordinates):
    """Return the point after a step; with equal widths the second width equals the first."""
    trial = point + step
    if coordinates.is_circular:
        trial[4] = trial[3]
    return trial


@compiled
def _is_valid(point, coordinates):
    """Return whether a point is a Gaussian that is not too narrow."""
    if coordinates.uses_widths:
        return point[3] >= NARROWEST and point[4] >= NARROWEST
    a, b, c = point[3], point[4], point[5]
    return a > 0 and c > 0 and a * c > b * b and a + c < 2 / NARROWEST**2


@compiled
def solve_damped(matrix, vector, damping):
    """Return the solution of (M + damping diag M) x = v, and whether M is positive definite.

    Cholesky decomposition after scaling by the diagonal.
    """
    size = vector.size
    scale = np.empty(size)
    for k in range(size):
        if not matrix[k, k] > 0:
            return vector, False
        scale[k] = 1 / math.sqrt(matrix[k, k])
    lower = np.zeros((size, size))
    x = np.empty(size)
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j] * scale[i] * scale[j] + (damping if i == j else 0.0)
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 1e-13:
                    return vector, False
                lower[i, i] = math.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    for i in range(size):
        total = vector[i] * scale[i]
        for k in range(i):
            total -= lower[i, k] * x[k]
        x[i] = total / lower[i, i]
    for i in range(size - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, size):
            total -= lower[k, i] * x[k]
        x[i] = total / lower[i, i]
    return x * scale, True


@compiled
def compute_jacobian(point, coordinates):
    """Return ∂θ/∂(free parameters) [7, free] at a point."""
    full, jacobian, column = _compute_full_jacobian(point, coordinates), np.empty((7, coordinates.free.sum())), 0
    for k in range(7):
        if coordinates.free[k]:
            jacobian[:, column] = full[:, k]
            column += 1
    return jacobian


@compiled
def _compute_step(point, score, information, damping, coordinates):
    """Return the step [7] from a point, its decrement, the information of the free parameters, and whether it exists.

    The decrement is scoreᵀ step; the information is [free, free].
    """
    jacobian = compute_jacobian(point, coordinates)
    free_score, free_information = multiply(jacobian.T, score), transform_information(jacobian, information)
    step, is_solvable = solve_damped(free_information, free_score, damping)
    full, decrement, column = np.zeros(7), 0.0, 0
    for k in range(7):
        if coordinates.free[k]:
            full[k] = step[column]
            decrement += free_score[column] * step[column]
            column += 1
    return full, decrement, free_information, is_solvable


@compiled
def fit_least_squares(image, point, law, top_hat, coordinates):
    """Return the point of least squares with equal weights by the Levenberg–Marquardt method.

    It is accurate to about a tenth of a standard error and a start for Fisher scoring. NaN pixels are left out.
    """
    damping = 1e-3
    score, information, cost, used = score_spot(image, compute_theta(point, coordinates), EQUAL, law, top_hat)
    for _ in range(MAX_ITERATIONS):
        step, decrement, _, is_solvable = _compute_step(point, score, information, damping, coordinates)
        trial = _apply_step(point, step, coordinates)
        is_accepted = is_solvable and _is_valid(trial, coordinates)
        if is_accepted:
            t_score, t_information, t_cost, used = score_spot(
                image, compute_theta(trial, coordinates), EQUAL, law, top_hat
            )
            is_accepted = t_cost <= cost
        if is_accepted:
            is_converged = decrement <= 1e-2 * cost / max(used - 7, 1) or cost - t_cost <= 1e-9 * cost
            point, score, information, cost = trial, t_score, t_information, t_cost
            damping = max(damping / 8, 1e-9)
            if is_converged:
                break
        else:
            damping *= 8
            if damping > 1e9:
                break
    return point


@compiled
def run_fisher_scoring(image, point, weighting, law, top_hat, coordinates):
    """Find the root of the score by Fisher scoring.

    Return the point, the information of the free parameters [free, free], χ² with its number of pixels, and whether the
    root was reached.
    """
    shrink, previous_step, expected_gain = 1.0, np.zeros(7), 0.0
    if weighting != EQUAL and coordinates.free[6]:
        # Far below 0 every reading is 0 and has no information on the offset.
        lowest = -2 * law.gain * math.sqrt(law.read_variance + law.rounding_variance)
        point = point.copy()
        point[6] = max(point[6], lowest)
    for n in range(MAX_ITERATIONS):
        if not _is_valid(point, coordinates):
            break
        score, information, chi2, used = score_spot(image, compute_theta(point, coordinates), weighting, law, top_hat)
        step, decrement, free_information, is_solvable = _compute_step(point, score, information, 0.0, coordinates)
        if not is_solvable or not math.isfinite(decrement):
            break
        misfit = chi2 / max(used - 7, 1)
        # With equal weights the scatter about the fit is the only scale; noise-free images have none.
        scale = max(misfit, (1e-7 * point[0]) ** 2) if weighting == EQUAL else max(misfit, 1.0)
        if decrement < CONVERGED_DECREMENT * scale:
            last = _apply_step(point, step, coordinates)
            return (last if _is_valid(last, coordinates) else point), free_information, chi2, used, True
        if n > 0:
            # Far from the root, expected and observed information differ and full steps overshoot; the slope that is
            # left along the last step measures by how much.
            slope = multiply(compute_jacobian(point, coordinates).T, score) @ previous_step[coordinates.free]
            shrink = shrink * expected_gain / (expected_gain - slope) if slope < expected_gain else 1.0
            shrink = min(1.0, max(shrink, 0.05))
        for k in (0, 6):
            # Limit a step to half of the amplitude: with little information it can have any size.
            if shrink * abs(step[k]) > abs(point[0]) / 2:
                shrink = abs(point[0] / step[k]) / 2
        previous_step, expected_gain = step, decrement
        trial = _apply_step(point, shrink * step, coordinates)
        while not _is_valid(trial, coordinates):
            shrink /= 2
            trial = _apply_step(point, shrink * step, coordinates)
        point = trial
    size = coordinates.free.sum()
    return point, np.full((size, size), np.nan), np.nan, 0, False


@compiled
def apply_constraints(theta, coordinates, fixed_values):
    """Return the point with widths near θ that has the fixed values of all parameters that are not free."""
    point = theta.copy()
    point[3], point[4], point[5] = convert_inverse_covariance(theta[3], theta[4], theta[5])
    if coordinates.is_circular:
        point[3] = math.sqrt(point[3] * point[4])
        point[5] = 0.0
    for k in range(7):
        if not coordinates.free[k] and not (coordinates.is_circular and (k == 4 or k == 5)):
            point[k] = fixed_values[k]
    if coordinates.is_circular:
        point[4] = point[3]
    return point
