"""From a start to the root of the likelihood: damped least squares, which cannot run away, then Fisher scoring.

A root counts as reached when the next step is a small part of the standard errors, never because the cost stopped
falling.
"""

import math

import numpy as np

from spotcheck.fitting.reading_kernel import compiled
from spotcheck.fitting.scoring import EQUAL, congruent, one_pass, times

MAX_ITERATIONS = 60
# Distance to the root in standard errors, squared, before the last step is taken; that step shrinks it much further.
# Where the model misses, errors are larger by the root of χ² per degree of freedom, and so is this distance.
DECREMENT = 2.5e-3
# Standard deviation [px] below which a spot lies within one pixel, whatever its width.
NARROWEST = 0.2


@compiled
def precision_of(major, minor, orientation):
    """a, b, c [1/px²] of widths [px] and orientation [rad]."""
    cos, sin = math.cos(orientation), math.sin(orientation)
    p, q = 1 / (major * major), 1 / (minor * minor)
    return cos * cos * p + sin * sin * q, cos * sin * (p - q), sin * sin * p + cos * cos * q


@compiled
def widths_of(a, b, c):
    """Long and short width [px] and orientation [rad] of a, b, c [1/px²]."""
    mean, half, cross = (a + c) / 2, (a - c) / 2, b
    spread = math.hypot(half, cross)
    return 1 / math.sqrt(mean - spread), 1 / math.sqrt(mean + spread), 0.5 * math.atan2(-cross, -half)


@compiled
def theta_of(point, shaped):
    """θ of a point: itself, or from amplitude, x0, y0, two widths, orientation, offset if `shaped`."""
    theta = point.copy()
    if shaped:
        theta[3], theta[4], theta[5] = precision_of(point[3], point[4], point[5])
    return theta


@compiled
def _chart(point, shaped, circular):
    """∂θ/∂point [7, 7]; with `circular` the first width moves both."""
    out = np.eye(7)
    if not shaped:
        return out
    major, minor = point[3], point[4]
    cos, sin = math.cos(point[5]), math.sin(point[5])
    u, v, w = 2 / major**3, 2 / minor**3, 1 / major**2 - 1 / minor**2
    out[3, 3], out[4, 3], out[5, 3] = -cos * cos * u, -cos * sin * u, -sin * sin * u
    out[3, 4], out[4, 4], out[5, 4] = -sin * sin * v, cos * sin * v, -cos * cos * v
    out[3, 5], out[4, 5], out[5, 5] = -2 * cos * sin * w, (cos * cos - sin * sin) * w, 2 * cos * sin * w
    if circular:
        out[3:6, 3] += out[3:6, 4]
    return out


@compiled
def _moved(point, step, circular):
    """The point after a step; with `circular` the second width follows the first."""
    out = point + step
    if circular:
        out[4] = out[3]
    return out


@compiled
def _possible(point, shaped):
    """A Gaussian that is not too narrow."""
    if shaped:
        return point[3] >= NARROWEST and point[4] >= NARROWEST
    a, b, c = point[3], point[4], point[5]
    return a > 0 and c > 0 and a * c > b * b and a + c < 2 / NARROWEST**2


@compiled
def solve(matrix, vector, damping):
    """Solution of (M + damping diag M) x = v by Cholesky after scaling by the diagonal; False if M is not positive
    definite."""
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
def chart_of(point, free, shaped, circular):
    """∂θ/∂(free parameters) [7, free] at a point."""
    chart, moves, column = _chart(point, shaped, circular), np.empty((7, free.sum())), 0
    for k in range(7):
        if free[k]:
            moves[:, column] = chart[:, k]
            column += 1
    return moves


@compiled
def _step(point, score, information, damping, free, shaped, circular):
    """Step [7] from a point, its decrement scoreᵀ step, the information of the free parameters, and whether it
    exists."""
    moves = chart_of(point, free, shaped, circular)
    pull, inner = times(moves.T, score), congruent(moves, information)
    step, good = solve(inner, pull, damping)
    full, decrement, column = np.zeros(7), 0.0, 0
    for k in range(7):
        if free[k]:
            full[k] = step[column]
            decrement += pull[column] * step[column]
            column += 1
    return full, decrement, inner, good


@compiled
def least_squares(image, point, law, top_hat, free, shaped, circular):
    """Levenberg–Marquardt with equal weights, to a tenth of a standard error or so: a start. NaN pixels are left
    out."""
    damping = 1e-3
    score, information, cost, used = one_pass(image, theta_of(point, shaped), EQUAL, law, top_hat)
    for _ in range(MAX_ITERATIONS):
        step, decrement, _, good = _step(point, score, information, damping, free, shaped, circular)
        trial = _moved(point, step, circular)
        accepted = good and _possible(trial, shaped)
        if accepted:
            t_score, t_information, t_cost, used = one_pass(image, theta_of(trial, shaped), EQUAL, law, top_hat)
            accepted = t_cost <= cost
        if accepted:
            done = decrement <= 1e-2 * cost / max(used - 7, 1) or cost - t_cost <= 1e-9 * cost
            point, score, information, cost = trial, t_score, t_information, t_cost
            damping = max(damping / 8, 1e-9)
            if done:
                break
        else:
            damping *= 8
            if damping > 1e9:
                break
    return point


@compiled
def to_the_root(image, point, weighting, law, top_hat, free, shaped, circular):
    """Fisher scoring: the point, information of the free parameters, χ² and its pixels, and whether the root was
    reached."""
    shrink, before, promised = 1.0, np.zeros(7), 0.0
    if weighting != EQUAL and free[6]:
        # Far below 0 every reading is 0, and knows nothing of the offset any more.
        lowest = -2 * law.gain * math.sqrt(law.read_variance + law.rounding)
        point = point.copy()
        point[6] = max(point[6], lowest)
    for n in range(MAX_ITERATIONS):
        if not _possible(point, shaped):
            break
        score, information, chi2, used = one_pass(image, theta_of(point, shaped), weighting, law, top_hat)
        step, decrement, inner, good = _step(point, score, information, 0.0, free, shaped, circular)
        if not good or not math.isfinite(decrement):
            break
        misfit = chi2 / max(used - 7, 1)
        # With equal weights scatter about the fit is the only scale; noise-free images have none.
        scale = max(misfit, (1e-7 * point[0]) ** 2) if weighting == EQUAL else max(misfit, 1.0)
        if decrement < DECREMENT * scale:
            last = _moved(point, step, circular)
            return (last if _possible(last, shaped) else point), inner, chi2, used, True
        if n > 0:
            # Where the model is far off, expected and observed information differ and full steps overshoot: the slope
            # along the last step says by how much.
            slope = times(chart_of(point, free, shaped, circular).T, score) @ before[free]
            shrink = min(1.0, max(shrink * promised / (promised - slope), 0.05)) if slope < promised else 1.0
        for k in (0, 6):
            # No more than half of the spot at a time: where little is known, a step can be of any size.
            if shrink * abs(step[k]) > abs(point[0]) / 2:
                shrink = abs(point[0] / step[k]) / 2
        before, promised = step, decrement
        trial = _moved(point, shrink * step, circular)
        while not _possible(trial, shaped):
            shrink /= 2
            trial = _moved(point, shrink * step, circular)
        point = trial
    size = free.sum()
    return point, np.full((size, size), np.nan), np.nan, 0, False


@compiled
def constrained(theta, free, circular, fixed):
    """A shaped point near θ, with the fixed parameters put in."""
    point = theta.copy()
    point[3], point[4], point[5] = widths_of(theta[3], theta[4], theta[5])
    if circular:
        point[3] = math.sqrt(point[3] * point[4])
        point[5] = 0.0
    for k in range(7):
        if not free[k] and not (circular and (k == 4 or k == 5)):
            point[k] = fixed[k]
    if circular:
        point[4] = point[3]
    return point
