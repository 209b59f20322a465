"""Temporal noise from two frames of the same pixels: the pattern that both share cancels in their difference.

Grain is the fixed pattern of the light of a spot, such as speckle. Differences of neighbouring pixels cannot separate
grain as fine as the pixels from noise, but two exposures of a site share the grain. Let y₁, y₂ be the readings of a
pixel over black, S₁, S₂ their means, and r = S₂/S₁ the brightness ratio. The residual y₂ − r y₁ is noise with the
variance floor (1 + r²) + K (S₂ + r² S₁), where floor is the variance without light [DN²] and K the gain [DN/e-].
Divided by (1 + r²), this is the noise of a single pixel, floor + K L, at the level L = (S₂ + r² S₁)/(1 + r²).

r varies slowly over the frame, so it is estimated from the light of blocks of pixels. A tally is the sums over pixels
from which noise against level is computed, in bins of the darkest reading nearby and of the level L.
"""

from collections.abc import Iterator

import numpy as np
import xarray as xr
from scipy.ndimage import minimum_filter, uniform_filter

from spotcheck.characterization.noise_curve import BIN_ERROR, CUT_AT_SD, MIN_COUNT, NoiseCurve
from spotcheck.crops.cropping import is_usable, iterate_cells, read_measured_crop
from spotcheck.io import store

# Side of a block [px].
SIDE = 10


def evaluate_quadratic(down: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the six terms of a quadratic [term, …] at positions […] in px: a constant, two linear, three quadratic."""
    return np.stack([np.ones_like(down), down, right, down**2, down * right, right**2])


# Positions of the pixels of a block from its centre [px], [pixel].
DOWN, RIGHT = np.mgrid[:SIDE, :SIDE].reshape(2, -1) - (SIDE - 1) / 2
# Projection [pixel, pixel] that removes the least-squares quadratic from the values of a block.
WITHOUT_QUADRATIC = np.eye(SIDE**2) - np.linalg.pinv(evaluate_quadratic(DOWN, RIGHT)) @ evaluate_quadratic(DOWN, RIGHT)
# Part of the variance of white noise that remains in each pixel after the projection [pixel].
REMAINING_VARIANCE = (WITHOUT_QUADRATIC**2).sum(axis=0)
# Numbers of terms of a constant, a plane and a quadratic.
TERMS = (1, 3, 6)
# A block determines r if its mean light exceeds this number of standard errors; otherwise its grain is negligible.
MIN_LIGHT_SD = 5.0
# Edges of the bins of reading and of level [DN], ten per decade; the first bin contains everything below, the last
# everything above.
EDGES = np.geomspace(1e-1, 1e6, 71)
# A tally of no pixels: [sum, bin of reading, bin of level], see `tally_differences` for the four sums.
EMPTY_TALLY = np.zeros((4, len(EDGES), len(EDGES)))
# Least mean square residual of a block [DN²] in a divisor.
MIN_SQUARE = 1e-300
# ln r at a pixel may lie outside the range of the ln r of all blocks by this much; the quadratic is limited to that.
LOG_MARGIN = 1.0


def _multiply_by_neighbours(residual: np.ndarray) -> np.ndarray:
    """Return each residual times the mean of its right and lower neighbours [block, pixel] in DN².

    The sum of the products shows whether neighbours correlate. The product is 0 in the last row and column of a block.
    `residual` is [block, pixel] in DN.
    """
    image = residual.reshape(-1, SIDE, SIDE)
    product = np.zeros_like(image)
    product[:, :-1, :-1] = image[:, :-1, :-1] * (image[:, :-1, 1:] + image[:, 1:, :-1]) / 2
    return product.reshape(residual.shape)


# Sum of these products over the sum of squares for white noise; it is not 0, as the quadratic was removed.
WHITE_COVARIANCE = float(_multiply_by_neighbours(WITHOUT_QUADRATIC).trace() / WITHOUT_QUADRATIC.trace())
# A level is correlated if its sum of products exceeds that of white noise by this number of standard errors: the light
# moved, or has finer structure.
MAX_COVARIANCE_SD = 3.0
# If at least this part of the levels is correlated, all levels are rejected.
MAX_CORRELATED_PART = 0.1


def iterate_pairs(images: xr.Dataset, axis: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield pairs of images [rows, columns] in DN of the same pixels, neighbours along an axis of a grid of crops.

    No frame is in two pairs. Pairs are formed from the end of the axis, where the brightest exposure is.

    Parameters
    ----------
    images : crops of one centring, with `image`, `status`, `top` and `left` over the grid.
    axis : axis of the grid along which pairs are formed. If the grid does not have it, nothing is yielded.
    """
    dims = store.grid_dims(images)
    if axis not in dims:
        return
    for cell in iterate_cells(images, tuple(dim for dim in dims if dim != axis)):
        line = images.isel(cell)
        # Indices along the axis, from its end.
        usable_indices = [index for index, status in enumerate(line["status"].values) if is_usable(status)][::-1]
        # Not strict: the first usable frame of an odd number has no partner.
        for first_index, second_index in zip(usable_indices[1::2], usable_indices[::2], strict=False):
            first, second = line.isel({axis: first_index}), line.isel({axis: second_index})
            down, right = (int(second[name]) - int(first[name]) for name in ("top", "left"))
            yield align_images(read_measured_crop(first), read_measured_crop(second), down, right)


def align_images(first: np.ndarray, second: np.ndarray, down: int, right: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the parts of two images [rows, columns] that show the same pixels of the sensor.

    Parameters
    ----------
    first, second : two crops of the sensor.
    down, right : position of the upper left corner of the second one relative to that of the first [px].
    """
    rows, columns = (min(sizes) for sizes in zip(first.shape, second.shape, strict=True))
    # Crops that are further apart than their size share nothing.
    height, width = max(rows - abs(down), 0), max(columns - abs(right), 0)

    def cut_shared(image: np.ndarray, top: int, left: int) -> np.ndarray:
        """Return the shared part of an image; a negative `top` or `left` counts as 0."""
        return image[max(top, 0) : max(top, 0) + height, max(left, 0) : max(left, 0) + width]

    return cut_shared(first, down, right), cut_shared(second, -down, -right)


def tally_differences(first: np.ndarray, second: np.ndarray, black_dn: float, full_scale_dn: float) -> np.ndarray:
    """Return sums over the pixels that two images share [sum, bin of reading, bin of level]; tallies can be added.

    The four sums are the number of pixels, their levels over black [DN], the squares of the residuals y₂ − r y₁ [DN²],
    and the products of neighbouring residuals [DN²]. Squares and products are divided by (1 + r²) and corrected for the
    variance that fits remove. A quadratic and a common motion are removed from the residuals of each block. The bin of
    reading is given by the darkest reading nearby in either image. Neighbouring pixels decide on both bins, so that no
    pixel is selected by its own noise.

    Parameters
    ----------
    first, second : images of the same pixels [rows, columns] in DN. The second may have moved by a part of a pixel.
    black_dn : black level [DN].
    full_scale_dn : blocks that reach this reading [DN] are left out, as are blocks with NaN.
    """
    if min(first.shape) < SIDE:
        return EMPTY_TALLY
    first, second = (image.astype(float) - black_dn for image in (first, second))
    around_first, around_second = _average_around(first), _average_around(second)
    # A minimum, since grain makes pixels darker than their surroundings.
    darkest = minimum_filter(np.minimum(around_first, around_second), 3) + black_dn
    # The gradient has the slopes of the light down and to the right [DN/px].
    images = (first, second, around_first, around_second, darkest, *np.gradient(first))
    # [image, block row, block column, pixel], and a mask [block row, block column].
    blocks = np.stack([_cut_blocks(image) for image in images])
    is_used = np.isfinite(blocks).all(axis=(0, 3)) & (blocks[:2].max(axis=(0, 3)) + black_dn < full_scale_dn)
    # From here on, arrays are [block, pixel] of the used blocks.
    y1, y2, around_y1, around_y2, darkest, *slopes = blocks[:, is_used]
    ratio, is_scaled = (array[is_used] for array in _fit_ratio(*np.where(is_used[..., None], blocks[:2], np.nan)))
    residual = (y2 - ratio * y1) @ WITHOUT_QUADRATIC
    # The residuals of a scaled block have the sum 0, so the mean effect of a motion is removed from its slopes as well.
    # Other blocks are not scaled: infinite light leaves their slopes as they are.
    light = np.where(is_scaled, y1.mean(axis=1), np.inf)
    motion_effects = np.stack([slope - (slope.mean(axis=1) / light)[:, None] * y1 for slope in slopes])
    residual = _remove_motion(residual, motion_effects @ WITHOUT_QUADRATIC)

    def combine_levels(level_1: np.ndarray, level_2: np.ndarray) -> np.ndarray:
        """Return the level L = (S₂ + r² S₁)/(1 + r²) [DN] from the levels S₁ and S₂ in the two images."""
        return (level_2 + ratio**2 * level_1) / (1 + ratio**2)

    # The projection mixes the noise of all pixels of a block, so the level is mixed in the same way.
    level = combine_levels(y1, y2) @ WITHOUT_QUADRATIC**2 / REMAINING_VARIANCE
    # Divided so that the mean of the squares is the variance of a single pixel.
    square, product = (
        array / REMAINING_VARIANCE / (1 + ratio**2) for array in (residual**2, _multiply_by_neighbours(residual))
    )
    bins = tuple(np.searchsorted(EDGES[1:], image.ravel()) for image in (darkest, combine_levels(around_y1, around_y2)))
    tally = EMPTY_TALLY.copy()
    for sums, image in zip(tally, (np.ones_like(level), level, square, product), strict=True):
        np.add.at(sums, bins, image.ravel())
    return tally


def _fit_ratio(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the brightness ratio r of two images at each pixel, and whether a block scales it with its own light.

    Spots are nearly Gaussian, so ln r is a quadratic in position over all blocks. Each block whose light is significant
    then scales its r. It does not fit slopes, which would absorb a part of its noise.

    Parameters
    ----------
    first, second : the images [block row, block column, pixel] in DN over black; NaN in blocks that are left out.

    Returns
    -------
    tuple of numpy.ndarray
        r of the same shape, 1 if no block is significant; and a mask [block row, block column].
    """
    light_1, light_2 = first.mean(axis=2), second.mean(axis=2)
    # The standard error of a mean of SIDE² pixels is their noise over SIDE. NaN compares as False.
    is_significant = (light_1 > MIN_LIGHT_SD * _estimate_noise(first) / SIDE) & (light_2 > 0)
    if not is_significant.any():
        return np.ones_like(first), is_significant
    # Centres of the blocks from that of the image [px], [axis, block row, block column].
    centre = SIDE * (np.indices(light_1.shape) - np.reshape(light_1.shape, (2, 1, 1)) / 2)
    # At least two blocks for each term: with fewer, the terms would follow the noise.
    term_count = max(count for count in TERMS if count == 1 or 2 * count <= is_significant.sum())
    log_ratio = np.log(light_2[is_significant] / light_1[is_significant])
    # Shot noise gives ln r an error in proportion to one over the root of the light.
    weight = np.sqrt(light_1[is_significant])
    # The ratio of a block applies at the centroid of its light, which is off its centre beside a narrow spot.
    centroid = np.stack([(first[is_significant] * place).mean(axis=1) / light_1[is_significant]
                         for place in (DOWN, RIGHT)])  # fmt: skip
    positions = centre[:, is_significant] + np.clip(centroid, -SIDE / 2, SIDE / 2)
    design = evaluate_quadratic(*positions)[:term_count]
    coefficients = np.linalg.lstsq((design * weight).T, log_ratio * weight, rcond=None)[0]
    pixel_terms = evaluate_quadratic(centre[0, ..., None] + DOWN, centre[1, ..., None] + RIGHT)[:term_count]
    fitted_log_ratio = np.tensordot(coefficients, pixel_terms, axes=1)
    ratio = np.exp(np.clip(fitted_log_ratio, log_ratio.min() - LOG_MARGIN, log_ratio.max() + LOG_MARGIN))
    scale = light_2[is_significant] / (ratio * first).mean(axis=2)[is_significant]
    ratio[is_significant] *= scale[:, None]
    return ratio, is_significant


def _estimate_noise(blocks: np.ndarray) -> np.ndarray:
    """Return the noise of a pixel [DN] in each block, of blocks [block row, block column, pixel] in DN.

    It is the rms difference of four neighbours, in which slopes of the spot cancel; the four have twice the rms of one.
    """
    image = blocks.reshape(*blocks.shape[:2], SIDE, SIDE)
    difference = image[..., 1:, 1:] - image[..., 1:, :-1] - image[..., :-1, 1:] + image[..., :-1, :-1]
    return np.sqrt((difference**2).mean(axis=(2, 3))) / 2


def _remove_motion(residual: np.ndarray, motion_effects: np.ndarray) -> np.ndarray:
    """Return residuals [block, pixel] in DN without the effect of one motion of the light that all blocks share.

    `motion_effects` [axis, block, pixel] is the change of the residuals per pixel of motion down and right [DN/px]. If
    the residuals are a projection, such as that without a quadratic, it must be projected in the same way. The motion
    is fitted by weighted least squares.
    """
    # The derivative of y₂ by the motion is r times the slope of y₁. The factor r is left out: it only scales the fitted
    # motion if it is the same in all blocks, as it nearly is.
    # Each block has the weight of one over its mean square residual.
    weight = 1 / np.maximum((residual**2).mean(axis=1), MIN_SQUARE)
    normal_matrix = np.einsum("abp,cbp,b->ac", motion_effects, motion_effects, weight)
    motion = np.linalg.lstsq(normal_matrix, np.einsum("abp,bp,b->a", motion_effects, residual, weight), rcond=None)[0]
    return residual - np.tensordot(motion, motion_effects, axes=1)


def convert_to_curve(tally: np.ndarray, black_dn: float) -> NoiseCurve:
    """Return the noise curve of a tally [sum, bin of reading, bin of level], without readings cut at 0 DN.

    The curve is empty if neighbouring residuals correlate: they are then not noise of single pixels. `black_dn` is the
    black level [DN], which is added to the levels of the curve.
    """
    # The lowest bins of reading are left out as long as their noise, times `CUT_AT_SD`, reaches below 0 DN.
    lowest_bin = 0
    while lowest_bin < len(EDGES) and EDGES[lowest_bin] <= CUT_AT_SD * _estimate_bin_noise(tally[:, lowest_bin]):
        lowest_bin += 1
    sums = tally[:, lowest_bin:].sum(axis=1)
    pixels, level, square, product = sums[:, sums[0] >= MIN_COUNT]
    # The product of two residuals of white noise has the variance v², where v is that of a pixel. The product with the
    # mean of two neighbours has half of it, so the sum over n pixels has the standard error n v/√(2 n).
    is_correlated = product - WHITE_COVARIANCE * square > MAX_COVARIANCE_SD * square / np.sqrt(2 * pixels)
    if is_correlated.any() and is_correlated.sum() >= MAX_CORRELATED_PART * is_correlated.size:
        return NoiseCurve(*np.empty((3, 0)))
    variance = square / pixels
    return NoiseCurve(black_dn + level / pixels, variance, variance * np.sqrt(2 / pixels) + BIN_ERROR)


def _estimate_bin_noise(tally: np.ndarray) -> float:
    """Return the rms noise of a pixel [DN] in one bin of reading, from its sums [sum, bin of level]; infinite if empty.

    Only the half of the pixels with the lower levels counts. Grain has made the others brighter than the darkest
    reading nearby, which gives their bin of reading.
    """
    pixels, _, square, _ = tally
    if not pixels.any():
        return np.inf
    # At least the lowest level with pixels counts.
    is_low = np.cumsum(pixels) <= max(pixels.sum() / 2, pixels[np.flatnonzero(pixels)[0]])
    return float(np.sqrt(square[is_low].sum() / pixels[is_low].sum()))


def _average_around(image: np.ndarray) -> np.ndarray:
    """Return the mean of the eight pixels around each pixel [rows, columns]; NaN if one of the nine is NaN."""
    # The running sums of the filter would carry a NaN to the end of its row and column. One NaN among nine
    # pixels gives a mean of 1/9.
    has_gap = uniform_filter(np.isnan(image).astype(float), 3, mode="nearest") > 0.5 / 9
    return (9 * np.where(has_gap, np.nan, uniform_filter(np.nan_to_num(image), 3, mode="nearest")) - image) / 8


def _cut_blocks(image: np.ndarray) -> np.ndarray:
    """Return the blocks [block row, block column, pixel] of an image [rows, columns].

    Incomplete blocks at its lower and right border are left out.
    """
    block_rows, block_columns = (size // SIDE for size in image.shape)
    blocks = image[: block_rows * SIDE, : block_columns * SIDE].reshape(block_rows, SIDE, block_columns, SIDE)
    return blocks.swapaxes(1, 2).reshape(block_rows, block_columns, SIDE**2)
