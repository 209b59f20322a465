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

from spotcheck.characterization.noise_curve import CUT_AT_SD, FEWEST, NoiseCurve
from spotcheck.crops.cropping import is_usable, iterate_cells
from spotcheck.io import store

# Pixels of a block's side.
SIDE = 10


def quadratic(down: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The six terms of a quadratic [term, …] at places."""
    return np.stack([np.ones_like(down), down, right, down**2, down * right, right**2])


# Places of a block's pixels [px], and what leaves of their values all but a quadratic.
DOWN, RIGHT = np.mgrid[:SIDE, :SIDE].reshape(2, -1) - (SIDE - 1) / 2
LEFT_OVER = np.eye(SIDE**2) - np.linalg.pinv(quadratic(DOWN, RIGHT)) @ quadratic(DOWN, RIGHT)
# Terms of a constant, a plane and a quadratic.
TERMS = (1, 3, 6)
# A block tells r where its light is this many times its own standard error; else there is no grain to take off.
TELLS = 5.0
# Bins of reading and of level [DN], ten a decade; the first holds what is less.
EDGES = np.geomspace(1e-1, 1e6, 71)
EMPTY = np.zeros((4, len(EDGES), len(EDGES)))


def _with_neighbours(rest: np.ndarray) -> np.ndarray:
    """What is left of each pixel [block, pixel] times the mean of that of its neighbours right and below; 0 at the last
    row and column of a block."""
    image = rest.reshape(-1, SIDE, SIDE)
    out = np.zeros_like(image)
    out[:, :-1, :-1] = image[:, :-1, :-1] * (image[:, :-1, 1:] + image[:, 1:, :-1]) / 2
    return out.reshape(rest.shape)


# What white noise leaves of that product, in parts of a pixel's variance: a quadratic has been taken off.
WHITE = float(_with_neighbours(LEFT_OVER).trace() / LEFT_OVER.trace())
# More than that by this many standard errors is no noise of pixels: light that moved, or is finer than a block.
SHARED_Z = 3.0
# Where it is so at this part of the levels or more, it is at the others too, too little to be seen.
SPREAD = 0.1


def pairs_along(images: xr.Dataset, axis: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Images of the same pixels of the sensor, two neighbours along an axis of a grid of crops each, and no frame
    twice: from the last on, which of exposures is the brightest."""
    dims = store.grid_dims(images)
    if axis not in dims:
        return
    for index in iterate_cells(images, tuple(d for d in dims if d != axis)):
        row = images.isel(index)
        places = [k for k, status in enumerate(row["status"].values) if is_usable(status)][::-1]
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
    [DN], sum of squares of what is left [DN²] and of its products with neighbours [DN²], in bins [4, reading of the
    darker, level]. Tallies add up.

    Block by block what r leaves is free of a quadratic; the second frame may have moved by a part of a pixel. Blocks
    that touch `full_scale` or a gap are left out. Pixels are binned by those around them, so that none is picked by its
    own noise.
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
    ratio, scaled = (part[known] for part in _ratio(*np.where(known[..., None], images[:2], np.nan)))
    rest = (other - ratio * own) @ LEFT_OVER
    # What motion brings has no sum in a block whose sum told r.
    light = np.where(scaled, own.mean(axis=1), np.inf)
    moved = [slope - (slope.mean(axis=1) / light)[:, None] * own for slope in slopes]
    rest = _without_motion(rest, np.stack(moved) @ LEFT_OVER)

    def level(one: np.ndarray, two: np.ndarray) -> np.ndarray:
        return (two + ratio**2 * one) / (1 + ratio**2)

    # What is left in a pixel is noise of all pixels of the block, each with the variance of its level.
    whole = (LEFT_OVER**2).sum(axis=0)
    square, shared = (part / whole / (1 + ratio**2) for part in (rest**2, _with_neighbours(rest)))
    mixed = level(own, other) @ LEFT_OVER**2 / whole
    place = tuple(np.searchsorted(EDGES[1:], image.ravel()) for image in (darker, level(around, around_2)))
    out = EMPTY.copy()
    for sums, image in zip(out, (np.ones_like(mixed), mixed, square, shared), strict=True):
        np.add.at(sums, place, image.ravel())
    return out


def _ratio(own: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How much brighter the second image is at each pixel of the blocks [row, column, pixel], and which blocks tell.

    Spots are near to Gaussians, so that ln r is a quadratic over the blocks. Each block whose own light tells r scales
    it; one's pixels do not tell its slopes, since they would take a part of their noise along.
    """
    light, light_2 = own.mean(axis=2), other.mean(axis=2)
    tells = (light > TELLS * _noise(own) / SIDE) & (light_2 > 0)
    if not tells.any():
        return np.ones_like(own), tells
    middle = SIDE * (np.indices(light.shape) - np.reshape(light.shape, (2, 1, 1)) / 2)
    # Two blocks or more for each term: fewer would draw it through their noise.
    terms = max(own for own in TERMS if own == 1 or 2 * own <= tells.sum())
    seen = np.log(light_2[tells] / light[tells])
    # The error of ln r by shot noise goes as one over the root of the light.
    weight = np.sqrt(light[tells])
    # A block's light tells r where that light is, which is not its middle beside a narrow spot.
    centre = np.stack([(own[tells] * place).mean(axis=1) / light[tells] for place in (DOWN, RIGHT)])
    law = quadratic(*(middle[:, tells] + np.clip(centre, -SIDE / 2, SIDE / 2)))[:terms]
    log = np.linalg.lstsq((law * weight).T, seen * weight, rcond=None)[0]
    at = quadratic(middle[0, ..., None] + DOWN, middle[1, ..., None] + RIGHT)[:terms]
    ratio = np.exp(np.clip(np.tensordot(log, at, axes=1), seen.min() - 1, seen.max() + 1))
    ratio[tells] *= (light_2[tells] / (ratio * own).mean(axis=2)[tells])[:, None]
    return ratio, tells


def _noise(own: np.ndarray) -> np.ndarray:
    """Noise of a pixel of each block [row, column], by differences of four neighbours, which a spot's slopes are not
    in."""
    image = own.reshape(*own.shape[:2], SIDE, SIDE)
    four = image[..., 1:, 1:] - image[..., 1:, :-1] - image[..., :-1, 1:] + image[..., :-1, :-1]
    return np.sqrt((four**2).mean(axis=(2, 3))) / 2


def _without_motion(rest: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """What is left [block, pixel] less what one common motion brings, by the slopes of the light [2, block, pixel]."""
    weight = 1 / np.maximum((rest**2).mean(axis=1), 1e-300)
    product = np.einsum("abp,cbp,b->ac", slopes, slopes, weight)
    motion = np.linalg.lstsq(product, np.einsum("abp,bp,b->a", slopes, rest, weight), rcond=None)[0]
    return rest - np.tensordot(motion, slopes, axes=1)


def curve_of(tally: np.ndarray, black_level: float) -> NoiseCurve:
    """Noise against level of a tally, readings left out whose noise the converter's zero cuts. Empty where what is left
    is not noise of pixels: neighbours share it."""
    least = 0
    while least < len(EDGES) and EDGES[least] <= CUT_AT_SD * _noise_near(*tally[:, least]):
        least += 1
    pixels, level, square, shared = tally[:, least:].sum(axis=1)
    # The product of two pixels' noise varies by the square of its variance; the mean of two such products by half.
    kept = pixels >= FEWEST
    level, square, shared, pixels = (part[kept] for part in (level, square, shared, pixels))
    common = shared - WHITE * square > SHARED_Z * square / np.sqrt(2 * pixels)
    if common.any() and common.sum() >= SPREAD * common.size:
        return NoiseCurve(*np.empty((3, 0)))
    level, square = level / pixels, square / pixels
    return NoiseCurve(black_level + level, square, square * np.sqrt(2 / pixels) + 1e-3)


def _noise_near(pixels: np.ndarray, _: np.ndarray, square: np.ndarray, __: np.ndarray) -> float:
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
