"""Where the search for a spot starts: from the light above half maximum on a grid of blocks.

The blocks are fitted by damped least squares; their optimum lies within a standard error or so of the final one, where
two or three undamped steps on all pixels remain. A spot narrower than a block is fitted in a window of pixels instead.
"""

import math

import numpy as np

from spotcheck.fitting.reading_kernel import compiled
from spotcheck.fitting.search import least_squares, widths_of

# Blocks an axis that the start is searched on.
BLOCKS = 60
# A spot narrower than this many blocks is fitted in a window of pixels instead, this many widths each way.
NARROW, WINDOW = 1.2, 7.0
# A block with this many times the light of all that do not stand alone may hold a whole spot; and the part of its
# brightest pixel's light that three neighbours then have: 0.36 at σ 0.7 px, less noise.
STANDS_ALONE, LEAST_LIT = 2.0, 0.25
EVERY = np.ones(7, dtype=np.bool_)


@compiled
def _blocks(image, size, full_scale):
    """Means of size × size pixels for finding the spot, and the same with NaN where a pixel is clipped, for the fit."""
    rows, columns = image.shape[0] // size, image.shape[1] // size
    seen, fitted = np.empty((rows, columns)), np.empty((rows, columns))
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
            seen[j, k] = total / count if count else np.nan
            fitted[j, k] = np.nan if clipped else seen[j, k]
    return seen, fitted


@compiled
def _quartile(seen):
    """Lower quartile of the blocks, to a thousandth of their range; NaN with fewer than 8 of them.

    Not the median: in an overexposed crop most pixels read full scale.
    """
    low, high, count = np.inf, -np.inf, 0
    for value in seen.flat:
        if value == value:
            low, high = min(low, value), max(high, value)
            count += 1
    if count < 8:
        return np.nan
    for _ in range(10):
        middle, below = (low + high) / 2, 0
        for value in seen.flat:
            below += value <= middle
        if 4 * below < count:
            low = middle
        else:
            high = middle
    return high


@compiled
def _moments(seen):
    """θ from the light above half of the highest block, and whether there is any.

    A block that stands alone counts as much as its highest neighbour: a hot pixel is no spot. Widths come from the
    area above half maximum, 2π σ² ln 2, and its second moments: robust where a threshold cuts moments.
    """
    rows, columns = seen.shape
    theta = np.zeros(7)
    offset = _quartile(seen)
    if math.isnan(offset):
        return theta, False
    calm = np.full(seen.shape, offset)
    highest = -np.inf
    for j in range(rows):
        for k in range(columns):
            near = -np.inf
            for m in range(max(j - 1, 0), min(j + 2, rows)):
                for n in range(max(k - 1, 0), min(k + 2, columns)):
                    if (m != j or n != k) and seen[m, n] > near:
                        near = seen[m, n]
            if seen[j, k] > offset:
                calm[j, k] = min(seen[j, k], near)
            highest = max(highest, calm[j, k])
    amplitude = highest - offset
    if not amplitude > 0:
        return theta, False
    weight = area = sx = sy = sxx = sxy = syy = 0.0
    for j in range(rows):
        for k in range(columns):
            light = calm[j, k] - offset
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
    # The form of the moments, at the size of the area.
    scale = variance / math.sqrt(max(vxx * vyy - vxy * vxy, 1e-12))
    vxx, vxy, vyy = scale * vxx, scale * vxy, scale * vyy
    determinant = vxx * vyy - vxy * vxy
    theta[0], theta[1], theta[2], theta[6] = amplitude, x, y, offset
    theta[3], theta[4], theta[5] = vyy / determinant, -vxy / determinant, vxx / determinant
    return theta, True


@compiled
def _from_blocks(theta, size):
    """θ on pixels of θ on blocks: positions and widths scaled, the width of a block taken off, the peak raised."""
    out = theta.copy()
    determinant = theta[3] * theta[5] - theta[4] ** 2
    square = size * size
    vxx, vxy, vyy = theta[5] / determinant * square, -theta[4] / determinant * square, theta[3] / determinant * square
    before = vxx * vyy - vxy * vxy
    # Never below a third of what was found, for spots no wider than a block.
    own = (square - 1) / 12
    least = (vxx + vyy) / 2 - math.hypot((vxx - vyy) / 2, vxy)
    own = min(own, 2 * least / 3)
    vxx, vyy = vxx - own, vyy - own
    after = vxx * vyy - vxy * vxy
    out[0] = theta[0] * math.sqrt(before / after)
    out[1], out[2] = size * theta[1] + (size - 1) / 2, size * theta[2] + (size - 1) / 2
    out[3], out[4], out[5] = vyy / after, -vxy / after, vxx / after
    return out


@compiled
def _alone(image, seen, size, theta):
    """Whether all light lies in one block, and several pixels of it; θ is then put on them.

    `_moments` takes a block that stands alone for a hot pixel. Of a spot of σ 0.7 px three neighbours have a third of
    the brightest pixel's light at least, wherever it lies between them; of a hot pixel they have noise.
    """
    highest, row, column = -np.inf, 0, 0
    for j in range(seen.shape[0]):
        for k in range(seen.shape[1]):
            if seen[j, k] > highest:
                highest, row, column = seen[j, k], j, k
    offset = _quartile(seen)
    if not highest - offset > STANDS_ALONE * theta[0]:
        return False
    brightest, y, x = -np.inf, 0, 0
    for m in range(row * size, (row + 1) * size):
        for n in range(column * size, (column + 1) * size):
            if image[m, n] > brightest:
                brightest, y, x = float(image[m, n]), m, n
    lit = 0
    for m in range(max(y - 1, 0), min(y + 2, image.shape[0])):
        for n in range(max(x - 1, 0), min(x + 2, image.shape[1])):
            if (m != y or n != x) and image[m, n] - offset > LEAST_LIT * (brightest - offset):
                lit += 1
    if lit < 3:
        return False
    theta[0], theta[1], theta[2], theta[6] = brightest - offset, x, y, offset
    theta[3], theta[4], theta[5] = 1.0, 0.0, 1.0
    return True


@compiled
def find_start(image, law, top_hat):
    """θ near the optimum, and whether there is light at all."""
    size = max(1, min(image.shape) // BLOCKS)
    seen, fitted = _blocks(image, size, law.full_scale)
    theta, found = _moments(seen)
    if size > 1 and _alone(image, seen, size, theta):
        return _in_window(image, theta, size, law, top_hat), True
    if not found:
        return theta, False
    _, minor, _ = widths_of(theta[3], theta[4], theta[5])
    if size == 1 or minor > NARROW:
        return _from_blocks(least_squares(fitted, theta, law, top_hat, EVERY, False, False), size), True
    return _in_window(image, _from_blocks(theta, size), size, law, top_hat), True


@compiled
def _in_window(image, theta, size, law, top_hat):
    """θ fitted to the pixels around a narrow spot, those at full scale left out."""
    major, _, _ = widths_of(theta[3], theta[4], theta[5])
    reach = math.ceil(WINDOW * major) + size
    top, left = max(int(theta[2]) - reach, 0), max(int(theta[1]) - reach, 0)
    part = image[top : int(theta[2]) + reach + 1, left : int(theta[1]) + reach + 1].astype(np.float64)
    for j in range(part.shape[0]):
        for k in range(part.shape[1]):
            if part[j, k] >= law.full_scale:
                part[j, k] = np.nan
    theta[1] -= left
    theta[2] -= top
    theta = least_squares(part, theta, law, top_hat, EVERY, False, False)
    theta[1] += left
    theta[2] += top
    return theta
