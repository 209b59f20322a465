"""Pixels, columns and rows of one crop that read what no light beside them explains: hot, stuck or dead.

# ASSUME: light on the sensor is nowhere finer than a Gaussian of σ 0.7 px, so that within three pixels of a bright one
# others have a sixth of its light at least. Speckle as fine as the pixels has a third of a percent of dark ones and one
# in ten million bright ones that break this; so a dark pixel counts in the light only where many of its line are.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from spotcheck.model.sensor import ROUNDING_VARIANCE, SensorModel

# Reach [px] of what is beside a pixel, and the factor by which light may differ within it.
REACH, FACTOR = 3, 6.0
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
    side = 2 * REACH + 1
    beside = np.ones((3, side, side), bool)
    # All but the pixel, all but its column, all but its row.
    beside[0, REACH, REACH] = beside[1, :, REACH] = beside[2, REACH, :] = False
    high, low = np.zeros((2, 3, *image.shape), bool)
    for k, footprint in enumerate(beside):
        most = ndimage.maximum_filter(
            np.where(known, light, -np.inf), footprint=footprint, mode="constant", cval=-np.inf
        )
        least = ndimage.minimum_filter(
            np.where(known, light, np.inf), footprint=footprint, mode="constant", cval=np.inf
        )
        some = known & np.isfinite(most)
        high[k] = some & (light > FACTOR * np.maximum(most, 0.0) + margin)
        # Many of a line are darker than a part of the darkest beside; one alone than all by as much as they differ,
        # which readings at full scale do not tell.
        part = np.where(least > 0, least / FACTOR, least)
        below = np.where(most + level < sensor.full_scale_dn, np.minimum(least, 0.0) - (most - least), -np.inf)
        low[k] = some & (light < (below if k == 0 else part) - margin)
    columns, rows = (_lines(np.where(known, image, np.nan), (high | low)[1 + k], k) for k in (0, 1))
    mask = np.zeros(image.shape, bool)
    mask[:, columns] = mask[rows] = True
    alone = (high[0] | low[0]) & ~mask
    return Odd(columns, rows, [(int(y), int(x)) for y, x in np.argwhere(alone)], (mask | alone) & known)


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
