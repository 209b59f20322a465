"""Initial estimate of a spot fit, from the light above half maximum on a grid of blocks.

A block is a square of pixels that are averaged. The blocks are fitted by damped least squares. That optimum is within
about a standard error of the final one, so two or three undamped steps on all pixels remain. A spot narrower than a
block is fitted in a window of pixels instead.

θ [7] are the parameters of the spot (`spot_score`): amplitude [DN], x0, y0 [px], the elements a, b, c [1/px²] of the
inverse covariance matrix, and offset [DN]. NaN pixels are masked.
"""

import math

import numpy as np

from spotcheck.fitting.optimization import Parametrization, convert_inverse_covariance, fit_least_squares
from spotcheck.fitting.reading_kernel import compiled

# Blocks along each axis of the grid.
BLOCKS_PER_AXIS = 60
# A spot is fitted in a window of pixels if σ along its short axis is at most this number of blocks. The window extends
# from the centre to each side by this number of σ along the long axis.
NARROW_BLOCKS, WINDOW_WIDTHS = 1.2, 7.0
# A block is isolated, and may contain a whole spot, if its light is this multiple of the highest despiked block.
ISOLATION_RATIO = 2.0
# Fraction of the brightest pixel's light that at least three of its neighbours have in a spot: 0.36 at σ 0.7 px, less
# noise.
LEAST_NEIGHBOUR_LIGHT = 0.25
# Neighbours of the brightest pixel that must have so much light.
BRIGHT_NEIGHBOURS = 3
# Fewest blocks for an estimate of the offset.
FEWEST_BLOCKS = 8
# All seven parameters θ are free in a fit. `Parametrization(ALL_FREE, False, False)` means: neither widths and
# orientation instead of θ, nor a circular spot.
ALL_FREE = np.ones(7, dtype=np.bool_)


@compiled
def _average_blocks(image, size, full_scale):
    """Return the means of size × size pixels, and the same with NaN for blocks with a clipped pixel.

    Both are [block row, block column] in DN, NaN for blocks whose pixels are all masked. The first serve to find the
    spot; the second are fitted. `image` is [row, column] in DN. A reading of `full_scale` [DN] or more is clipped.
    """
    rows, columns = image.shape[0] // size, image.shape[1] // size
    blocks, unclipped = np.empty((rows, columns)), np.empty((rows, columns))
    for j in range(rows):
        for k in range(columns):
            total, count, is_clipped = 0.0, 0, False
            for m in range(j * size, (j + 1) * size):
                for n in range(k * size, (k + 1) * size):
                    value = float(image[m, n])
                    if not math.isnan(value):
                        total += value
                        count += 1
                        is_clipped = is_clipped or value >= full_scale
            blocks[j, k] = total / count if count else np.nan
            unclipped[j, k] = np.nan if is_clipped else blocks[j, k]
    return blocks, unclipped


@compiled
def _find_lower_quartile(blocks):
    """Return the lower quartile of the blocks [DN], which estimates the offset; NaN with fewer than `FEWEST_BLOCKS`.

    The median would fail on an overexposed crop, where most pixels read full scale. `blocks` is [block row, block
    column] in DN; NaN does not count.
    """
    low, high, count = np.inf, -np.inf, 0
    for value in blocks.flat:
        if value == value:  # False for NaN
            low, high = min(low, value), max(high, value)
            count += 1
    if count < FEWEST_BLOCKS:
        return np.nan
    # Ten bisections give the quartile to a thousandth of the range.
    for _ in range(10):
        middle, count_below = (low + high) / 2, 0
        for value in blocks.flat:
            count_below += value <= middle
        if 4 * count_below < count:
            low = middle
        else:
            high = middle
    return high


@compiled
def _estimate_at_half_maximum(blocks):
    """Return θ with lengths in blocks, from the light above half of the highest block, and whether there is any light.

    `blocks` is [block row, block column] in DN, NaN if unknown. A block counts at most as much as its highest neighbour
    ("despiked"), so that a hot pixel is no spot. The size σ of the spot follows from the area above half maximum,
    2π σ² ln 2. The shape follows from the second moments of that light; their size is not used, as it depends on the
    threshold.
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
            highest_neighbour = -np.inf
            for m in range(max(j - 1, 0), min(j + 2, rows)):
                for n in range(max(k - 1, 0), min(k + 2, columns)):
                    if (m != j or n != k) and blocks[m, n] > highest_neighbour:
                        highest_neighbour = blocks[m, n]
            if blocks[j, k] > offset:
                despiked[j, k] = min(blocks[j, k], highest_neighbour)
            highest = max(highest, despiked[j, k])
    amplitude = highest - offset
    if not amplitude > 0:
        return theta, False
    # Sums over the blocks above half maximum: their number, their light, and light times x, y and their products.
    area = total = sum_x = sum_y = sum_xx = sum_xy = sum_yy = 0.0
    for j in range(rows):
        for k in range(columns):
            light = despiked[j, k] - offset
            if light > amplitude / 2:
                area += 1.0
                total += light
                sum_x += light * k
                sum_y += light * j
                sum_xx += light * k * k
                sum_xy += light * k * j
                sum_yy += light * j * j
    x, y = sum_x / total, sum_y / total
    # Covariance matrix of that light; 1/12 is the variance of a block of side 1.
    var_x, cov_xy, var_y = sum_xx / total - x * x + 1 / 12, sum_xy / total - x * y, sum_yy / total - y * y + 1 / 12
    variance = max(area / (2 * math.pi * math.log(2)), 0.25)
    # The shape of the moments, scaled to the size of the area.
    scale = variance / math.sqrt(max(var_x * var_y - cov_xy * cov_xy, 1e-12))
    var_x, cov_xy, var_y = scale * var_x, scale * cov_xy, scale * var_y
    determinant = var_x * var_y - cov_xy * cov_xy
    theta[0], theta[1], theta[2], theta[6] = amplitude, x, y, offset
    theta[3], theta[4], theta[5] = var_y / determinant, -cov_xy / determinant, var_x / determinant
    return theta, True


@compiled
def _convert_to_pixels(theta, size):
    """Return θ with lengths in pixels from θ with lengths in blocks of `size` pixels.

    Averaging over blocks widens the spot. The variance of a block is removed, and the peak raised accordingly.
    """
    pixel_theta = theta.copy()
    determinant = theta[3] * theta[5] - theta[4] ** 2
    square = size * size
    # Covariance matrix of the spot [px²].
    var_x, cov_xy = theta[5] / determinant * square, -theta[4] / determinant * square
    var_y = theta[3] / determinant * square
    determinant_before = var_x * var_y - cov_xy * cov_xy
    # At least a third of the variance remains, for spots no wider than a block.
    minor_variance = (var_x + var_y) / 2 - math.hypot((var_x - var_y) / 2, cov_xy)
    block_variance = min((square - 1) / 12, 2 * minor_variance / 3)
    var_x, var_y = var_x - block_variance, var_y - block_variance
    determinant = var_x * var_y - cov_xy * cov_xy
    pixel_theta[0] = theta[0] * math.sqrt(determinant_before / determinant)
    pixel_theta[1], pixel_theta[2] = size * theta[1] + (size - 1) / 2, size * theta[2] + (size - 1) / 2
    pixel_theta[3], pixel_theta[4], pixel_theta[5] = var_y / determinant, -cov_xy / determinant, var_x / determinant
    return pixel_theta


@compiled
def _start_from_one_block(image, blocks, size, theta):
    """Return whether one block contains a whole spot; if so, fill `theta` with a narrow spot there, lengths in pixels.

    Before that, `theta` is the result of `_estimate_at_half_maximum`, which treats an isolated block as a hot pixel. A
    spot differs from a hot pixel by its neighbours: at σ 0.7 px, three neighbours of the brightest pixel have at least
    a third of its light, wherever the centre is. Those of a hot pixel have none. `image` [row, column] and `blocks`
    [block row, block column] are in DN; `size` is the side of a block [px].
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
    if bright_neighbours < BRIGHT_NEIGHBOURS:
        return False
    theta[0], theta[1], theta[2], theta[6] = brightest - offset, x, y, offset
    # Both widths are 1 px.
    theta[3], theta[4], theta[5] = 1.0, 0.0, 1.0
    return True


@compiled
def estimate_start(image, law, top_hat):
    """Return θ near the optimum, and whether there is any light; without light θ is meaningless.

    Parameters
    ----------
    image : readings [row, column] in DN, NaN if masked.
    law : distribution of a reading (`ReadingLaw`); pixels that read its full scale are clipped.
    top_hat : whether the light is cut to a plateau.
    """
    size = max(1, min(image.shape) // BLOCKS_PER_AXIS)
    blocks, unclipped = _average_blocks(image, size, law.full_scale)
    theta, has_light = _estimate_at_half_maximum(blocks)
    if size > 1 and _start_from_one_block(image, blocks, size, theta):
        return _fit_in_window(image, theta, size, law, top_hat), True
    if not has_light:
        return theta, False
    _, minor, _ = convert_inverse_covariance(theta[3], theta[4], theta[5])
    if size == 1 or minor > NARROW_BLOCKS:
        theta = fit_least_squares(unclipped, theta, law, top_hat, Parametrization(ALL_FREE, False, False))
        return _convert_to_pixels(theta, size), True
    return _fit_in_window(image, _convert_to_pixels(theta, size), size, law, top_hat), True


@compiled
def _fit_in_window(image, theta, size, law, top_hat):
    """Return θ [7] with lengths in pixels, fitted to the pixels around a narrow spot, without those at full scale.

    `theta` is the start in the same form and is overwritten; `size` is the side of a block [px]. The other arguments
    are those of `estimate_start`.
    """
    major, _, _ = convert_inverse_covariance(theta[3], theta[4], theta[5])
    # One block more, as the start may be off the centre by a block.
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
