"""Finding the spot on a frame, and cutting it out."""

from typing import NamedTuple

import numpy as np
from scipy import ndimage
from skimage.measure import label

from spotcheck.dataset.frames import average_blocks

# Side of the blocks in which the light is first looked for [px].
SEARCH_PX = 16
# A spot must stand out of the noise of single pixels by this factor. The largest of 1e5 medians of nine reaches 1.9;
# where a black level of 0 cuts half of the noise away, its estimate comes out at 0.6 of it.
SPOT_OVER_NOISE = 6.0
# Firm light is the least of four or five readings, to which noise hardly lends anything: where black cuts half of it
# away and its estimate is 0.4 of it, this is reached once in 1e4 frames of 12 Mpx, elsewhere never.
FIRM_OVER_NOISE = 7.0
# Side of the first window in blocks: a block and its eight neighbours, and half a block each way for the spot's flank.
WINDOW_BLOCKS = 4
# Nor is anything fainter than this a spot of whole numbers: where rounding hides the noise, its estimate is 0.
FAINTEST_DN = 2.5


class Spot(NamedTuple):
    """Where the spot is on the frame: pixel [row, column], and whether there is one."""

    row: int
    column: int
    found: bool


def brightest_pixel(pixels: np.ndarray) -> Spot:
    """The maximum of the frame; of several equal ones the left-most, then the top-most (Section 3.1.1)."""
    rows, columns = np.nonzero(pixels == np.nanmax(pixels))
    first = np.lexsort((rows, columns))[0]
    return Spot(int(rows[first]), int(columns[first]), True)


class _Light(NamedTuple):
    """What a window shows of a spot: its pixel, and the peak over the frame's background and over the window's own
    [DN]."""

    spot: Spot
    peak: float
    contrast: float


def light_centroid(pixels: np.ndarray, window_px: int) -> Spot:
    """Centroid of the light above half a robust maximum, indifferent to isolated hot pixels, stuck rows and columns.

    The spot is looked for around the block that holds most light, and the 3 × 3 median takes isolated pixels away. A
    spot much smaller than a block may stand back there, and the median flattens one narrower than its nine pixels:
    where the block shows nothing, the spot is where light is firmest. Background is the median of the frame, sampled.
    `found` is False when nothing stands out of the noise: then the place is the frame's centre. Pixels that are NaN
    count as those around them.
    """
    pixels = _filled(pixels)
    square, firm = _firm(pixels)
    sample = pixels[::8, ::8]
    background = float(np.median(sample))
    # Differences of neighbours see the noise alone, also where a black level of 0 cuts half of it away.
    noise = float(np.median(np.abs(pixels[::4, :-1:8].astype(float) - pixels[::4, 1::8]))) / 0.954
    faintest = FAINTEST_DN if np.array_equal(sample, np.rint(sample)) else 0.0
    enough = max(SPOT_OVER_NOISE * noise, faintest)
    most = _centroid(pixels, _brightest_block(square), window_px, background, enough)
    row, column = map(int, np.unravel_index(np.argmax(firm), firm.shape))
    height = float(firm[row, column]) - background
    if most is not None and (most.contrast > enough or 2 * most.peak > height):
        return most.spot
    if height <= max(FIRM_OVER_NOISE * noise, faintest):
        return Spot(pixels.shape[0] // 2, pixels.shape[1] // 2, False) if most is None else most.spot
    own = _centroid(pixels, (row, column), window_px, background, enough)
    return Spot(row, column, True) if own is None or 2 * own.peak < height else own.spot


def _filled(pixels: np.ndarray) -> np.ndarray:
    """The image with the median of 5 × 5 pixels in the place of NaN, or of all where all of those are NaN."""
    if pixels.dtype.kind != "f" or not (gaps := np.isnan(pixels)).any():
        return pixels
    around = np.lib.stride_tricks.sliding_window_view(np.pad(pixels, 2, constant_values=np.nan), (5, 5))[gaps]
    out, known = pixels.copy(), ~np.isnan(around).all(axis=(1, 2))
    values = np.full(len(around), np.nanmedian(pixels))
    values[known] = np.nanmedian(around[known], axis=(1, 2))
    out[gaps] = values
    return out


def _firm(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least reading of the square of 2 × 2 from each pixel on [rows − 1, columns − 1], and, of a square or a cross
    of five, the larger one [the same, of the square's first pixel]: what no isolated pixel, pair, row or column makes
    large, and of a spot of σ 0.7 px leaves a fifth of the peak at least."""
    down = np.minimum(pixels[:-1, :], pixels[1:, :])
    square = np.minimum(down[:, :-1], down[:, 1:])
    firm = square.copy()
    if min(pixels.shape) > 2:
        across = np.minimum(pixels[1:-1, :-2], pixels[1:-1, 2:])
        cross = np.minimum(np.minimum(down[:-1, 1:-1], pixels[2:, 1:-1]), across)
        np.maximum(firm[1:, 1:], cross, out=firm[1:, 1:])
    return square, firm


def _brightest_block(square: np.ndarray) -> tuple[int, int]:
    """Row and column of the middle of the block of `SEARCH_PX` that, with its neighbours, holds most light."""
    side = min(SEARCH_PX, *square.shape)
    rest = [(0, -length % side) for length in square.shape]
    sums = average_blocks(np.pad(square, rest, mode="edge"), side)
    sums = ndimage.uniform_filter(sums, 3, mode="nearest") if min(sums.shape) > 3 else sums
    block_row, block_column = np.unravel_index(np.argmax(sums), sums.shape)
    return int(block_row) * side + side // 2, int(block_column) * side + side // 2


def _centroid(
    pixels: np.ndarray, place: tuple[int, int], window_px: int, background: float, enough: float
) -> _Light | None:
    """Centroid of the light above half of the peak in a window around a place [row, column]; None where no peak is
    `enough` [DN].

    Twice: a first window may cut a spot that is wider than the block that found it. It is wide enough for a spot
    anywhere in that block and in those beside it, which lent it their light, however small the crop.
    """
    row, column = place
    for side in (max(window_px, WINDOW_BLOCKS * SEARCH_PX), window_px):
        top, left = max(row - side // 2, 0), max(column - side // 2, 0)
        window = median_of_nine(pixels[top : top + side, left : left + side].astype(np.float32))
        signal = window - background
        peak = float(signal.max())
        if peak <= enough:
            return None
        regions = label(signal > peak / 2, connectivity=2)
        light = ndimage.sum_labels(signal, regions, np.arange(1, regions.max() + 1))
        rows, columns = np.nonzero(regions == 1 + int(np.argmax(light)))
        weight = signal[rows, columns]
        row = top + round(float(np.average(rows, weights=weight)))
        column = left + round(float(np.average(columns, weights=weight)))
    return _Light(Spot(row, column, True), peak, peak - float(np.median(signal)))


def median_of_nine(image: np.ndarray) -> np.ndarray:
    """3 × 3 median, the border repeated: the middle one of the largest low, the middle middle and the smallest high of
    three sorted rows. Equal to that of `scipy.ndimage`, whose sorting took most of the time of cropping."""
    wide = np.pad(image, 1, mode="edge")
    height, width = image.shape
    rows = [_sorted(*(wide[i : i + height, j : j + width] for j in range(3))) for i in range(3)]
    low, middle, high = zip(*rows, strict=True)
    return _sorted(np.maximum.reduce(low), _sorted(*middle)[1], np.minimum.reduce(high))[1]


def _sorted(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Three images in ascending order, pixel by pixel."""
    low, high = np.minimum(a, b), np.maximum(a, b)
    middle, high = np.minimum(high, c), np.maximum(high, c)
    return np.minimum(low, middle), np.maximum(low, middle), high


def cut(pixels: np.ndarray, spot: Spot, side: int) -> np.ndarray:
    """Crop [side, side] as float32 with the spot at pixel (side//2, side//2); NaN beyond the frame's border."""
    crop = np.full((side, side), np.nan, np.float32)
    top, left = spot.row - side // 2, spot.column - side // 2
    rows = slice(max(top, 0), min(top + side, pixels.shape[0]))
    columns = slice(max(left, 0), min(left + side, pixels.shape[1]))
    crop[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = pixels[rows, columns]
    return crop
