"""Noise from two frames of one site: what both see of the material, its speckle too, drops out of their difference.

Differences of neighbouring pixels cannot tell grain as fine as the pixels from noise. Two exposures of a site share the
grain, so y₂ − r y₁ is noise alone where r is how much brighter the second is there: per pixel
Var = floor (1 + r²) + K (S₂ + r² S₁), with S the light's reading. Over (1 + r²) that is the curve of a single pixel,
floor + K L, at the level L = (S₂ + r² S₁)/(1 + r²).
"""

from collections.abc import Iterator

import numpy as np
import xarray as xr
from scipy.ndimage import minimum_filter, uniform_filter

from spotcheck import store
from spotcheck.crops import cells, usable
from spotcheck.estimate.noise_curve import CUT_AT_SD, FEWEST, NoiseCurve

# Pixels of a block's side: small enough that brightness and width of the spot change r by a plane only.
SIDE = 10


def quadratic(down: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The six terms of a quadratic [term, …] at places."""
    return np.stack([np.ones_like(down), down, right, down**2, down * right, right**2])


# Places of a block's pixels [px], and what leaves of their values all but a quadratic.
DOWN, RIGHT = np.mgrid[:SIDE, :SIDE].reshape(2, -1) - (SIDE - 1) / 2
LEFT_OVER = np.eye(SIDE**2) - np.linalg.pinv(quadratic(DOWN, RIGHT)) @ quadratic(DOWN, RIGHT)
# A block tells r where its light is this many times its own standard error; else there is no grain to take off.
TELLS = 5.0
# Bins of reading and of level [DN], ten a decade; the first holds what is less.
EDGES = np.geomspace(1e-1, 1e6, 71)
EMPTY = np.zeros((3, len(EDGES), len(EDGES)))


def pairs_along(images: xr.Dataset, axis: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Images of the same pixels of the sensor, two neighbours along an axis of a grid of crops each, and no frame
    twice: from the last on, which of exposures is the brightest."""
    dims = store.grid_dims(images)
    if axis not in dims:
        return
    for index in cells(images, tuple(d for d in dims if d != axis)):
        row = images.isel(index)
        places = [k for k, status in enumerate(row["status"].values) if usable(status)][::-1]
        for k, other in zip(places[1::2], places[::2], strict=False):
            first, second = row.isel({axis: k}), row.isel({axis: other})
            down, right = (int(second[name]) - int(first[name]) for name in ("top", "left"))
            yield aligned(first["image"].values, second["image"].values, down, right)


def aligned(first: np.ndarray, second: np.ndarray, down: int, right: int) -> tuple[np.ndarray, np.ndarray]:
    """The parts of two images [rows, columns] that show the same pixels of the sensor; the second's corner lies `down`
    and `right` [px] of the first's."""
    rows, columns = (min(a, b) for a, b in zip(first.shape, second.shape, strict=True))

    def part(image: np.ndarray, down: int, right: int) -> np.ndarray:
        # Crops that lie further apart than they are large share nothing.
        below, beside = (max(size - abs(step), 0) for size, step in ((rows, down), (columns, right)))
        top, left = max(down, 0), max(right, 0)
        return image[top : top + below, left : left + beside]

    return part(first, down, right), part(second, -down, -right)


def tally_of(first: np.ndarray, second: np.ndarray, black_level: float, full_scale: float) -> np.ndarray:
    """What two images [rows, columns] of the same pixels do not share: number of pixels, sum of their levels over black
    [DN] and sum of squares of what is left [DN²] in bins [3, reading of the darker, level]. Tallies add up.

    Block by block r is a plane, whose slopes the neighbours tell, and the light beside it a quadratic; the second
    frame may have moved by a part of a pixel. Blocks that touch `full_scale` or a gap are left out. Pixels are binned
    by those around them, so that none is picked by its own noise.
    """
    if min(first.shape) < SIDE:
        return EMPTY
    first, second = (image.astype(float) - black_level for image in (first, second))
    near, near_2 = _around(first), _around(second)
    # Grain leaves pixels darker than those around.
    darkest = minimum_filter(np.minimum(near, near_2), 3) + black_level
    images = np.stack([_blocks(image) for image in (first, second, near, near_2, darkest, *np.gradient(first))])
    known = np.isfinite(images).all(axis=(0, 3)) & (images[:2].max(axis=(0, 3)) + black_level < full_scale)
    own, other, around, around_2, darker, *slopes = images[:, known]
    ratio, down, right = (part[known][:, None] for part in _ratio(*np.where(known[..., None], images[:2], np.nan)))
    rest = (other - (ratio + down * DOWN + right * RIGHT) * own) @ LEFT_OVER
    rest = _without_motion(rest, np.stack([slope @ LEFT_OVER for slope in slopes]))

    def level(one: np.ndarray, two: np.ndarray) -> np.ndarray:
        return (two + ratio**2 * one) / (1 + ratio**2)

    # What is left in a pixel is noise of all pixels of the block, each with the variance of its level.
    whole = (LEFT_OVER**2).sum(axis=0)
    square, mixed = rest**2 / whole / (1 + ratio**2), level(own, other) @ LEFT_OVER**2 / whole
    place = tuple(np.searchsorted(EDGES[1:], image.ravel()) for image in (darker, level(around, around_2)))
    out = EMPTY.copy()
    for sums, image in zip(out, (np.ones_like(mixed), mixed, square), strict=True):
        np.add.at(sums, place, image.ravel())
    return out


def _ratio(own: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How much brighter the second image is in each block [row, column], and the slopes of that down and right [1/px].

    Spots are near to Gaussians, so that ln r is a quadratic; it tells the slopes, since a block's own pixels would take
    a part of their noise along.
    """
    light, light_2 = own.mean(axis=2), other.mean(axis=2)
    tells = light > TELLS * own.std(axis=2) / SIDE
    ratio = np.where(tells, light_2 / np.where(tells, light, 1.0), 1.0)
    tells &= ratio > 0
    down, right = (SIDE * (place - place.mean()) for place in np.indices(light.shape))
    terms = quadratic(down, right)[:, tells]
    # The error of ln r by shot noise goes as one over the root of the light.
    weight = np.sqrt(light[tells])
    log = np.linalg.lstsq((terms * weight).T, np.log(ratio[tells]) * weight, rcond=None)[0]
    slope_down, slope_right = log[1] + 2 * log[3] * down + log[4] * right, log[2] + log[4] * down + 2 * log[5] * right
    return ratio, ratio * slope_down, ratio * slope_right


def _without_motion(rest: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """What is left [block, pixel] less what one common motion brings, by the slopes of the light [2, block, pixel]."""
    weight = 1 / np.maximum((rest**2).mean(axis=1), 1e-300)
    product = np.einsum("abp,cbp,b->ac", slopes, slopes, weight)
    motion = np.linalg.lstsq(product, np.einsum("abp,bp,b->a", slopes, rest, weight), rcond=None)[0]
    return rest - np.tensordot(motion, slopes, axes=1)


def curve_of(tally: np.ndarray, black_level: float) -> NoiseCurve:
    """Noise against level of a tally; readings whose noise the converter's zero cuts are left out."""
    least = 0
    while least < len(EDGES) and EDGES[least] <= CUT_AT_SD * _noise_near(*tally[:, least]):
        least += 1
    pixels, level, square = tally[:, least:].sum(axis=1)
    kept = pixels >= FEWEST
    level, square, pixels = level[kept] / pixels[kept], square[kept] / pixels[kept], pixels[kept]
    return NoiseCurve(black_level + level, square, square * np.sqrt(2 / pixels) + 1e-3)


def _noise_near(pixels: np.ndarray, _: np.ndarray, square: np.ndarray) -> float:
    """Noise [DN] where the darker frame reads as low as a row of a tally says, by the lower half of levels in it:
    higher ones are brighter pixels in grain. Infinite where there are none."""
    low = np.cumsum(pixels) <= max(pixels.sum() / 2, pixels[np.flatnonzero(pixels)[:1]].sum())
    return float(np.sqrt(square[low].sum() / pixels[low].sum())) if pixels[low].any() else np.inf


def _around(image: np.ndarray) -> np.ndarray:
    """Mean of the eight pixels around each; NaN where one of the nine is."""
    # The filter's running sums would carry a gap on to the end of its row and column.
    gaps = uniform_filter(np.isnan(image).astype(float), 3, mode="nearest") > 0.5 / 9
    return (9 * np.where(gaps, np.nan, uniform_filter(np.nan_to_num(image), 3, mode="nearest")) - image) / 8


def _blocks(image: np.ndarray) -> np.ndarray:
    """Pixels of each whole block [row, column, pixel]."""
    rows, columns = (n // SIDE for n in image.shape)
    cut = image[: rows * SIDE, : columns * SIDE].reshape(rows, SIDE, columns, SIDE)
    return cut.swapaxes(1, 2).reshape(rows, columns, SIDE**2)
