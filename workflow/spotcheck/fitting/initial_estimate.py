"""Initial estimate of a spot fit, from the light above half maximum on a grid of blocks.

The blocks are fitted by damped least squares. That optimum is within about a standard error of the final one, so two or
three undamped steps on all pixels remain. A spot narrower than a block is fitted in a window of pixels instead.
"""

import math

import numpy as np

from spotcheck.fitting.optimization import Parametrization, convert_inverse_covariance, fit_least_squares
from spotcheck.fitting.reading_kernel import compiled

# Blocks along each axis of the grid.
BLOCKS_PER_AXIS = 60
# A spot narrower than so many blocks is fitted in a window of pixels, so many widths in each direction.
NARROW_BLOCKS, WINDOW_WIDTHS = 1.2, 7.0
# A block is isolated, and may contain a whole spot, if its light is this multiple of the highest despiked block.
ISOLATION_RATIO = 2.0
# Fraction of the brightest pixel's light that at least three of its neighbours have in a spot: 0.36 at σ 0.7 px, less
# noise.
LEAST_NEIGHBOUR_LIGHT = 0.25
ALL_FREE = np.ones(7, dtype=np.bool_)


@compiled
def _average_blocks(image, size, full_scale):
    """Return means of size × size pixels [block row, block column], and the same with NaN if a pixel is clipped.

    The first find the spot, the second are fitted.
    """
    rows, columns = image.shape[0] // size, image.shape[1] // size
    blocks, unclipped = np.empty((rows, columns)), np.empty((rows, columns))
    for j in range(rows):
        for k in range(columns):
            total, count, clipped = 0.0, 0, False
            for m in range(j * size, (j + 1) * size):
                for n in range(k * size, (k + 1) * size):
                    value = float(image[m, n])
                    if not math.isnan(value):
                        total += value
                        count += 1
                        clipped = clipped or value >= full_scale
            blocks[j, k] = total / count if count else np.nan
            unclipped[j, k] = np.nan if clipped else blocks[j, k]
    return blocks, unclipped


@compiled
def _find_lower_quartile(blocks):
    """Return the lower quartile of the blocks, to a thousandth of their range; NaN with fewer than 8 of them.

    The median would fail on an overexposed crop, where most pixels read full scale.
    """
    low, high, count = np.inf, -np.inf, 0
    for value in blocks.flat:
        if value == value:
            low, high = min(low, value), max(high, value)
            count += 1
    if count < 8:
        return np.nan
    for _ in range(10):
        middle, below = (low + high) / 2, 0
        for value in blocks.flat:
            below += value <= middle
        if 4 * below < count:
            low = middle
        else:
            high = middle
    return high


@compiled
def _estimate_at_half_maximum(blocks):
    """Return θ in units of blocks from the light above half of the highest block, and whether there is any light.

    A block counts at most as its highest neighbour ("despiked"), so that a hot pixel is no spot. The size follows from
    the area above half maximum, 2π σ² ln 2, and the shape from its second moments; their size depends on the threshold.
    """
    rows, columns = blocks.shape
    theta = np.zeros(7)
    offset = _find_lower_quartile(blocks)
    if math.isnan(offset):
        return theta, False
    despiked = np.full(blocks.shape, offset)
    highest = -np.inf
    for j in range(rows):
        for k in range(columns):
            neighbour = -np.inf
            for m in range(max(j - 1, 0), min(j + 2, rows)):
                for n in range(max(k - 1, 0), min(k + 2, columns)):
                    if (m != j or n != k) and blocks[m, n] > neighbour:
                        neighbour = blocks[m, n]
            if blocks[j, k] > offset:
                despiked[j, k] = min(blocks[j, k], neighbour)
            highest = max(highest, despiked[j, k])
    amplitude = highest - offset
    if not amplitude > 0:
        return theta, False
    weight = area = sx = sy = sxx = sxy = syy = 0.0
    for j in range(rows):
        for k in range(columns):
            light = despiked[j, k] - offset
            if light > amplitude / 2:
                area += 1.0
                weight += light
                sx += light * k
                sy += light * j
                sxx += light * k * k
                sxy += light * k * j
                syy += light * j * j
    x, y = sx / weight, sy / weight
    vxx, vxy, vyy = sxx / weight - x * x + 1 / 12, sxy / weight - x * y, syy / weight - y * y + 1 / 12
    variance = max(area / (2 * math.pi * math.log(2)), 0.25)
    # The shape of the moments, scaled to the size of the area.
    scale = variance / math.sqrt(max(vxx * vyy - vxy * vxy, 1e-12))
    vxx, vxy, vyy = scale * vxx, scale * vxy, scale * vyy
    determinant = vxx * vyy - vxy * vxy
    theta[0], theta[1], theta[2], theta[6] = amplitude, x, y, offset
    theta[3], theta[4], theta[5] = vyy / determinant, -vxy / determinant, vxx / determinant
    return theta, True


@compiled
def _convert_to_pixels(theta, size):
    """Return θ in pixels of θ in blocks: the variance of a block is removed and the peak raised accordingly."""
    out = theta.copy()
    determinant = theta[3] * theta[5] - theta[4] ** 2
    square = size * size
    vxx, vxy, vyy = theta[5] / determinant * square, -theta[4] / determinant * square, theta[3] / determinant * square
    determinant_before = vxx * vyy - vxy * vxy
    # At least a third of the variance remains, for spots no wider than a block.
    block_variance = (square - 1) / 12
    least = (vxx + vyy) / 2 - math.hypot((vxx - vyy) / 2, vxy)
    block_variance = min(block_variance, 2 * least / 3)
    vxx, vyy = vxx - block_variance, vyy - block_variance
    determinant_after = vxx * vyy - vxy * vxy
    out[0] = theta[0] * math.sqrt(determinant_before / determinant_after)
    out[1], out[2] = size * theta[1] + (size - 1) / 2, size * theta[2] + (size - 1) / 2
    out[3], out[4], out[5] = vyy / determinant_after, -vxy / determinant_after, vxx / determinant_after
    return out


@compiled
def _start_from_one_block(image, blocks, size, theta):
    """Return whether one block contains a whole spot, and if so fill θ in pixels with a narrow spot there.

    `_estimate_at_half_maximum` treats an isolated block as a hot pixel. Three neighbours of the brightest pixel of a
    spot of σ 0.7 px have at least a third of its light, wherever the centre is; those of a hot pixel have none.
    """
    highest, row, column = -np.inf, 0, 0
    for j in range(blocks.shape[0]):
        for k in range(blocks.shape[1]):
            if blocks[j, k] > highest:
                highest, row, column = blocks[j, k], j, k
    offset = _find_lower_quartile(blocks)
    if not highest - offset > ISOLATION_RATIO * theta[0]:
        return False
    brightest, y, x = -np.inf, 0, 0
    for m in range(row * size, (row + 1) * size):
        for n in range(column * size, (column + 1) * size):
            if image[m, n] > brightest:
                brightest, y, x = float(image[m, n]), m, n
    bright_neighbours = 0
    for m in range(max(y - 1, 0), min(y + 2, image.shape[0])):
        for n in range(max(x - 1, 0), min(x + 2, image.shape[1])):
            if (m != y or n != x) and image[m, n] - offset > LEAST_NEIGHBOUR_LIGHT * (brightest - offset):
                bright_neighbours += 1
    if bright_neighbours < 3:
        return False
    theta[0], theta[1], theta[2], theta[6] = brightest - offset, x, y, offset
    theta[3], theta[4], theta[5] = 1.0, 0.0, 1.0
    return True


@compiled
def estimate_start(image, law, top_hat):
    """Return θ near the optimum, and whether there is any light."""
    size = max(1, min(image.shape) // BLOCKS_PER_AXIS)
    blocks, unclipped = _average_blocks(image, size, law.full_scale)
    theta, has_light = _estimate_at_half_maximum(blocks)
    if size > 1 and _start_from_one_block(image, blocks, size, theta):
        return _fit_in_window(image, theta, size, law, top_hat), True
    if not has_light:
        return theta, False
    _, minor, _ = convert_inverse_covariance(theta[3], theta[4], theta[5])
    if size == 1 or minor > NARROW_BLOCKS:
        return _convert_to_pixels(
            fit_least_squares(unclipped, theta, law, top_hat, Parametrization(ALL_FREE, False, False)), size
        ), True
    return _fit_in_window(image, _convert_to_pixels(theta, size), size, law, top_hat), True


@compiled
def _fit_in_window(image, theta, size, law, top_hat):
    """Return θ fitted to the pixels around a narrow spot, without those at full scale."""
    major, _, _ = convert_inverse_covariance(theta[3], theta[4], theta[5])
    half_side = math.ceil(WINDOW_WIDTHS * major) + size
    top, left = max(int(theta[2]) - half_side, 0), max(int(theta[1]) - half_side, 0)
    window = image[top : int(theta[2]) + half_side + 1, left : int(theta[1]) + half_side + 1].astype(np.float64)
    for j in range(window.shape[0]):
        for k in range(window.shape[1]):
            if window[j, k] >= law.full_scale:
                window[j, k] = np.nan
    theta[1] -= left
    theta[2] -= top
    theta = fit_least_squares(window, theta, law, top_hat, Parametrization(ALL_FREE, False, False))
    theta[1] += left
    theta[2] += top
    return theta
