"""Score and Fisher information of a spot by one compiled pass over the pixels of an image.

The parameters θ [7] are the amplitude A [DN], the centre x0, y0 [px], the elements a, b, c [1/px²] of the inverse
covariance matrix [[a, b], [b, c]], and the offset [DN]. They are regular at a round spot, unlike widths and
orientation.

The Gaussian is g = exp(−(a dx² + 2 b dx dy + c dy²)/2) with dx = x − x0 and dy = y − y0, so its peak is 1. The light is
A g; with `top_hat` it is cut to a plateau at A · `TOP_HAT_LEVEL`. The mean reading without clips is light + offset.
Every derivative of the light is g times a polynomial in dx and dy. One pass therefore only sums weighted powers of
them: the information follows from 15 + 6 + 1 sums and the score from 6 + 1. The compiled functions take rows of pixels
with weights w and scores s, which `reading_kernel` computes.
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

# Weightings of the pixels in a pass: 1, their information, or (for the errors of equal weights) their variance.
EQUAL, LIKELIHOOD, VARIANCE = 0, 1, 2


@compiled
def _fill_gaussian_row(theta, y, gaussian):
    """Fill `gaussian` [column] with g along the row y [px], from its highest pixel outwards.

    Each pixel is its neighbour times a ratio. The ratio changes by the constant factor exp(−a) from pixel to pixel, so
    that a row needs four exponentials only.
    """
    x0, a, b, c = theta[1], theta[3], theta[4], theta[5]
    dy = y - theta[2]
    size = gaussian.size
    highest = int(min(max(round(x0 - b * dy / a), 0.0), size - 1.0))
    dx = highest - x0
    start = math.exp(-(a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2)
    ratio_factor = math.exp(-a)
    gaussian[highest] = start
    # Rightwards.
    value, ratio = start, math.exp(-(a * (2 * dx + 1) + 2 * b * dy) / 2)
    for k in range(highest + 1, size):
        value *= ratio
        ratio *= ratio_factor
        gaussian[k] = value
    # Leftwards.
    value, ratio = start, math.exp(-(a * (1 - 2 * dx) - 2 * b * dy) / 2)
    for k in range(highest - 1, -1, -1):
        value *= ratio
        ratio *= ratio_factor
        gaussian[k] = value


@compiled
def _sum_powers(gaussian, weight, score, x0):
    """Return five sums over the pixels of a row, for the Gaussian g, weights w and scores s, all [column].

    They are Σ w g² dx^n for n = 0…4, Σ w g dx^n for n = 0…2, Σ w, Σ s g dx^n for n = 0…2, and Σ s.
    """
    wgg0 = wgg1 = wgg2 = wgg3 = wgg4 = wg0 = wg1 = wg2 = sum_w = sg0 = sg1 = sg2 = sum_s = 0.0
    for k in range(gaussian.size):
        dx = k - x0
        dx2 = dx * dx
        w, s, g = weight[k], score[k], gaussian[k]
        wg, sg = w * g, s * g
        wgg = wg * g
        sum_w += w
        sum_s += s
        wgg0 += wgg
        wgg1 += wgg * dx
        wgg2 += wgg * dx2
        wgg3 += wgg * (dx2 * dx)
        wgg4 += wgg * (dx2 * dx2)
        wg0 += wg
        wg1 += wg * dx
        wg2 += wg * dx2
        sg0 += sg
        sg1 += sg * dx
        sg2 += sg * dx2
    return (wgg0, wgg1, wgg2, wgg3, wgg4), (wg0, wg1, wg2), sum_w, (sg0, sg1, sg2), sum_s


@compiled
def _sum_plateau(gaussian, weight, score):
    """Return Σ w and Σ s over the plateau of a top hat in a row, and set w and s to 0 there.

    On the plateau g is `TOP_HAT_LEVEL`. Its light depends on the amplitude alone, so that its pixels have no part in
    the sums over powers of dx and dy.
    """
    sum_w = sum_s = 0.0
    for k in range(gaussian.size):
        if gaussian[k] > TOP_HAT_LEVEL:
            sum_w += weight[k]
            sum_s += score[k]
            weight[k] = score[k] = 0.0
    return sum_w, sum_s


@compiled
def _sum_pixels(image, theta, weighting, law, top_hat):
    """Return the sums of one pass over an image, for the Gaussian g, weights w and scores s; arguments: `score_spot`.

    The results are `sum_wgg` [i, j] of w g² dx^i dy^j, `sum_wg` [i, j] of w g dx^i dy^j, `sum_w` of w, `sum_sg` [i, j]
    of s g dx^i dy^j, `sum_s` of s, and χ² (Σ residual² with equal weights) with its number of pixels.
    """
    sum_wgg, sum_wg, sum_sg = np.zeros((5, 5)), np.zeros((3, 3)), np.zeros((3, 3))
    sum_w = sum_s = chi2 = 0.0
    used = 0
    rows, columns = image.shape
    gaussian, mean, weight, score = np.empty(columns), np.empty(columns), np.empty(columns), np.empty(columns)
    electrons = np.empty(columns)
    # The peak of the Gaussian is 1, so a limit of 2 cuts nothing.
    plateau = TOP_HAT_LEVEL if top_hat else 2.0
    clipping_onset = find_clipping_onset(law)
    for j in range(rows):
        _fill_gaussian_row(theta, float(j), gaussian)
        lowest, highest = np.inf, -np.inf
        for k in range(columns):
            mean[k] = theta[0] * min(gaussian[k], plateau) + theta[6]
            electrons[k] = (mean[k] - law.black_level) / law.gain
            lowest, highest = min(lowest, electrons[k]), max(highest, electrons[k])
        if weighting == EQUAL:
            row_chi2, row_used = score_row_equally(image[j], mean, weight, score)
        elif weighting == VARIANCE:
            row_chi2, row_used = compute_row_variances(image[j], mean, electrons, law, weight, score)
        else:
            is_plain = lowest >= law.highest_level and highest < clipping_onset
            row_chi2, row_used = score_row_by_likelihood(image[j], electrons, is_plain, j, law.maps, law, weight, score)
        chi2, used = chi2 + row_chi2, used + row_used
        if top_hat:
            plateau_w, plateau_s = _sum_plateau(gaussian, weight, score)
            sum_wgg[0, 0] += plateau_w * TOP_HAT_LEVEL**2
            sum_wg[0, 0] += plateau_w * TOP_HAT_LEVEL
            sum_sg[0, 0] += plateau_s * TOP_HAT_LEVEL
            sum_w, sum_s = sum_w + plateau_w, sum_s + plateau_s
        row_wgg, row_wg, row_w, row_sg, row_s = _sum_powers(gaussian, weight, score, theta[1])
        sum_w, sum_s = sum_w + row_w, sum_s + row_s
        dy_power = 1.0
        for m in range(5):
            for n in range(5 - m):
                sum_wgg[n, m] += row_wgg[n] * dy_power
            for n in range(3 - m):
                sum_wg[n, m] += row_wg[n] * dy_power
                sum_sg[n, m] += row_sg[n] * dy_power
            dy_power *= j - theta[2]
    return sum_wgg, sum_wg, sum_w, sum_sg, sum_s, chi2, used


# Powers of dx and dy of the six monomials 1, dx, dy, dx², dx dy, dy².
_POWERS_X = np.array([0, 1, 0, 2, 1, 0])
_POWERS_Y = np.array([0, 0, 1, 0, 1, 2])


@compiled
def score_spot(image, theta, weighting, law, top_hat):
    """Return score [7] and information [7, 7] of θ, and χ² with its number of pixels.

    Parameters
    ----------
    image : readings y [row, column] in DN, NaN if masked.
    theta : the parameters θ [7].
    weighting : what is returned, with the mean readings µ and their derivatives J [pixel, 7] by θ. `EQUAL`: Jᵀ(y − µ),
        JᵀJ and Σ(y − µ)² in place of χ², in DN. `LIKELIHOOD`: score, information and χ² under the sensor's law.
        `VARIANCE`: 0, Jᵀ V J for the variances V of the readings, and χ².
    law : distribution of a reading (`ReadingLaw`).
    top_hat : whether the light is cut to a plateau.
    """
    sum_wgg, sum_wg, sum_w, sum_sg, sum_s, chi2, used = _sum_pixels(image, theta, weighting, law, top_hat)
    amplitude, a, b, c = theta[0], theta[3], theta[4], theta[5]
    # Derivatives of the light as polynomials (rows: A, x0, y0, a, b, c; columns: monomials) times g.
    polynomials = np.zeros((6, 6))
    polynomials[0, 0] = 1.0
    polynomials[1, 1], polynomials[1, 2] = amplitude * a, amplitude * b
    polynomials[2, 1], polynomials[2, 2] = amplitude * b, amplitude * c
    polynomials[3, 3], polynomials[4, 4], polynomials[5, 5] = -amplitude / 2, -amplitude, -amplitude / 2
    # Sums of the monomials times w g, times s g, and of products of two monomials times w g².
    sums_wg, sums_sg, sums_wgg = np.empty(6), np.empty(6), np.empty((6, 6))
    for k in range(6):
        sums_wg[k] = sum_wg[_POWERS_X[k], _POWERS_Y[k]]
        sums_sg[k] = sum_sg[_POWERS_X[k], _POWERS_Y[k]]
        for m in range(6):
            sums_wgg[k, m] = sum_wgg[_POWERS_X[k] + _POWERS_X[m], _POWERS_Y[k] + _POWERS_Y[m]]
    score, information = np.empty(7), np.empty((7, 7))
    score[:6], score[6] = multiply(polynomials, sums_sg), sum_s
    information[:6, :6] = transform_information(polynomials.T, sums_wgg)
    information[:6, 6] = information[6, :6] = multiply(polynomials, sums_wg)
    information[6, 6] = sum_w
    # From mean electrons to the mean in DN.
    if weighting == LIKELIHOOD:
        score /= law.gain
        information /= law.gain * law.gain
    return score, information, chi2, used


@compiled
def multiply(matrix, vector):
    """Return the product [n] of a matrix [n, m] and a vector [m], by plain loops.

    A call of BLAS for seven numbers would double the time of compilation.
    """
    product = np.zeros(matrix.shape[0])
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            product[i] += matrix[i, j] * vector[j]
    return product


@compiled
def transform_information(jacobian, matrix):
    """Return Jᵀ M J [n, n]: the information M [m, m] for other parameters with the Jacobian J [m, n]."""
    m, n = jacobian.shape
    matrix_jacobian, information = np.zeros((m, n)), np.zeros((n, n))
    for i in range(m):
        for j in range(n):
            for k in range(m):
                matrix_jacobian[i, j] += matrix[i, k] * jacobian[k, j]
    for i in range(n):
        for j in range(n):
            for k in range(m):
                information[i, j] += jacobian[k, i] * matrix_jacobian[k, j]
    return information
