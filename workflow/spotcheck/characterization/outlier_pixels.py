"""Outlier pixels, columns and rows of an image: readings that no light can cause beside those of their neighbours.

A line is a column or a row; the light of a pixel is its reading less the level without light. A crop is the image
around a spot.

# ASSUME: light on the sensor is nowhere finer than a Gaussian of σ 0.7 px, so that a pixel within three pixels of a
bright one has at least a sixth of its light. In speckle as fine as the pixels, a third of a percent of the pixels is
too dark for this, and one in ten million too bright. Therefore dark pixels within the light are outliers only if a line
has many of them.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel

# Distance of the neighbours that a pixel is compared with [px].
NEIGHBOUR_PX = 3
# Width of the outlier lines that are looked for [px] → largest ratio of the light of a pixel to that of its neighbours
# outside the line. A Gaussian of σ 0.7 px has ratios up to 3 and 59.
MAX_RATIOS = {1: 6.0, 3: 100.0}
# Margin in standard deviations of a reading: noise exceeds it once in 1e15.
MARGIN_SD = 8.0
# A line is an outlier if it has this number of outlier pixels, and if its mean deviates from those of its neighbours by
# this number of standard deviations of all lines. The second condition excludes sensors in which all rows have offsets.
MIN_LINE_PIXELS, MIN_LINE_SD = 10, 8.0
# Quantile of the readings that is taken as their level without light: an overexposed spot leaves few dark pixels.
LEVEL_QUANTILE = 0.05
# Standard deviation of a normal distribution over its median absolute deviation.
MAD_TO_SIGMA = 1.4826
# Largest number of pixels that a sentence lists.
MAX_LISTED = 3


@dataclass(frozen=True)
class OutlierPixels:
    """Outliers of a crop: whole columns, whole rows and single pixels."""

    columns: list[int]  # indices of the outlier columns in the crop, ascending
    rows: list[int]  # indices of the outlier rows in the crop, ascending
    pixels: list[tuple[int, int]]  # row and column of single pixels outside these lines
    mask: np.ndarray  # True for all outliers [rows, columns]; False where the crop is NaN

    def describe(self, left: int = 0, top: int = 0) -> str:
        """Return a sentence that lists the outliers by their position on the sensor; only for crops with outliers.

        The crop starts in column `left` and row `top` of the sensor [px]. Pixels are given as (column, row). All lines
        are listed, but at most `MAX_LISTED` pixels.
        """
        phrases = [f"column {left + column}" for column in self.columns] + [f"row {top + row}" for row in self.rows]
        phrases += [f"pixel ({left + column}, {top + row})" for row, column in self.pixels[:MAX_LISTED]]
        if len(self.pixels) > MAX_LISTED:
            phrases.append(f"{len(self.pixels) - MAX_LISTED} pixels more")
        return f"{', '.join(phrases)} left out: the light of their neighbours does not explain their readings"


def find_outlier_pixels(image: np.ndarray, sensor: SensorModel) -> OutlierPixels:
    """Return the outliers of a crop: pixels whose light exceeds or falls below what their neighbours allow.

    Parameters
    ----------
    image : crop [rows, columns] in DN; NaN where it was not measured.
    sensor : sensor model, which gives the noise of a reading.
    """
    unlit_level = float(np.nanquantile(image, LEVEL_QUANTILE))
    is_known, light = np.isfinite(image), image - unlit_level
    electrons = np.maximum(image - sensor.black_level_dn, 0.0) / sensor.gain_dn_per_e
    noise = sensor.gain_dn_per_e * np.sqrt(electrons + sensor.read_noise_e**2)
    margin = MARGIN_SD * np.sqrt(np.where(is_known, noise, 0.0) ** 2 + ROUNDING_VARIANCE)
    # Candidates for columns, rows and single pixels, in all line widths.
    in_column, in_row, is_single = np.zeros((3, *image.shape), bool)
    for width, max_ratio in MAX_RATIOS.items():
        # Largest and smallest light of the neighbours beside a column and beside a row through each pixel.
        highest = [_find_neighbour_maximum(np.where(is_known, light, -np.inf), axis, width) for axis in (0, 1)]
        lowest = [-_find_neighbour_maximum(np.where(is_known, -light, -np.inf), axis, width) for axis in (0, 1)]
        for in_line, high, low in zip((in_column, in_row), highest, lowest, strict=True):
            in_line |= light > max_ratio * np.maximum(high, 0.0) + margin
            # Too dark: below the smallest neighbour over the largest ratio, or below that neighbour if it is negative.
            in_line |= light < np.where(low > 0, low / max_ratio, low) - margin
        # A single pixel is dark if it is below all neighbours by their own range, which is unknown at full scale.
        high, low = np.maximum(*highest), np.minimum(*lowest)
        neighbour_range = np.where(high + unlit_level < sensor.full_scale_dn, high - low, np.inf)
        is_single |= light > max_ratio * np.maximum(high, 0.0) + margin
        is_single |= light < np.minimum(low, 0.0) - neighbour_range - margin
    columns, rows = _find_lines(image, in_column & is_known, 0), _find_lines(image, in_row & is_known, 1)
    in_lines = np.zeros(image.shape, bool)
    in_lines[:, columns] = in_lines[rows] = True
    is_single &= is_known & ~in_lines
    pixels = [(int(row), int(column)) for row, column in np.argwhere(is_single)]
    return OutlierPixels(columns, rows, pixels, (in_lines | is_single) & is_known)


def _find_neighbour_maximum(light: np.ndarray, axis: int, width: int) -> np.ndarray:
    """Return the maximum of the neighbours of each pixel [rows, columns] that are outside a line through the pixel.

    The line runs along `axis` (0: a column) and is `width` pixels wide, an odd number. Neighbours are up to
    `NEIGHBOUR_PX` away along the line, and up to `NEIGHBOUR_PX` beside it. `light` [rows, columns] is −∞ where unknown.
    """
    along = ndimage.maximum_filter1d(light, 2 * NEIGHBOUR_PX + 1, axis=axis, mode="constant", cval=-np.inf)
    across, half_width = 1 - axis, width // 2
    pad_px = half_width + NEIGHBOUR_PX
    pad_width = [(0, 0), (0, 0)]
    pad_width[across] = (pad_px, pad_px)
    padded, size = np.pad(along, pad_width, constant_values=-np.inf), light.shape[across]
    # The image shifted by each distance beside the line, to both sides.
    starts = [pad_px + sign * distance for sign in (-1, 1) for distance in range(half_width + 1, pad_px + 1)]
    return np.maximum.reduce([padded.take(range(start, start + size), across) for start in starts])


def _find_lines(image: np.ndarray, is_outlier: np.ndarray, axis: int) -> list[int]:
    """Return the indices of the columns (axis 0) or rows (axis 1) that are outliers as a whole.

    They have at least `MIN_LINE_PIXELS` pixels in the mask `is_outlier` [rows, columns], and their mean deviates from
    that of both neighbours. `image` [rows, columns] is in DN, NaN where unknown.
    """
    outlier_count = np.count_nonzero(is_outlier, axis=axis)
    if outlier_count.max() < MIN_LINE_PIXELS:
        return []
    known_count = np.maximum(np.count_nonzero(np.isfinite(image), axis=axis), 1)
    mean = np.pad(np.nansum(image, axis=axis) / known_count, 1, mode="reflect")
    deviation = mean[1:-1] - (mean[:-2] + mean[2:]) / 2
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(deviation - np.median(deviation))))
    is_line = (outlier_count >= MIN_LINE_PIXELS) & (np.abs(deviation) > MIN_LINE_SD * scatter)
    return np.flatnonzero(is_line).tolist()
