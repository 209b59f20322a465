"""Find the spot in a frame, and cut out a crop around it.

A crop is a square image with the spot at its centre. A compact peak is a bright place that a minimum filter over a few
neighbouring pixels preserves, unlike single hot pixels.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage
from skimage.measure import label

from spotcheck.dataset.frames import average_blocks

# Side of the blocks [px] into which the frame is divided for the coarse search.
SEARCH_PX = 16
# Step between the pixels along both axes from which the background is estimated [px].
SAMPLE_STEP = 8
# Side of the first window in blocks: a block, its eight neighbours, and half a block on each side for the spot's flank.
WINDOW_BLOCKS = 4
# Smallest peak after the median filter, in noise of single pixels. The largest of 1e5 medians of nine reaches 1.9. The
# noise is estimated at 0.6 of its value if a black level of 0 clips half of it.
MIN_PEAK = 6.0
# Smallest compact peak (see `_filter_minima`), in noise of single pixels. Noise reaches this once in 1e4 frames of
# 12 Mpx if a black level of 0 clips half of it and its estimate is 0.4 of its value, otherwise never.
MIN_COMPACT_PEAK = 7.0
# Smallest peak of integer readings [DN]: the noise is estimated as 0 if rounding hides it.
MIN_INTEGER_PEAK_DN = 2.5
# Median absolute difference of two pixels over the standard deviation of one, for normal noise.
MEDIAN_DIFFERENCE = 0.954


class Spot(NamedTuple):
    """Position of the spot on the frame."""

    row: int  # row of its centre [px]
    column: int  # column of its centre [px]
    exists: bool  # False if nothing exceeds the noise; the position is then the centre of the frame


class _Peak(NamedTuple):
    """Spot found in a window."""

    spot: Spot  # position of its centroid
    height: float  # peak above the background of the frame [DN]
    contrast: float  # peak above the median of the window [DN]


def find_brightest_pixel(pixels: np.ndarray) -> Spot:
    """Return the brightest pixel of a frame [row, column], as in Section 3.1.1 of the paper; NaN pixels are left out.

    It is the left-most of several equal ones, and the top-most of these.
    """
    rows, columns = np.nonzero(pixels == np.nanmax(pixels))
    first = np.lexsort((rows, columns))[0]
    return Spot(int(rows[first]), int(columns[first]), True)


def find_light_centroid(pixels: np.ndarray, window_px: int) -> Spot:
    """Return the centroid of the light above half of the peak, insensitive to hot pixels and stuck rows and columns.

    The search starts at the block with the most light, after a 3 × 3 median filter that removes isolated pixels. The
    block may miss a spot that is much smaller, and the filter flattens a spot narrower than its nine pixels. If the
    block shows no spot, the search starts at the highest compact peak (see `_filter_minima`).

    Parameters
    ----------
    pixels : array [rows, columns]
        Readings [DN]; NaN pixels are replaced by the median of their neighbours. The background is the median of
        every `SAMPLE_STEP`th pixel along both axes.
    window_px : int
        Side of the window in which the centroid is computed [px].
    """
    pixels = _fill_gaps(pixels)
    square, compact = _filter_minima(pixels)
    sample = pixels[::SAMPLE_STEP, ::SAMPLE_STEP]
    background = float(np.median(sample))
    # Every fourth row and eighth column is enough. The difference of two neighbours hardly contains the spot.
    noise = float(np.median(np.abs(pixels[::4, :-1:8].astype(float) - pixels[::4, 1::8]))) / MEDIAN_DIFFERENCE
    faintest = MIN_INTEGER_PEAK_DN if np.array_equal(sample, np.rint(sample)) else 0.0
    threshold = max(MIN_PEAK * noise, faintest)
    # The spot at the brightest block, and the height of the highest compact peak [DN].
    broad = _find_peak(pixels, _find_brightest_block(square), window_px, background, threshold)
    row, column = map(int, np.unravel_index(np.argmax(compact), compact.shape))
    compact_height = float(compact[row, column]) - background
    # The block shows the spot if this stands out in its window, or is not much lower than the compact peak.
    if broad is not None and (broad.contrast > threshold or 2 * broad.height > compact_height):
        return broad.spot
    if compact_height <= max(MIN_COMPACT_PEAK * noise, faintest):
        return Spot(pixels.shape[0] // 2, pixels.shape[1] // 2, False) if broad is None else broad.spot
    # A spot that the median filter flattens to less than half is located at the compact peak itself.
    narrow = _find_peak(pixels, (row, column), window_px, background, threshold)
    return Spot(row, column, True) if narrow is None or 2 * narrow.height < compact_height else narrow.spot


def _fill_gaps(pixels: np.ndarray) -> np.ndarray:
    """Return an image with NaN replaced by the median of 5 × 5 pixels, or of the image if all of these are NaN.

    An image of integers, or without NaN, is returned as it is.
    """
    if pixels.dtype.kind != "f" or not (gaps := np.isnan(pixels)).any():
        return pixels
    neighbours = np.lib.stride_tricks.sliding_window_view(np.pad(pixels, 2, constant_values=np.nan), (5, 5))[gaps]
    has_neighbour = ~np.isnan(neighbours).all(axis=(1, 2))
    values = np.full(len(neighbours), np.nanmedian(pixels))
    values[has_neighbour] = np.nanmedian(neighbours[has_neighbour], axis=(1, 2))
    filled = pixels.copy()
    filled[gaps] = values
    return filled


def _filter_minima(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an image [rows, columns] in DN, without NaN, after two minimum filters.

    Single bright pixels, pairs, rows and columns are removed.

    Returns
    -------
    square : array [rows − 1, columns − 1]
        Minimum of each square of 2 × 2 pixels, at its first pixel.
    compact : array [rows − 1, columns − 1]
        At each pixel, the larger of `square` and of the minimum of the cross of five pixels around it; `square` alone
        in the first row and column. At least a fifth of the peak remains for a spot of σ = 0.7 px.
    """
    down = np.minimum(pixels[:-1, :], pixels[1:, :])
    square = np.minimum(down[:, :-1], down[:, 1:])
    compact = square.copy()
    if min(pixels.shape) > 2:
        across = np.minimum(pixels[1:-1, :-2], pixels[1:-1, 2:])
        cross = np.minimum(np.minimum(down[:-1, 1:-1], pixels[2:, 1:-1]), across)
        np.maximum(compact[1:, 1:], cross, out=compact[1:, 1:])
    return square, compact


def _find_brightest_block(square: np.ndarray) -> tuple[int, int]:
    """Return row and column [px] of the centre of the block that has the most light together with its neighbours.

    `square` [rows − 1, columns − 1] in DN is that of `_filter_minima`. The last blocks are filled by repeating the
    border pixels, so that their centre may lie beyond the image.
    """
    side = min(SEARCH_PX, *square.shape)
    padding = [(0, -length % side) for length in square.shape]
    means = average_blocks(np.pad(square, padding, mode="edge"), side)
    # With three blocks or fewer along a side, a block and its neighbours are most of the image.
    means = ndimage.uniform_filter(means, 3, mode="nearest") if min(means.shape) > 3 else means
    block_row, block_column = np.unravel_index(np.argmax(means), means.shape)
    return int(block_row) * side + side // 2, int(block_column) * side + side // 2


def _find_peak(
    pixels: np.ndarray, start: tuple[int, int], window_px: int, background: float, threshold: float
) -> _Peak | None:
    """Return the centroid of the light above half of the peak near `start` (row, column).

    It is None if the peak is not higher than `threshold` above `background`, both in DN. Two square windows of the
    image `pixels` [row, column] are searched in turn, the last with the side `window_px` [px]. The first window covers
    the start block and its neighbours, which contributed to its light. The second one is centred on the first centroid,
    as the first may cut a spot that is wider than a block.
    """
    row, column = start
    for side in (max(window_px, WINDOW_BLOCKS * SEARCH_PX), window_px):
        top, left = max(row - side // 2, 0), max(column - side // 2, 0)
        signal = median_filter_3x3(pixels[top : top + side, left : left + side].astype(np.float32)) - background
        height = float(signal.max())
        if height <= threshold:
            return None
        # The connected region with the most light.
        regions = label(signal > height / 2, connectivity=2)
        light = ndimage.sum_labels(signal, regions, np.arange(1, regions.max() + 1))
        rows, columns = np.nonzero(regions == 1 + int(np.argmax(light)))
        weights = signal[rows, columns]
        row = top + round(float(np.average(rows, weights=weights)))
        column = left + round(float(np.average(columns, weights=weights)))
    return _Peak(Spot(row, column, True), height, height - float(np.median(signal)))


def median_filter_3x3(image: np.ndarray) -> np.ndarray:
    """Return the 3 × 3 median of an image [row, column], in its shape; pixels of the border are repeated outwards.

    The result equals that of `scipy.ndimage.median_filter`, which took most of the time of cropping. If the nine pixels
    are three sorted rows, their median is the median of three numbers: the largest of the minima of the rows, the
    median of their medians, and the smallest of their maxima.
    """
    padded = np.pad(image, 1, mode="edge")
    height, width = image.shape
    # Each row of the 3 × 3 pixels, sorted: three images per row.
    rows = [_sort_three(*(padded[i : i + height, j : j + width] for j in range(3))) for i in range(3)]
    minima, medians, maxima = zip(*rows, strict=True)
    return _sort_three(np.maximum.reduce(minima), _sort_three(*medians)[1], np.minimum.reduce(maxima))[1]


def _sort_three(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the smallest, the middle and the largest reading of each pixel of three images of equal shape."""
    low, high = np.minimum(a, b), np.maximum(a, b)
    middle, high = np.minimum(high, c), np.maximum(high, c)
    return np.minimum(low, middle), np.maximum(low, middle), high


def cut_crop(pixels: np.ndarray, spot: Spot, side: int) -> np.ndarray:
    """Return the crop [side, side] of a frame [row, column] in DN as float32, NaN outside the frame.

    The spot is at pixel (side//2, side//2), also if the crop reaches beyond the frame.
    """
    crop = np.full((side, side), np.nan, np.float32)
    top, left = spot.row - side // 2, spot.column - side // 2
    rows = slice(max(top, 0), min(top + side, pixels.shape[0]))
    columns = slice(max(left, 0), min(left + side, pixels.shape[1]))
    crop[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = pixels[rows, columns]
    return crop
