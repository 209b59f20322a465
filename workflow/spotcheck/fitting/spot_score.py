"""Score and Fisher information of a spot by one compiled pass over the pixels of an image.

The parameters θ are the amplitude [DN], x0, y0 [px], the elements a, b, c [1/px²] of the inverse covariance, and the
offset [DN]. They are regular at a round spot, unlike widths and orientation. The light is A exp(−(a dx² + 2 b dx dy +
c dy²)/2), cut to a plateau with `top_hat`; the mean reading without clips is light + offset. Every derivative is that
Gaussian times a polynomial in dx and dy, so one pass only sums weighted powers of them: score and information follow
from 15 + 6 + 1 and 6 + 1 sums.
"""

import math

import numpy as np

from spotcheck.fitting.reading_kernel import (
    compiled,
    compute_row_variances,
    find_clipping_onset,
    score_row_by_likelihood,
    score_row_equally,
)
from spotcheck.model.spot import TOP_HAT_LEVEL

# Weights of the pixels of a pass: none, their information, or (for the errors of equal weights) their variance.
EQUAL, LIKELIHOOD, VARIANCE = 0, 1, 2


@compiled
def _fill_gaussian_row(theta, y, row):
    """Fill `row` with the Gaussian at height y, from its highest pixel outwards by ratios of neighbours."""
    x0, a, b, c = theta[1], theta[3], theta[4], theta[5]
    dy = y - theta[2]
    size = row.size
    highest = int(min(max(round(x0 - b * dy / a), 0.0), size - 1.0))
    dx = highest - x0
    start = math.exp(-(a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2)
    ratio_step = math.exp(-a)
    row[highest] = start
    value, ratio = start, math.exp(-(a * (2 * dx + 1) + 2 * b * dy) / 2)
    for k in range(highest + 1, size):
        value *= ratio
        ratio *= ratio_step
        row[k] = value
    value, ratio = start, math.exp(-(a * (1 - 2 * dx) - 2 * b * dy) / 2)
    for k in range(highest - 1, -1, -1):
        value *= ratio
        ratio *= ratio_step
        row[k] = value


@compiled
def _sum_powers(row, weight, score, x0):
    """Return sums along a row of weights w, scores s and the Gaussian g: w g² dx^0…4, w g dx^0…2, w, s g dx^0…2, s."""
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
def _sum_plateau(row, weight, score):
    """Return Σ w g², w g, s g, w, s over the plateau, whose light depends on the amplitude alone, and clear its pixels.

    Weight and score of these pixels become 0.
    """
    sum_wgg = sum_wg = sum_sg = sum_w = sum_s = 0.0
    for k in range(row.size):
        if row[k] > TOP_HAT_LEVEL:
            sum_wgg += weight[k] * TOP_HAT_LEVEL**2
            sum_wg += weight[k] * TOP_HAT_LEVEL
            sum_sg += score[k] * TOP_HAT_LEVEL
            sum_w += weight[k]
            sum_s += score[k]
            weight[k] = score[k] = 0.0
    return sum_wgg, sum_wg, sum_sg, sum_w, sum_s


@compiled
def _sum_pixels(image, theta, weighting, law, top_hat):
    """Return the sums of one pass over weights w, scores s and the Gaussian g.

    `sum_wgg`[i, j] = Σ w g² dx^i dy^j, `sum_wg` and `sum_sg` [i, j] of w g and s g, `sum_w` and `sum_s`; then Σ
    residual² or χ² with its number of pixels.
    """
    sum_wgg, sum_wg, sum_sg = np.zeros((5, 5)), np.zeros((3, 3)), np.zeros((3, 3))
    sum_w = sum_s = chi2 = 0.0
    used = 0
    rows, columns = image.shape
    row, mean, weight, score = np.empty(columns), np.empty(columns), np.empty(columns), np.empty(columns)
    electrons = np.empty(columns)
    cut = TOP_HAT_LEVEL if top_hat else 2.0
    clipping_onset = find_clipping_onset(law)
    for j in range(rows):
        _fill_gaussian_row(theta, float(j), row)
        lowest, highest = np.inf, -np.inf
        for k in range(columns):
            mean[k] = theta[0] * min(row[k], cut) + theta[6]
            electrons[k] = (mean[k] - law.black_level) / law.gain
            lowest, highest = min(lowest, electrons[k]), max(highest, electrons[k])
        if weighting == EQUAL:
            chi2_row, used_row = score_row_equally(image[j], mean, weight, score)
        elif weighting == VARIANCE:
            chi2_row, used_row = compute_row_variances(image[j], mean, electrons, law, weight, score)
        else:
            is_plain = lowest >= law.highest_level and highest < clipping_onset
            chi2_row, used_row = score_row_by_likelihood(image[j], electrons, is_plain, j, law.maps, law, weight, score)
        chi2 += chi2_row
        used += used_row
        if top_hat:
            flat_wgg, flat_wg, flat_sg, flat_w, flat_s = _sum_plateau(row, weight, score)
            sum_wgg[0, 0] += flat_wgg
            sum_wg[0, 0] += flat_wg
            sum_sg[0, 0] += flat_sg
            sum_w += flat_w
            sum_s += flat_s
        p, q, z, t, r = _sum_powers(row, weight, score, theta[1])
        sum_w += z
        sum_s += r
        power = 1.0
        for m in range(5):
            for n in range(5 - m):
                sum_wgg[n, m] += p[n] * power
            for n in range(3 - m):
                sum_wg[n, m] += q[n] * power
                sum_sg[n, m] += t[n] * power
            power *= j - theta[2]
    return sum_wgg, sum_wg, sum_w, sum_sg, sum_s, chi2, used


# Powers of dx and dy of the six monomials 1, dx, dy, dx², dx dy, dy².
_POWERS_X = np.array([0, 1, 0, 2, 1, 0])
_POWERS_Y = np.array([0, 0, 1, 0, 1, 2])


@compiled
def score_spot(image, theta, weighting, law, top_hat):
    """Return score [7] and information [7, 7] of θ, and χ² with its number of pixels.

    Parameters
    ----------
    image : readings [row, column] in DN, NaN if masked.
    theta : the parameters θ [7].
    weighting : `EQUAL` gives Jᵀ(y − µ), JᵀJ and Σ(y − µ)² in DN; `LIKELIHOOD` those of the sensor's law; `VARIANCE` 0,
        J V Jᵀ for variances V of the readings, and χ².
    law : distribution of a reading.
    top_hat : whether the light is cut to a plateau.
    """
    sum_wgg, sum_wg, sum_w, sum_sg, sum_s, chi2, used = _sum_pixels(image, theta, weighting, law, top_hat)
    amplitude, a, b, c = theta[0], theta[3], theta[4], theta[5]
    # Derivatives of the light as polynomials (rows: A, x0, y0, a, b, c; columns: monomials) times g.
    poly = np.zeros((6, 6))
    poly[0, 0] = 1.0
    poly[1, 1], poly[1, 2] = amplitude * a, amplitude * b
    poly[2, 1], poly[2, 2] = amplitude * b, amplitude * c
    poly[3, 3], poly[4, 4], poly[5, 5] = -amplitude / 2, -amplitude, -amplitude / 2
    moments, offset_moments, score_terms = np.empty((6, 6)), np.empty(6), np.empty(6)
    for k in range(6):
        offset_moments[k] = sum_wg[_POWERS_X[k], _POWERS_Y[k]]
        score_terms[k] = sum_sg[_POWERS_X[k], _POWERS_Y[k]]
        for m in range(6):
            moments[k, m] = sum_wgg[_POWERS_X[k] + _POWERS_X[m], _POWERS_Y[k] + _POWERS_Y[m]]
    score, information = np.empty(7), np.empty((7, 7))
    score[:6], score[6] = multiply(poly, score_terms), sum_s
    information[:6, :6] = transform_information(poly.T, moments)
    information[:6, 6] = information[6, :6] = multiply(poly, offset_moments)
    information[6, 6] = sum_w
    if weighting == LIKELIHOOD:
        score /= law.gain
        information /= law.gain * law.gain
    return score, information, chi2, used


@compiled
def multiply(matrix, vector):
    """Return M v by plain loops: a call of BLAS for seven numbers would double the time of compilation."""
    out = np.zeros(matrix.shape[0])
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            out[i] += matrix[i, j] * vector[j]
    return out


@compiled
def transform_information(jacobian, matrix):
    """Return Jᵀ M J [n, n]: the information M [m, m] for other parameters with the Jacobian J [m, n]."""
    size, inner = jacobian.shape[1], jacobian.shape[0]
    half, out = np.zeros((inner, size)), np.zeros((size, size))
    for i in range(inner):
        for j in range(size):
            for k in range(inner):
                half[i, j] += matrix[i, k] * jacobian[k, j]
    for i in range(size):
        for j in range(size):
            for k in range(inner):
                out[i, j] += jacobian[k, i] * half[k, j]
    return out
