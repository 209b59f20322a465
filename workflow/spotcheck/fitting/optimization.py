"""Optimization of a spot fit: damped least squares from the start, then Fisher scoring to the root of the score.

Damped least squares cannot diverge. A root counts as reached if the next step is a small fraction of the standard
errors, never because the cost stopped falling.

θ [7] are amplitude [DN], x0, y0 [px], the elements a, b, c [1/px²] of the inverse covariance matrix [[a, b], [b, c]] of
the spot, and offset [DN] (see `spot_score`). A point of the search [7] is either θ itself, or amplitude, x0, y0, major
and minor width [px], orientation [rad] and offset (`Parametrization.uses_widths`). Functions are compiled; `law` is the
distribution of a reading (`ReadingLaw`), and NaN pixels are left out.
"""

import math
from typing import NamedTuple

import numpy as np

from spotcheck.fitting.reading_kernel import compiled
from spotcheck.fitting.spot_score import EQUAL, multiply, score_spot, transform_information

# Steps of either method.
MAX_ITERATIONS = 60
# Squared distance to the root of the score, in standard errors, below which the last step is taken. That step reduces
# the distance much further. If the model does not fit, the limit grows by χ² per degree of freedom, as the squared
# errors do.
CONVERGED_DECREMENT = 2.5e-3
# Levenberg–Marquardt damping, relative to the diagonal of the information: start, limits, and the factor by which it
# changes after each step.
FIRST_DAMPING, LEAST_DAMPING, LARGEST_DAMPING, DAMPING_FACTOR = 1e-3, 1e-9, 1e9, 8
# Least squares end at a squared distance to the optimum of so many squared standard errors, or if the cost falls by
# less than this fraction.
LEAST_SQUARES_DECREMENT, LEAST_SQUARES_TOLERANCE = 1e-2, 1e-9
# Shortest step of Fisher scoring after an overshooting one, as a fraction of the full step.
LEAST_SHRINK = 0.05
# Least scatter of an image about its fit, as a fraction of the amplitude: simulated images may have no noise.
LEAST_SCATTER = 1e-7
# Standard deviation [px] below which all light is within one pixel, so that the width has no effect.
NARROWEST = 0.2


class Parametrization(NamedTuple):
    """Meaning of the coordinates of a point of the search, in the form of the compiled code."""

    free: np.ndarray  # which of the seven coordinates are fitted [7]; the others keep their values
    uses_widths: bool  # whether the shape is given by widths and orientation, as fixed parameters need, and not by θ
    is_circular: bool  # whether both widths are equal; only with `uses_widths`


@compiled
def convert_widths(major, minor, orientation):
    """Return the inverse covariance a, b, c [1/px²] of a spot with widths [px] and orientation [rad]."""
    cos, sin = math.cos(orientation), math.sin(orientation)
    # Inverse variances [1/px²] along the long and the short axis.
    along, across = 1 / (major * major), 1 / (minor * minor)
    return cos * cos * along + sin * sin * across, cos * sin * (along - across), sin * sin * along + cos * cos * across


@compiled
def convert_inverse_covariance(a, b, c):
    """Return long and short width [px] and orientation [rad] of the inverse covariance a, b, c [1/px²]."""
    mean, half_difference = (a + c) / 2, (a - c) / 2
    spread = math.hypot(half_difference, b)
    # The long axis belongs to the smaller eigenvalue of the inverse covariance, hence the signs.
    orientation = 0.5 * math.atan2(-b, -half_difference)
    return 1 / math.sqrt(mean - spread), 1 / math.sqrt(mean + spread), orientation


@compiled
def compute_theta(point, coordinates):
    """Return θ [7] of a point of the search [7]; `coordinates` is its `Parametrization`, as in all functions here."""
    theta = point.copy()
    if coordinates.uses_widths:
        theta[3], theta[4], theta[5] = convert_widths(point[3], point[4], point[5])
    return theta


@compiled
def _compute_full_jacobian(point, coordinates):
    """Return ∂θ/∂point [θ, coordinate] for all seven coordinates of a point [7], free or not.

    With equal widths, the column of the first width is the derivative by both together.
    """
    jacobian = np.eye(7)
    if not coordinates.uses_widths:
        return jacobian
    major, minor = point[3], point[4]
    cos, sin = math.cos(point[5]), math.sin(point[5])
    # u = −∂(1/major²)/∂major and v = −∂(1/minor²)/∂minor [1/px³]; w is the difference of the inverse variances [1/px²].
    u, v, w = 2 / major**3, 2 / minor**3, 1 / major**2 - 1 / minor**2
    # Derivatives of a, b, c (see `convert_widths`) by the major width, the minor width and the orientation.
    jacobian[3, 3], jacobian[4, 3], jacobian[5, 3] = -cos * cos * u, -cos * sin * u, -sin * sin * u
    jacobian[3, 4], jacobian[4, 4], jacobian[5, 4] = -sin * sin * v, cos * sin * v, -cos * cos * v
    jacobian[3, 5], jacobian[4, 5], jacobian[5, 5] = -2 * cos * sin * w, (cos * cos - sin * sin) * w, 2 * cos * sin * w
    if coordinates.is_circular:
        jacobian[3:6, 3] += jacobian[3:6, 4]
    return jacobian


@compiled
def _apply_step(point, step, coordinates):
    """Return the point [7] after a step [7]; with equal widths the second width equals the first."""
    trial = point + step
    if coordinates.is_circular:
        trial[4] = trial[3]
    return trial


@compiled
def _is_valid(point, coordinates):
    """Return whether a point is a Gaussian with widths of about `NARROWEST` or more.

    For θ: the matrix is positive definite, and its trace is below that of a round spot of this width.
    """
    if coordinates.uses_widths:
        return point[3] >= NARROWEST and point[4] >= NARROWEST
    a, b, c = point[3], point[4], point[5]
    return a > 0 and c > 0 and a * c > b * b and a + c < 2 / NARROWEST**2


@compiled
def solve_damped(matrix, vector, damping):
    """Return the solution x of (M + damping · diag M) x = v, and whether that matrix is positive definite.

    M is `matrix` [n, n], v is `vector` [n]. The method is a Cholesky decomposition after scaling by the diagonal. If
    the matrix is not positive definite, v itself is returned in place of x.
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
    # Forward and backward substitution.
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
    """Return ∂θ/∂(free coordinates) [7, free] at a point."""
    return _compute_full_jacobian(point, coordinates)[:, coordinates.free]


@compiled
def _compute_step(point, score, information, damping, coordinates):
    """Return the step [7] from a point, its decrement, the information of the free coordinates, and whether it exists.

    `score` [7] and `information` [7, 7] are those of θ. The decrement is scoreᵀ step, the squared distance to the root
    in standard errors. The returned information is [free, free]. The step is 0 for coordinates that are not free.
    """
    jacobian = compute_jacobian(point, coordinates)
    free_score, free_information = multiply(jacobian.T, score), transform_information(jacobian, information)
    free_step, is_solvable = solve_damped(free_information, free_score, damping)
    step, decrement, column = np.zeros(7), 0.0, 0
    for k in range(7):
        if coordinates.free[k]:
            step[k] = free_step[column]
            decrement += free_score[column] * free_step[column]
            column += 1
    return step, decrement, free_information, is_solvable


@compiled
def fit_least_squares(image, point, law, top_hat, coordinates):
    """Return the point [7] of least squares with equal weights by the Levenberg–Marquardt method, from a start `point`.

    It is accurate to about a tenth of a standard error and serves as a start for Fisher scoring. `image` [row, column]
    is in DN.
    """
    damping = FIRST_DAMPING
    score, information, cost, used = score_spot(image, compute_theta(point, coordinates), EQUAL, law, top_hat)
    for _ in range(MAX_ITERATIONS):
        step, decrement, _, is_solvable = _compute_step(point, score, information, damping, coordinates)
        trial = _apply_step(point, step, coordinates)
        is_accepted = is_solvable and _is_valid(trial, coordinates)
        if is_accepted:
            theta = compute_theta(trial, coordinates)
            trial_score, trial_information, trial_cost, used = score_spot(image, theta, EQUAL, law, top_hat)
            is_accepted = trial_cost <= cost
        if is_accepted:
            # With equal weights, the mean squared residual is the unit of the decrement.
            is_near = decrement <= LEAST_SQUARES_DECREMENT * cost / max(used - 7, 1)
            is_converged = is_near or cost - trial_cost <= LEAST_SQUARES_TOLERANCE * cost
            point, score, information, cost = trial, trial_score, trial_information, trial_cost
            damping = max(damping / DAMPING_FACTOR, LEAST_DAMPING)
            if is_converged:
                break
        else:
            damping *= DAMPING_FACTOR
            if damping > LARGEST_DAMPING:
                break
    return point


@compiled
def run_fisher_scoring(image, point, weighting, law, top_hat, coordinates):
    """Find the root of the score by Fisher scoring.

    Parameters
    ----------
    image : readings [row, column] in DN.
    point : start of the search [7].
    weighting : weights of the pixels: `EQUAL`, `LIKELIHOOD` (their information) or `VARIANCE` of `spot_score`.
    law : distribution of a reading (`ReadingLaw`).
    top_hat : whether the light is cut to a plateau.
    coordinates : meaning of the coordinates of a point (`Parametrization`).

    Returns
    -------
    tuple
        Point [7], information of the free coordinates [free, free], χ² (or Σ residual² [DN²] with equal weights),
        number of pixels in χ², and whether the root was reached. Without a root, information and χ² are NaN, and the
        number is 0.
    """
    shrink, previous_step, previous_decrement = 1.0, np.zeros(7), 0.0
    if weighting != EQUAL and coordinates.free[6]:
        # The search starts at most two standard deviations of the read noise below 0 DN: far below, every reading is 0
        # and has no information on the offset.
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
        scale = max(misfit, (LEAST_SCATTER * point[0]) ** 2) if weighting == EQUAL else max(misfit, 1.0)
        if decrement < CONVERGED_DECREMENT * scale:
            last = _apply_step(point, step, coordinates)
            return (last if _is_valid(last, coordinates) else point), free_information, chi2, used, True
        if n > 0:
            # Far from the root, expected and observed information differ and full steps overshoot; the slope that is
            # left along the last step measures by how much.
            slope = multiply(compute_jacobian(point, coordinates).T, score) @ previous_step[coordinates.free]
            shrink = shrink * previous_decrement / (previous_decrement - slope) if slope < previous_decrement else 1.0
            shrink = min(1.0, max(shrink, LEAST_SHRINK))
        for k in (0, 6):
            # Steps of amplitude and offset are limited to half of the amplitude: with little information on them, a
            # step can have any size.
            if shrink * abs(step[k]) > abs(point[0]) / 2:
                shrink = abs(point[0] / step[k]) / 2
        previous_step, previous_decrement = step, decrement
        trial = _apply_step(point, shrink * step, coordinates)
        while not _is_valid(trial, coordinates):
            shrink /= 2
            trial = _apply_step(point, shrink * step, coordinates)
        point = trial
    size = coordinates.free.sum()
    return point, np.full((size, size), np.nan), np.nan, 0, False


@compiled
def apply_constraints(theta, coordinates, fixed_values):
    """Convert a start θ [7] to a point with widths, and set coordinates that are not free to `fixed_values` [7].

    Fixed widths are in px and the fixed orientation is in rad; values of free coordinates are ignored. A circular spot
    gets the geometric mean of both widths and the orientation 0. Only with `uses_widths`.
    """
    point = theta.copy()
    point[3], point[4], point[5] = convert_inverse_covariance(theta[3], theta[4], theta[5])
    if coordinates.is_circular:
        point[3] = math.sqrt(point[3] * point[4])
        point[5] = 0.0
    # Minor width and orientation of a circular spot are not free, but have no fixed value.
    for k in range(7):
        if not coordinates.free[k] and not (coordinates.is_circular and (k == 4 or k == 5)):
            point[k] = fixed_values[k]
    if coordinates.is_circular:
        point[4] = point[3]
    return point
