"""Sums of standardised residuals over parts of the images, with all that their null laws need.

A part ("cell") is a block of the sensor, a sector of the spot, a row, a column, a range of light or a whole crop. With
z = r √w (residual r, weight w) and the derivative a of z by light, a cell's sum Σ a z has the variance Σ a² − |Q'a|²:
the columns of Q are orthonormal and span what brightness, width and centre of the frame change in z, which the fit has
absorbed.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, sparse

from spotcheck.discrepancy.evaluation import THREADS
from spotcheck.discrepancy.fields import MOST_CANVAS
from spotcheck.discrepancy.residuals import ResidualImages

# Side of blocks [px]; bounds of the rings about the centre [σ]; sectors of a ring; ranges of light, even in its root.
BLOCK_PX, RING_BOUNDS, SECTORS, LEVELS = 8, (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0), 8, 12
# Frames from which skewness and kurtosis of pixels are taken, and the pixels that count as much as the value 0.
CUMULANT_FRAMES, CUMULANT_SHRINKAGE = 20, 500
# Limits of skewness and excess kurtosis of single pixels.
SKEWNESS_LIMIT, KURTOSIS_RANGE = 2.0, (-1.5, 12.0)
# Weights of a derivative by five neighbours [1/px].
DERIVATIVE = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12
# Slope of the mean reading from which the light of a pixel can be derived; that from which the variance of a reading
# counts: below, it may lie at the floor of the fit (`evaluation.LEAST_VARIANCE`).
LEAST_SLOPE, LEAST_VARIANCE_SLOPE = 1e-4, 0.45
# Variance of a reading [DN²] below which rounding outweighs its noise: its mean then depends on the read noise, which a
# fit knows less well than the tests would need. Such pixels are left out.
LEAST_VARIANCE_DN2 = 0.15
# Lags [row, column] at which neighbours are correlated.
LAGS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))


@dataclass(frozen=True)
class StandardizedFrame:
    """Residuals of a frame in standard deviations; arrays [row, column], 0 where a pixel is not used."""

    z: np.ndarray  # residual beside what a fit of the spot absorbs
    offset: np.ndarray  # derivative of z by light [1/DN]
    relative: np.ndarray  # derivative of z by ln peak
    absorbed: np.ndarray  # orthonormal columns Q of ln peak, ln σ, x and y [column, row, column]
    level: np.ndarray  # range of light 0 … LEVELS − 1; LEVELS for dark pixels
    u: np.ndarray  # distance from the centre along rows [1, column, σ]
    v: np.ndarray  # distance along columns [row, 1, σ]


@dataclass(frozen=True)
class CellKind:
    """A division of the images into cells."""

    name: str  # such as "blocks"
    count: int  # number of cells
    width: int  # number of cells along a row of blocks or a ring
    size: tuple[int, int]  # most rows and columns of a cell [px]
    corner: tuple[int, int]  # row and column of the sensor at which blocks, rows and columns begin


@dataclass(frozen=True)
class CellSums:
    """Sums over the cells of one kind in each frame; arrays [frame, cell]."""

    kind: CellKind
    sums: np.ndarray  # Σ a z
    norms: np.ndarray  # Σ a²
    third: np.ndarray  # third cumulant of the sum
    fourth: np.ndarray  # fourth cumulant of the sum
    pixels: np.ndarray  # number of pixels
    absorbed: np.ndarray  # Σ a q of the columns q of the frame's spot [frame, cell, column]
    common: np.ndarray  # the same of the column that all frames share, the read noise
    fourth_powers: np.ndarray  # Σ a⁴
    light: np.ndarray  # Σ (a g)², with the derivative g of z by ln peak
    shift: (
        np.ndarray
    )  # (Q'a)' [Σ g² q q'] (Q'a): what granular light does to the fit of the spot changes the sum as well


@dataclass(frozen=True)
class ResidualSums:
    """All sums that tests of residuals need."""

    means: tuple[CellSums, ...]  # means over cells
    noise: CellSums  # excess Σ (z² − 1) of ranges of light
    neighbours: np.ndarray  # Σ z z' of neighbours and number of pairs [lag, not dark or dark, 2]
    pattern: np.ndarray  # pairs of frames of a site, and of sites: Σ, its variance, third cumulant [scope, weight, 3]


def sum_residuals(images: ResidualImages) -> ResidualSums:
    """Return all sums over the residuals of a fit, in one pass over the frames."""
    frames, rows, columns = images.residual.shape
    skewness, kurtosis = level_cumulants(images)
    kinds, top, left = _lay_out(images)
    cells = np.zeros((frames, sum(kind.count for kind in kinds), 11))
    noise = np.zeros((frames, LEVELS + 1, 6))
    of_fit = np.zeros((frames, 4, 4))
    neighbours = np.zeros((frames, len(LAGS), 2, 2))
    is_together = np.ptp(images.top) == np.ptp(top) and np.ptp(images.left) == np.ptp(left)

    def of_site(site: int) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
        members = np.flatnonzero(images.design.site == site)
        low = images.top[members].min(), images.left[members].min()
        extent = (np.ptp(images.top[members]) + rows, np.ptp(images.left[members]) + columns)
        is_near = np.prod(extent) <= MOST_CANVAS * rows * columns
        canvas = np.zeros((2, 5, *extent) if is_near else (2, 5, 0, 0))
        for frame in members:
            standard = standardize(images, frame)
            cells[frame] = _sum_cells(standard, kinds, top[frame], left[frame], skewness, kurtosis)
            columns_of_fit = standard.absorbed.reshape(4, -1)
            of_fit[frame] = (columns_of_fit * standard.relative.ravel() ** 2) @ columns_of_fit.T
            noise[frame] = _sum_noise(standard, images.slope[frame], kurtosis)
            neighbours[frame] = _sum_neighbours(standard)
            y, x = images.top[frame] - low[0], images.left[frame] - low[1]
            if is_near:
                canvas[:, :, y : y + rows, x : x + columns] += _powers(standard)
        of_pairs = np.array([_pair_moments(*sums) for sums in canvas])
        squares = (canvas[:, 0], canvas[:, 0] ** 2, canvas[:, 2], canvas[:, 2] ** 2, canvas[:, 2] ** 3)
        return of_pairs, np.stack(squares, 1), (top[members].min(), left[members].min())

    pattern = np.zeros((2, 2, 3))
    extent = (int(top.max()) + rows, int(left.max()) + columns) if is_together else (0, 0)
    across = np.zeros((2, 5, *extent))
    sites = np.unique(images.design.site)
    with ThreadPoolExecutor(THREADS) as pool:
        # Sums of a site are as large as an image: few are kept at a time.
        for some in np.array_split(sites, -(-len(sites) // (2 * THREADS))):
            for of_pairs, site_sums, (y, x) in pool.map(of_site, some):
                pattern[0] += of_pairs
                if is_together and site_sums.size:
                    across[:, :, y : y + site_sums.shape[2], x : x + site_sums.shape[3]] += site_sums
    pattern[1] = [_pair_moments(*sums) for sums in across]
    parts = np.split(cells, np.cumsum([kind.count for kind in kinds])[:-1], axis=1)
    means = [_cells_of_means(kind, sums, of_fit) for kind, sums in zip(kinds, parts, strict=True)]
    rings = replace(kinds[1], name="rings", count=kinds[1].count // SECTORS, width=1)
    means.append(_cells_of_means(rings, parts[1].reshape(frames, rings.count, SECTORS, 11).sum(axis=2), of_fit))
    return ResidualSums(tuple(means), _cells_of_noise(noise), neighbours.sum(axis=0), pattern)


def standardize(images: ResidualImages, frame: int | np.integer) -> StandardizedFrame:
    """Return the residuals of a frame in standard deviations, beside what a fit of its spot absorbs."""
    weight = images.weight[frame]
    used = (weight > 0) & (weight * LEAST_VARIANCE_DN2 < 1) & np.isfinite(images.residual[frame])
    root = np.sqrt(np.where(used, weight, 0.0))
    slope, spot, spots = images.slope[frame], images.spot[frame], images.spots
    rows, columns = used.shape
    sigma = np.exp(spots.log_sigma[frame])
    v = ((images.top[frame] + np.arange(rows) - spots.y[frame]) / sigma)[:, None].astype(np.float32)
    u = ((images.left[frame] + np.arange(columns) - spots.x[frame]) / sigma)[None, :].astype(np.float32)
    gaussian = np.exp(spots.log_peak[frame]) * np.exp(-(v**2) / 2) * np.exp(-(u**2) / 2)
    light = np.where(slope > LEAST_SLOPE, spot / np.maximum(slope, LEAST_SLOPE), gaussian)
    by_y, by_x = (ndimage.correlate1d(light, DERIVATIVE, axis, mode="nearest") for axis in (0, 1))
    # A wider spot of the same peak is light(x/σ): its derivative by ln σ is −(u ∂u + v ∂v) light.
    slopes = np.stack([light, sigma * (u * by_x + v * by_y), by_x, by_y]) * (slope * root)
    columns_of_fit = _orthonormalize(slopes.reshape(4, -1))
    z = (np.where(used, images.residual[frame], 0.0) * root).ravel()
    z = (z - (columns_of_fit @ z) @ columns_of_fit).reshape(used.shape)
    share = np.clip(light / np.exp(np.max(spots.log_peak)), 0.0, 1.0)
    level = np.minimum((LEVELS * np.sqrt(share)).astype(int), LEVELS - 1)
    level[images.is_dark[frame]] = LEVELS
    return StandardizedFrame(z, slope * root, spot * root, columns_of_fit.reshape(slopes.shape), level, u, v)


def _orthonormalize(rows: np.ndarray) -> np.ndarray:
    """Return orthonormal rows [4, pixel] of the same span; rows without information are 0."""
    products = (rows @ rows.T).astype(float)
    scale = 1 / np.sqrt(np.maximum(np.diag(products), 1e-300))
    size, axes = np.linalg.eigh(products * scale[:, None] * scale)
    root = np.where(size > 1e-5, 1 / np.sqrt(np.maximum(size, 1e-5)), 0.0)
    return ((axes * root).T * scale).astype(rows.dtype) @ rows


def level_cumulants(images: ResidualImages) -> tuple[np.ndarray, np.ndarray]:
    """Return skewness and excess kurtosis of standardised residuals by range of light [LEVELS + 1]."""
    moments = np.zeros((5, LEVELS + 1))
    for frame in np.random.default_rng(0).permutation(len(images.left))[:CUMULANT_FRAMES]:
        standard = standardize(images, frame)
        used = standard.offset > 0
        level, z, power = standard.level[used], standard.z[used].astype(float), np.ones(used.sum())
        for k in range(5):
            moments[k] += np.bincount(level, power, LEVELS + 1)
            power = power * z
    first, second, third, fourth = moments[1:] / np.maximum(moments[0], 1.0)
    variance = np.maximum(second - first**2, 1e-12)
    skewness = (third - 3 * first * second + 2 * first**3) / variance**1.5
    kurtosis = (fourth - 4 * first * third + 6 * first**2 * second - 3 * first**4) / variance**2 - 3
    weight = moments[0] / (moments[0] + CUMULANT_SHRINKAGE)
    return np.clip(skewness, -SKEWNESS_LIMIT, SKEWNESS_LIMIT) * weight, np.clip(kurtosis, *KURTOSIS_RANGE) * weight


# Sums of a frame


def _lay_out(images: ResidualImages) -> tuple[tuple[CellKind, ...], np.ndarray, np.ndarray]:
    """Return the kinds of cells, and row and column [frame] at which each crop begins in them."""
    _, rows, columns = images.residual.shape
    # Blocks begin at multiples of their side on the sensor.
    corner = int(images.top.min()) // BLOCK_PX * BLOCK_PX, int(images.left.min()) // BLOCK_PX * BLOCK_PX
    top, left = images.top - corner[0], images.left - corner[1]
    extent = rows + int(top.max()), columns + int(left.max())
    if np.prod(extent) > MOST_CANVAS * rows * columns:
        # Spots that lie far apart share no pixels: rows and columns are those of the crops.
        top, left, extent, corner = 0 * top, 0 * left, (rows, columns), (0, 0)
    down, across = (-(-length // BLOCK_PX) for length in extent)
    crop = rows, columns
    kinds = (
        CellKind("blocks", down * across, across, (BLOCK_PX, BLOCK_PX), corner),
        CellKind("rings and sectors", (len(RING_BOUNDS) + 1) * SECTORS, SECTORS, crop, corner),
        CellKind("rows", extent[0], 1, (1, columns), corner),
        CellKind("columns", extent[1], 1, (rows, 1), corner),
        CellKind("grey levels", LEVELS + 1, 1, crop, corner),
        CellKind("frames", 1, 1, crop, corner),
    )
    return kinds, top, left


def _sum_cells(
    standard: StandardizedFrame,
    kinds: tuple[CellKind, ...],
    top: int,
    left: int,
    skewness: np.ndarray,
    kurtosis: np.ndarray,
) -> np.ndarray:
    """Return the sums over all cells of a frame [cell, 11]."""
    rows, columns = standard.z.shape
    y, x = (top + np.arange(rows))[:, None], (left + np.arange(columns))[None, :]
    ring = np.searchsorted(RING_BOUNDS, np.hypot(standard.u, standard.v), side="right")
    turn = (np.arctan2(standard.v, standard.u) + np.pi) / (2 * np.pi)
    sector = np.minimum((turn * SECTORS).astype(int), SECTORS - 1)
    blocks = y // BLOCK_PX * kinds[0].width + x // BLOCK_PX
    labels = np.empty((rows, columns, len(kinds)), np.int32)
    first = 0
    for k, label in enumerate((blocks, ring * SECTORS + sector, y, x, standard.level, 0)):
        labels[:, :, k] = first + label
        first += kinds[k].count
    count = rows * columns
    a, level = standard.offset.ravel().astype(float), standard.level.ravel()
    square = a * a
    values = np.empty((count, 11))
    values[:, 0], values[:, 1], values[:, 2] = a * standard.z.ravel(), square, a * square * skewness[level]
    values[:, 3], values[:, 4], values[:, 5] = square**2 * kurtosis[level], a > 0, square**2
    values[:, 6] = square * standard.relative.ravel() ** 2
    values[:, 7:] = (a * standard.absorbed.reshape(4, -1)).T
    pointers = np.arange(0, labels.size + 1, len(kinds))
    members = sparse.csc_matrix((np.ones(labels.size), labels.ravel(), pointers), shape=(first, count))
    return members @ values


def _cells_of_means(kind: CellKind, sums: np.ndarray, of_fit: np.ndarray) -> CellSums:
    """Return sums [frame, cell, 11] by name; of_fit [frame, 4, 4] is Σ g² q q'."""
    total, norms, third, fourth, pixels, fourth_powers, light = np.moveaxis(sums[..., :7], -1, 0)
    absorbed = sums[..., 7:]
    return CellSums(
        kind=kind,
        sums=total,
        norms=norms,
        third=third,
        fourth=fourth,
        pixels=pixels,
        absorbed=absorbed,
        common=np.zeros_like(total),
        fourth_powers=fourth_powers,
        light=light,
        shift=np.sum((absorbed @ of_fit) * absorbed, axis=2),
    )


def _sum_noise(standard: StandardizedFrame, slope: np.ndarray, kurtosis: np.ndarray) -> np.ndarray:
    """Return sums by range of light [level, 6]: e = z² − 1 + |q|², its variance ν, the derivative k by the variance of
    the read noise, k e/ν, k²/ν, and the number of pixels."""
    used = (standard.offset > 0) & (slope > LEAST_VARIANCE_SLOPE)
    level = standard.level[used]
    absorbed = np.sum(standard.absorbed[:, used].astype(float) ** 2, axis=0)
    e = standard.z[used].astype(float) ** 2 - 1 + absorbed
    nu = np.maximum(2 + kurtosis[level] - 4 * absorbed, 0.1)
    k = standard.offset[used].astype(float) ** 2
    columns = (e, nu, k, k * e / nu, k**2 / nu, np.ones_like(e))
    return np.stack([np.bincount(level, values, LEVELS + 1) for values in columns], 1)


def _cells_of_noise(sums: np.ndarray) -> CellSums:
    """Return the excess variance by range of light, beside a fitted read noise; sums [frame, level, 6].

    With I = Σ k²/ν the fit absorbs δ = Σ (k e/ν)/I: a cell's sum is Σ e − (Σ k) δ, of the variance Σ ν − (Σ k)²/I.
    The weight k is not known well if rounding outweighs the read noise: dark pixels, the faintest light and the
    remaining light then have a δ each. The third cumulant is that of a scaled χ² of the same mean and variance.
    """
    e, nu, k, score, information, pixels = np.moveaxis(sums, -1, 0)
    region = np.minimum(np.arange(LEVELS + 1), 1)
    region[LEVELS] = 2
    score, information = (np.bincount(region, part.sum(axis=0))[region] for part in (score, information))
    information = np.maximum(information, 1e-300)
    kind, none = CellKind("noise", LEVELS + 1, 1, (1, 1), (0, 0)), np.zeros_like(e)
    return CellSums(
        kind=kind,
        sums=e - k * score / information,
        norms=nu,
        third=2 * nu**2 / np.maximum(pixels, 1.0),
        fourth=none,
        pixels=pixels,
        absorbed=none[..., None],
        common=k / np.sqrt(information),
        fourth_powers=none,
        light=none,
        shift=none,
    )


def _sum_neighbours(standard: StandardizedFrame) -> np.ndarray:
    """Return Σ z z' of neighbours, less what the fit of the spot does to it, and the number of pairs [lag, dark, 2]."""
    used, is_dark = standard.offset > 0, standard.level == LEVELS
    rows, columns = used.shape
    out = np.zeros((len(LAGS), 2, 2))
    for j, (dy, dx) in enumerate(LAGS):
        first = np.s_[..., : rows - dy, max(0, -dx) : columns - max(0, dx)]
        second = np.s_[..., dy:, max(0, dx) : columns - max(0, -dx)]
        # The fit leaves the covariance −q q'.
        product = standard.z[first] * standard.z[second]
        for column in standard.absorbed:
            product += column[first] * column[second]
        alike = used[first] & used[second] & (is_dark[first] == is_dark[second])
        region = is_dark[first][alike].astype(int)
        out[j, :, 0] = np.bincount(region, product[alike], 2)
        out[j, :, 1] = np.bincount(region, minlength=2)
    return out


def _powers(standard: StandardizedFrame) -> np.ndarray:
    """Return a z, (a z)² and the 2nd, 4th and 6th power of a for two weights a of pixels: offsets, and the light."""
    a = np.stack([standard.offset, standard.relative / max(float(standard.relative.max()), 1e-30)]).astype(float)
    z, square = a * standard.z, a**2
    return np.stack([z, z**2, square, square**2, square**3], 1)


def _pair_moments(
    first: np.ndarray, squares: np.ndarray, s1: np.ndarray, s2: np.ndarray, s3: np.ndarray
) -> tuple[float, float, float]:
    """Return a sum over pairs of frames, its variance and its third cumulant; 0 without pairs.

    For numbers a z at one pixel (Σ a z)² − Σ (a z)² is the sum over pairs. With power sums S₁, S₂, S₃ of a² its
    variance is 2 (S₁² − S₂) and its third cumulant 8 (S₁³ − 3 S₁ S₂ + 2 S₃).
    """
    variance = 2 * float(np.sum(s1**2 - s2))
    if variance <= 1e-9 * float(np.sum(s1**2)):
        return 0.0, 0.0, 0.0
    return float(np.sum(first**2 - squares)), variance, 8 * float(np.sum(s1**3 - 3 * s1 * s2 + 2 * s3))
