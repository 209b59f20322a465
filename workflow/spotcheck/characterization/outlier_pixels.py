"""Outlier pixels, columns and rows of an image: readings that no light can cause beside those of their neighbours.

# ASSUME: light on the sensor is nowhere finer than a Gaussian of σ 0.7 px, so that a pixel within three pixels of a
bright one has at least a sixth of its light. In speckle as fine as the pixels, a third of a percent of the pixels is
too dark for this and one in ten million too bright. So dark pixels count within the light only if a line has many.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel

# Distance of the neighbours that a pixel is compared with [px].
NEIGHBOUR_PX = 3
# Width of a line of outliers [px] → largest ratio of its light to that of the neighbours outside the line. A Gaussian
# of σ 0.7 px reaches 3 and 59.
MAX_RATIOS = {1: 6.0, 3: 100.0}
# Margin in standard deviations of a reading: noise exceeds it once in 1e15.
MARGIN_SD = 8.0
# A line is an outlier if it has this number of outlier pixels, and if its mean deviates from those of its neighbours by
# this number of standard deviations of all lines, as offsets of rows in some sensors do not.
MIN_LINE_PIXELS, MIN_LINE_SD = 10, 8.0
# Quantile of the readings that is taken as their level without light: an overexposed spot leaves few dark pixels.
LEVEL_QUANTILE = 0.05
# Number of pixels that a sentence lists.
MAX_LISTED = 3


@dataclass(frozen=True)
class OutlierPixels:
    """Outliers of a crop."""

    columns: list[int]
    rows: list[int]
    pixels: list[tuple[int, int]]  # row and column of single pixels outside these lines
    mask: np.ndarray  # True for all outliers [rows, columns]

    def describe(self, left: int = 0, top: int = 0) -> str:
        """Return a sentence that lists the outliers by their position on the sensor, where the crop starts at `left`
        and `top`."""
        parts = [f"column {left + column}" for column in self.columns] + [f"row {top + row}" for row in self.rows]
        parts += [f"pixel ({left + column}, {top + row})" for row, column in self.pixels[:MAX_LISTED]]
        if len(self.pixels) > MAX_LISTED:
            parts.append(f"{len(self.pixels) - MAX_LISTED} pixels more")
        return f"{', '.join(parts)} left out: no light beside explains what is read there"


def find_outlier_pixels(image: np.ndarray, sensor: SensorModel) -> OutlierPixels:
    """Return the outliers of a crop [rows, columns] in DN, NaN where it was not measured."""
    level = float(np.nanquantile(image, LEVEL_QUANTILE))
    known, light = np.isfinite(image), image - level
    electrons = np.maximum(image - sensor.black_level_dn, 0.0) / sensor.gain_dn_per_e
    noise = sensor.gain_dn_per_e * np.sqrt(electrons + sensor.read_noise_e**2)
    margin = MARGIN_SD * np.sqrt(np.where(known, noise, 0.0) ** 2 + ROUNDING_VARIANCE)
    in_column, in_row, is_single = np.zeros((3, *image.shape), bool)
    for width, ratio in MAX_RATIOS.items():
        highest = [_find_neighbour_maximum(np.where(known, light, -np.inf), axis, width) for axis in (0, 1)]
        lowest = [-_find_neighbour_maximum(np.where(known, -light, -np.inf), axis, width) for axis in (0, 1)]
        for in_line, high, low in zip((in_column, in_row), highest, lowest, strict=True):
            in_line |= light > ratio * np.maximum(high, 0.0) + margin
            in_line |= light < np.where(low > 0, low / ratio, low) - margin
        # A single pixel is dark if it is below all neighbours by their own range, which is unknown at full scale.
        high, low = np.maximum(*highest), np.minimum(*lowest)
        spread = np.where(high + level < sensor.full_scale_dn, high - low, np.inf)
        is_single |= light > ratio * np.maximum(high, 0.0) + margin
        is_single |= light < np.minimum(low, 0.0) - spread - margin
    columns, rows = _find_lines(image, in_column & known, 0), _find_lines(image, in_row & known, 1)
    in_lines = np.zeros(image.shape, bool)
    in_lines[:, columns] = in_lines[rows] = True
    is_single &= known & ~in_lines
    pixels = [(int(row), int(column)) for row, column in np.argwhere(is_single)]
    return OutlierPixels(columns, rows, pixels, (in_lines | is_single) & known)


def _find_neighbour_maximum(light: np.ndarray, axis: int, width: int) -> np.ndarray:
    """Return the maximum light [rows, columns] of the neighbours of each pixel outside a line along an axis.

    Neighbours are up to `NEIGHBOUR_PX` away along the axis, and as far across it from a line of `width` pixels.
    """
    along = ndimage.maximum_filter1d(light, 2 * NEIGHBOUR_PX + 1, axis=axis, mode="constant", cval=-np.inf)
    across, gap = 1 - axis, width // 2
    reach_px = gap + NEIGHBOUR_PX
    pad_width = [(0, 0), (0, 0)]
    pad_width[across] = (reach_px, reach_px)
    padded, size = np.pad(along, pad_width, constant_values=-np.inf), light.shape[across]
    distances = range(gap + 1, reach_px + 1)
    starts = [reach_px + sign * distance for sign in (-1, 1) for distance in distances]
    return np.maximum.reduce([padded.take(range(start, start + size), across) for start in starts])


def _find_lines(image: np.ndarray, is_outlier: np.ndarray, axis: int) -> list[int]:
    """Return the columns (axis 0) or rows (axis 1) with many outlier pixels and a mean unlike their neighbours'."""
    count = np.count_nonzero(is_outlier, axis=axis)
    if count.max() < MIN_LINE_PIXELS:
        return []
    known_pixels = np.maximum(np.count_nonzero(np.isfinite(image), axis=axis), 1)
    mean = np.pad(np.nansum(image, axis=axis) / known_pixels, 1, mode="reflect")
    deviation = mean[1:-1] - (mean[:-2] + mean[2:]) / 2
    # 1.4826 median absolute deviations are the standard deviation of a normal distribution.
    scatter = 1.4826 * float(np.median(np.abs(deviation - np.median(deviation))))
    is_line = (count >= MIN_LINE_PIXELS) & (np.abs(deviation) > MIN_LINE_SD * scatter)
    return np.flatnonzero(is_line).tolist()
