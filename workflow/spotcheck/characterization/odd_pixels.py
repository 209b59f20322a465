"""Pixels, columns and rows of one crop that read what no light beside them explains: hot, stuck or dead.

# ASSUME: light on the sensor is nowhere finer than a Gaussian of σ 0.7 px, so that within three pixels of a bright one
# another has a sixth of its light at least. Speckle as fine as the pixels has a third of a percent of dark ones and one
# in ten million bright ones that break this; so a dark pixel counts in the light only where many of its line are.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel

# Reach [px] of what is beside a pixel; and the factor by which light may differ from that beyond so many pixels: 1 of a
# single line or pixel, 3 of two or three. A Gaussian of σ 0.7 px differs by 3 and by 59.
REACH, FACTORS = 3, {1: 6.0, 3: 100.0}
# Beyond that, by so many standard deviations of a reading: noise does so once in 1e15.
BEYOND = 8.0
# A line is left out where so many of its pixels are odd, and its mean lies this many scatters of the lines' own off
# those beside it: the offsets that rows have in some sensors do not.
LINE_PIXELS, LINE_BEYOND = 10, 8.0
# The part of a crop that reads its level at most: an overexposed spot leaves no more of it dark.
LEVEL_PART = 0.05
# Pixels that a sentence names one by one.
NAMED = 3


class Odd(NamedTuple):
    """Columns and rows of a crop, single pixels (row, column) outside them, and all of their pixels [rows, columns]."""

    columns: list[int]
    rows: list[int]
    pixels: list[tuple[int, int]]
    mask: np.ndarray

    def sentence(self, left: int = 0, top: int = 0) -> str:
        """What is left out, by its place on the sensor."""
        parts = [f"column {left + k}" for k in self.columns] + [f"row {top + k}" for k in self.rows]
        parts += [f"pixel ({left + x}, {top + y})" for y, x in self.pixels[:NAMED]]
        if len(self.pixels) > NAMED:
            parts.append(f"{len(self.pixels) - NAMED} pixels more")
        return f"{', '.join(parts)} left out: no light beside explains what is read there"


def odd_pixels(image: np.ndarray, sensor: SensorModel) -> Odd:
    """Odd pixels of a crop [rows, columns] in DN, NaN where it was not measured."""
    level = float(np.nanquantile(image, LEVEL_PART))
    known, light = np.isfinite(image), image - level
    electrons = np.maximum(image - sensor.black_level_dn, 0.0) / sensor.gain_dn_per_e
    spread = sensor.gain_dn_per_e * np.sqrt(electrons + sensor.read_noise_e**2)
    margin = BEYOND * np.sqrt(np.where(known, spread, 0.0) ** 2 + ROUNDING_VARIANCE)
    of_columns, of_rows, alone = np.zeros((3, *image.shape), bool)
    for wide, factor in FACTORS.items():
        most = [_most_beside(np.where(known, light, -np.inf), axis, wide) for axis in (0, 1)]
        least = [-_most_beside(np.where(known, -light, -np.inf), axis, wide) for axis in (0, 1)]
        for odd, high, low in zip((of_columns, of_rows), most, least, strict=True):
            odd |= light > factor * np.maximum(high, 0.0) + margin
            odd |= light < np.where(low > 0, low / factor, low) - margin
        # A pixel by itself is dark where all are brighter by as much as they differ, which full scale does not tell.
        high, low = np.maximum(*most), np.minimum(*least)
        differ = np.where(high + level < sensor.full_scale_dn, high - low, np.inf)
        alone |= (light > factor * np.maximum(high, 0.0) + margin) | (light < np.minimum(low, 0.0) - differ - margin)
    columns, rows = _lines(image, of_columns & known, 0), _lines(image, of_rows & known, 1)
    mask = np.zeros(image.shape, bool)
    mask[:, columns] = mask[rows] = True
    alone &= known & ~mask
    return Odd(columns, rows, [(int(y), int(x)) for y, x in np.argwhere(alone)], (mask | alone) & known)


def _most_beside(light: np.ndarray, axis: int, wide: int) -> np.ndarray:
    """The largest light within `REACH` along an axis, and as far across it beyond a line that is `wide`."""
    along = ndimage.maximum_filter1d(light, 2 * REACH + 1, axis=axis, mode="constant", cval=-np.inf)
    gap, across = wide // 2, 1 - axis
    steps = [sign * (gap + step) for sign in (-1, 1) for step in range(1, REACH + 1)]
    width = [(0, 0), (0, 0)]
    width[across] = (gap + REACH, gap + REACH)
    padded, size = np.pad(along, width, constant_values=-np.inf), light.shape[across]
    return np.maximum.reduce([padded.take(range(gap + REACH + k, gap + REACH + k + size), across) for k in steps])


def _lines(image: np.ndarray, odd: np.ndarray, axis: int) -> list[int]:
    """Lines along an axis (0: columns) with many odd pixels and a mean apart from those beside."""
    count = np.count_nonzero(odd, axis=axis)
    if count.max() < LINE_PIXELS:
        return []
    number = np.maximum(np.count_nonzero(np.isfinite(image), axis=axis), 1)
    mean = np.pad(np.nansum(image, axis=axis) / number, 1, mode="reflect")
    apart = mean[1:-1] - (mean[:-2] + mean[2:]) / 2
    scatter = 1.4826 * float(np.median(np.abs(apart - np.median(apart))))
    return np.flatnonzero((count >= LINE_PIXELS) & (np.abs(apart) > LINE_BEYOND * scatter)).tolist()
