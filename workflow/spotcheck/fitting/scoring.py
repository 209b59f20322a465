"""One pass over the pixels of an image: score and Fisher information of a spot, compiled.

θ = amplitude [DN], x0, y0 [px], the elements a, b, c [1/px²] of the inverse covariance, offset [DN]; a round spot is no
special point of it. The light is A exp(−(a dx² + 2 b dx dy + c dy²)/2) (cut to a plateau with `top_hat`), the mean
reading without clips light + offset. Every derivative is that Gaussian times a polynomial in dx and dy, so one pass has
only to sum weighted powers of them: score and information follow from 15 + 6 + 1 and 6 + 1 sums.
"""

import math

import numpy as np

from spotcheck.fitting.reading_kernel import (
    Law,
    Maps,
    compiled,
    equal_weights,
    likelihood_weights,
    normal_below,
    reading_variances,
)
from spotcheck.model.spot import TOP_HAT_LEVEL

# Compiled code in a cache of version 1.0 refers to these two by this module; without them its cache cannot be read.
__all__ = ["EQUAL", "LIKELIHOOD", "VARIANCE", "Law", "Maps", "congruent", "one_pass", "times"]

# What the pixels of a pass weigh: nothing, their information, or (for the errors of equal weights) their variance.
EQUAL, LIKELIHOOD, VARIANCE = 0, 1, 2


@compiled
def _gaussian_row(theta, y, row):
    """exp(−q/2) along a row: from its highest pixel outwards, one product for the value and one for its ratio."""
    x0, a, b, c = theta[1], theta[3], theta[4], theta[5]
    dy = y - theta[2]
    size = row.size
    highest = int(min(max(round(x0 - b * dy / a), 0.0), size - 1.0))
    dx = highest - x0
    start = math.exp(-(a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2)
    bend = math.exp(-a)
    row[highest] = start
    value, ratio = start, math.exp(-(a * (2 * dx + 1) + 2 * b * dy) / 2)
    for k in range(highest + 1, size):
        value *= ratio
        ratio *= bend
        row[k] = value
    value, ratio = start, math.exp(-(a * (1 - 2 * dx) - 2 * b * dy) / 2)
    for k in range(highest - 1, -1, -1):
        value *= ratio
        ratio *= bend
        row[k] = value


@compiled
def _powers(row, weight, score, x0):
    """Sums along a row: w g² dx^0…4, w g dx^0…2, w, s g dx^0…2, s."""
    p0 = p1 = p2 = p3 = p4 = q0 = q1 = q2 = z = t0 = t1 = t2 = r = 0.0
    for k in range(row.size):
        dx = k - x0
        d2 = dx * dx
        w, s, g = weight[k], score[k], row[k]
        wg, sg = w * g, s * g
        wgg = wg * g
        z += w
        r += s
        p0 += wgg
        p1 += wgg * dx
        p2 += wgg * d2
        p3 += wgg * (d2 * dx)
        p4 += wgg * (d2 * d2)
        q0 += wg
        q1 += wg * dx
        q2 += wg * d2
        t0 += sg
        t1 += sg * dx
        t2 += sg * d2
    return (p0, p1, p2, p3, p4), (q0, q1, q2), z, (t0, t1, t2), r


@compiled
def _plateau(row, weight, score):
    """Of the pixels on the plateau, whose light follows the amplitude alone: Σ w g², w g, s g, w, s. Their row, weight
    and score are then set to 0."""
    two = one = pull = zero = rest = 0.0
    for k in range(row.size):
        if row[k] > TOP_HAT_LEVEL:
            two += weight[k] * TOP_HAT_LEVEL**2
            one += weight[k] * TOP_HAT_LEVEL
            pull += score[k] * TOP_HAT_LEVEL
            zero += weight[k]
            rest += score[k]
            weight[k] = score[k] = 0.0
    return two, one, pull, zero, rest


@compiled
def _sums(image, theta, weighting, law, top_hat):
    """Sums of one pass: `two`[i, j] = Σ w g² dx^i dy^j, `one` of w g, `zero` of w, `score_one` of s g, `score_zero` of
    s, and Σ residual² or χ² with the number of pixels in it."""
    two, one, score_one = np.zeros((5, 5)), np.zeros((3, 3)), np.zeros((3, 3))
    zero = score_zero = chi2 = 0.0
    used = 0
    rows, columns = image.shape
    row, mean, weight, score = np.empty(columns), np.empty(columns), np.empty(columns), np.empty(columns)
    electrons = np.empty(columns)
    cut = TOP_HAT_LEVEL if top_hat else 2.0
    plain_below = normal_below(law)
    for j in range(rows):
        _gaussian_row(theta, float(j), row)
        lowest, highest = np.inf, -np.inf
        for k in range(columns):
            mean[k] = theta[0] * min(row[k], cut) + theta[6]
            electrons[k] = (mean[k] - law.black) / law.gain
            lowest, highest = min(lowest, electrons[k]), max(highest, electrons[k])
        if weighting == EQUAL:
            chi2_row, used_row = equal_weights(image[j], mean, weight, score)
        elif weighting == VARIANCE:
            chi2_row, used_row = reading_variances(image[j], mean, electrons, law, weight, score)
        else:
            plain = lowest >= law.highest and highest < plain_below
            chi2_row, used_row = likelihood_weights(image[j], electrons, plain, j, law.maps, law, weight, score)
        chi2 += chi2_row
        used += used_row
        if top_hat:
            flat_two, flat_one, flat_pull, flat_zero, flat_rest = _plateau(row, weight, score)
            two[0, 0] += flat_two
            one[0, 0] += flat_one
            score_one[0, 0] += flat_pull
            zero += flat_zero
            score_zero += flat_rest
        p, q, z, t, r = _powers(row, weight, score, theta[1])
        zero += z
        score_zero += r
        power = 1.0
        for m in range(5):
            for n in range(5 - m):
                two[n, m] += p[n] * power
            for n in range(3 - m):
                one[n, m] += q[n] * power
                score_one[n, m] += t[n] * power
            power *= j - theta[2]
    return two, one, zero, score_one, score_zero, chi2, used


# Powers of dx and dy of the six monomials 1, dx, dy, dx², dx dy, dy².
_POWERS_X = np.array([0, 1, 0, 2, 1, 0])
_POWERS_Y = np.array([0, 0, 1, 0, 1, 2])


@compiled
def one_pass(image, theta, weighting, law, top_hat):
    """Score [7] and information [7, 7] of θ, and χ² with the number of pixels in it.

    With `EQUAL` weights these are Jᵀ(y − µ), JᵀJ and Σ(y − µ)² in DN; with `LIKELIHOOD` those of the sensor's law; with
    `VARIANCE` 0, J V Jᵀ for variances V of the readings, and χ².
    """
    two, one, zero, score_one, score_zero, chi2, used = _sums(image, theta, weighting, law, top_hat)
    amplitude, a, b, c = theta[0], theta[3], theta[4], theta[5]
    # Derivatives of the light as polynomials (rows: A, x0, y0, a, b, c; columns: monomials) times g.
    poly = np.zeros((6, 6))
    poly[0, 0] = 1.0
    poly[1, 1], poly[1, 2] = amplitude * a, amplitude * b
    poly[2, 1], poly[2, 2] = amplitude * b, amplitude * c
    poly[3, 3], poly[4, 4], poly[5, 5] = -amplitude / 2, -amplitude, -amplitude / 2
    inner, edge, pull = np.empty((6, 6)), np.empty(6), np.empty(6)
    for k in range(6):
        edge[k] = one[_POWERS_X[k], _POWERS_Y[k]]
        pull[k] = score_one[_POWERS_X[k], _POWERS_Y[k]]
        for m in range(6):
            inner[k, m] = two[_POWERS_X[k] + _POWERS_X[m], _POWERS_Y[k] + _POWERS_Y[m]]
    score, information = np.empty(7), np.empty((7, 7))
    score[:6], score[6] = times(poly, pull), score_zero
    information[:6, :6] = congruent(poly.T, inner)
    information[:6, 6] = information[6, :6] = times(poly, edge)
    information[6, 6] = zero
    if weighting == LIKELIHOOD:
        score /= law.gain
        information /= law.gain * law.gain
    return score, information, chi2, used


@compiled
def times(matrix, vector):
    """M v. Plain loops: a call of BLAS for seven numbers would double the time of compilation."""
    out = np.zeros(matrix.shape[0])
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            out[i] += matrix[i, j] * vector[j]
    return out


@compiled
def congruent(chart, matrix):
    """Cᵀ M C."""
    size, inner = chart.shape[1], chart.shape[0]
    half, out = np.zeros((inner, size)), np.zeros((size, size))
    for i in range(inner):
        for j in range(size):
            for k in range(inner):
                half[i, j] += matrix[i, k] * chart[k, j]
    for i in range(size):
        for j in range(size):
            for k in range(inner):
                out[i, j] += chart[k, i] * half[k, j]
    return out
