"""Sums of standardised residuals over cells of the images, with the moments that these sums have if the model is right.

A cell is a block of the sensor, a sector of a ring about the spot, a row, a column, a range of light ("level") or a
whole crop. The standardised residual of a pixel is z = r √w (residual r [DN], weight w = 1/variance). With the
derivative a of z by the light, the sum Σ a z over a cell has the variance Σ a² − |Q'a|². The columns q of Q [pixel, 4]
are orthonormal and span the changes of z by the spot parameters of the frame, ln peak, ln σ, x and y, which the fit has
absorbed. Dark pixels are those beyond 5 σ of the spot (`ResidualImages.is_dark`); they have a level of their own.

`ResidualImages` also has the `residual`, the `weight`, the derivatives of the mean reading by the light (`slope`) and
by ln peak (`spot`), and the corners of the crops on the sensor (`top`, `left`). A site is the frames of the same angle,
declared conditions and repeat.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, sparse

from spotcheck.discrepancy.evaluation import THREADS
from spotcheck.discrepancy.fields import MOST_CANVAS
from spotcheck.discrepancy.frames import SPOT_PARAMETERS
from spotcheck.discrepancy.residuals import ResidualImages

# Side of blocks [px]; bounds of the rings about the centre [σ of the spot]; sectors of a ring; ranges of light, which
# have equal widths in the root of the light over the brightest peak.
BLOCK_PX, RING_BOUNDS, SECTORS, LEVELS = 8, (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0), 8, 12
# Fields of `CellSums` in the order in which `_sum_cells` returns them; Σ a q of each spot parameter comes behind them.
CELL_FIELDS = ("sums", "norms", "third", "fourth", "pixels", "fourth_powers", "light")
# Frames from which skewness and kurtosis of pixels are estimated, and the weight [pixels] of the value 0 in that
# estimate.
CUMULANT_FRAMES, CUMULANT_SHRINKAGE = 20, 500
# Limits of skewness and excess kurtosis of single pixels.
SKEWNESS_LIMIT, KURTOSIS_RANGE = 2.0, (-1.5, 12.0)
# Weights of the derivative along an axis by five neighbours, of fourth order [1/px].
DERIVATIVE = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12
# Least slope of the mean reading by the light with which the light of a pixel is derived from the reading's derivative.
LEAST_SLOPE = 1e-4
# Least slope with which the variance of a reading is tested: below, it may lie at the floor of the fit
# (`evaluation.LEAST_VARIANCE`).
LEAST_VARIANCE_SLOPE = 0.45
# Variance of a reading [DN²] below which rounding outweighs its noise: its mean then depends on the read noise, which a
# fit knows less well than the tests would need. Such pixels are left out.
LEAST_VARIANCE_DN2 = 0.15
# Eigenvalue of the products of the four changes by a spot, each of length 1, below which a direction counts as none.
LEAST_EIGENVALUE = 1e-5
# Least variance of z² − 1 in one pixel; 2 for normal noise.
LEAST_SQUARE_VARIANCE = 0.1
# Lags [row, column] at which neighbours are correlated.
LAGS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))
# Number of weights of pixels with which pairs of frames are summed, and of the sums by `_power_sums` and `_sum_noise`.
PAIR_WEIGHTS, POWER_SUMS, NOISE_SUMS = 2, 5, 6


@dataclass(frozen=True)
class StandardizedFrame:
    """Residuals of a frame in standard deviations; arrays [row, column], 0 where a pixel is not used."""

    z: np.ndarray  # standardised residual, less what the fit of the spot absorbs
    offset: np.ndarray  # a: derivative of z by the light [1/DN]
    relative: np.ndarray  # g: derivative of z by ln peak, that is, by a relative change of the light
    absorbed: np.ndarray  # orthonormal columns q that span the changes of z by the spot [spot parameter, row, column]
    level: np.ndarray  # range of light 0 … LEVELS − 1; LEVELS for dark pixels
    u: np.ndarray  # column less that of the spot's centre [1, column, σ]
    v: np.ndarray  # row less that of the centre [row, 1, σ]


@dataclass(frozen=True)
class CellKind:
    """A division of the images into cells."""

    name: str  # such as "blocks"
    count: int  # number of cells
    width: int  # number of cells along a row of blocks or a ring; else 1
    size: tuple[int, int]  # most rows and columns of a cell [px]
    corner: tuple[int, int]  # row and column of the sensor at which blocks, rows and columns begin


@dataclass(frozen=True)
class CellSums:
    """Sums over the cells of one kind in each frame; arrays [frame, cell]. The module docstring defines a, z and q."""

    kind: CellKind
    sums: np.ndarray  # Σ a z
    norms: np.ndarray  # Σ a², the variance of Σ a z before the fit
    third: np.ndarray  # third cumulant of Σ a z
    fourth: np.ndarray  # fourth cumulant of Σ a z
    pixels: np.ndarray  # number of pixels
    absorbed: np.ndarray  # Σ a q for each column q of the frame's spot [frame, cell, column]
    common: np.ndarray  # the same for the column of the read noise, which all frames share; 0 for means
    fourth_powers: np.ndarray  # Σ a⁴
    light: np.ndarray  # Σ (a g)², with the derivative g of z by ln peak
    # (Q'a)' [Σ g² q q'] (Q'a): granular light shifts the fitted spot, and with it the sum; this is the variance of
    # that.
    shift: np.ndarray


@dataclass(frozen=True)
class ResidualSums:
    """All sums that tests of residuals need."""

    means: tuple[CellSums, ...]  # Σ a z over cells, one entry for each kind
    noise: CellSums  # Σ (z² − 1) over ranges of light: excess of the variance
    neighbours: np.ndarray  # Σ z z' of neighbours and number of pairs [lag, not dark or dark, 2]
    # Sums over pairs of frames, of the same site or of different sites, with their variance and third cumulant; weights
    # of pixels are those of `_power_sums` [same or different sites, weight, 3].
    pattern: np.ndarray


def sum_residuals(images: ResidualImages) -> ResidualSums:
    """Return all sums over the residuals of a fit, in one pass over the frames."""
    frames, rows, columns = images.residual.shape
    skewness, kurtosis = level_cumulants(images)
    kinds, top, left = _define_kinds(images)
    cells = np.zeros((frames, sum(kind.count for kind in kinds), len(CELL_FIELDS) + SPOT_PARAMETERS))
    noise = np.zeros((frames, LEVELS + 1, NOISE_SUMS))
    fit_products = np.zeros((frames, SPOT_PARAMETERS, SPOT_PARAMETERS))
    neighbours = np.zeros((frames, len(LAGS), 2, 2))
    # `_define_kinds` returns other corners if spots lie far apart: then sites share no pixels.
    sites_overlap = np.ptp(images.top) == np.ptp(top) and np.ptp(images.left) == np.ptp(left)

    def sum_site(site: int) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
        """Fill the sums of the frames of a site.

        Returns the moments of its pairs of frames [weight, 3], the power sums of its sum as one frame [weight, 5, row,
        column], and row and column at which these begin.
        """
        members = np.flatnonzero(images.design.site == site)
        # Power sums are added in the smallest rectangle that holds the crops of the site, unless it is too large.
        corner = images.top[members].min(), images.left[members].min()
        extent = (np.ptp(images.top[members]) + rows, np.ptp(images.left[members]) + columns)
        is_compact = np.prod(extent) <= MOST_CANVAS * rows * columns
        canvas = np.zeros((PAIR_WEIGHTS, POWER_SUMS, *(extent if is_compact else (0, 0))))
        for frame in members:
            standard = standardize(images, frame)
            cells[frame] = _sum_cells(standard, kinds, top[frame], left[frame], skewness, kurtosis)
            spot_columns = standard.absorbed.reshape(SPOT_PARAMETERS, -1)
            fit_products[frame] = (spot_columns * standard.relative.ravel() ** 2) @ spot_columns.T
            noise[frame] = _sum_noise(standard, images.slope[frame], kurtosis)
            neighbours[frame] = _sum_neighbours(standard)
            y, x = images.top[frame] - corner[0], images.left[frame] - corner[1]
            if is_compact:
                canvas[:, :, y : y + rows, x : x + columns] += _power_sums(standard)
        pair_moments = np.array([_pair_moments(*sums) for sums in canvas])
        # The site takes part in pairs of sites with Σ a z as its z and Σ a² as the square of its weight.
        powers = (canvas[:, 0], canvas[:, 0] ** 2, canvas[:, 2], canvas[:, 2] ** 2, canvas[:, 2] ** 3)
        return pair_moments, np.stack(powers, 1), (top[members].min(), left[members].min())

    pattern = np.zeros((2, PAIR_WEIGHTS, 3))
    extent = (int(top.max()) + rows, int(left.max()) + columns) if sites_overlap else (0, 0)
    across = np.zeros((PAIR_WEIGHTS, POWER_SUMS, *extent))
    sites = np.unique(images.design.site)
    with ThreadPoolExecutor(THREADS) as pool:
        # Sums of a site are as large as an image: few are kept at a time.
        for site_group in np.array_split(sites, -(-len(sites) // (2 * THREADS))):
            for pair_moments, site_sums, (y, x) in pool.map(sum_site, site_group):
                pattern[0] += pair_moments
                if sites_overlap and site_sums.size:
                    across[:, :, y : y + site_sums.shape[2], x : x + site_sums.shape[3]] += site_sums
    pattern[1] = [_pair_moments(*sums) for sums in across]
    sums_of_kinds = np.split(cells, np.cumsum([kind.count for kind in kinds])[:-1], axis=1)
    means = [_cells_of_means(kind, sums, fit_products) for kind, sums in zip(kinds, sums_of_kinds, strict=True)]
    # Whole rings are sums over their sectors.
    rings = replace(kinds[1], name="rings", count=kinds[1].count // SECTORS, width=1)
    ring_sums = sums_of_kinds[1].reshape(frames, rings.count, SECTORS, -1).sum(axis=2)
    means.append(_cells_of_means(rings, ring_sums, fit_products))
    return ResidualSums(tuple(means), _cells_of_noise(noise), neighbours.sum(axis=0), pattern)


def standardize(images: ResidualImages, frame: int | np.integer) -> StandardizedFrame:
    """Return the residuals of a frame in standard deviations, less what the fit of its spot absorbs."""
    weight = images.weight[frame]
    used = (weight > 0) & (weight * LEAST_VARIANCE_DN2 < 1) & np.isfinite(images.residual[frame])
    root = np.sqrt(np.where(used, weight, 0.0))
    slope, spot, spots = images.slope[frame], images.spot[frame], images.spots
    rows, columns = used.shape
    sigma = np.exp(spots.log_sigma[frame])
    v = ((images.top[frame] + np.arange(rows) - spots.y[frame]) / sigma)[:, None].astype(np.float32)
    u = ((images.left[frame] + np.arange(columns) - spots.x[frame]) / sigma)[None, :].astype(np.float32)
    # The light of a Gaussian is taken for readings that do not follow the light, as in saturation.
    gaussian = np.exp(spots.log_peak[frame]) * np.exp(-(v**2) / 2) * np.exp(-(u**2) / 2)
    light = np.where(slope > LEAST_SLOPE, spot / np.maximum(slope, LEAST_SLOPE), gaussian)
    by_y, by_x = (ndimage.correlate1d(light, DERIVATIVE, axis, mode="nearest") for axis in (0, 1))
    # A wider spot of the same peak is light(x/σ): its derivative by ln σ is −(u ∂u + v ∂v) light. Signs do not matter
    # for the span.
    changes = np.stack([light, sigma * (u * by_x + v * by_y), by_x, by_y]) * (slope * root)
    spot_columns = _orthonormalize(changes.reshape(SPOT_PARAMETERS, -1))
    z = (np.where(used, images.residual[frame], 0.0) * root).ravel()
    z = (z - (spot_columns @ z) @ spot_columns).reshape(used.shape)
    share = np.clip(light / np.exp(np.max(spots.log_peak)), 0.0, 1.0)
    level = np.minimum((LEVELS * np.sqrt(share)).astype(int), LEVELS - 1)
    level[images.is_dark[frame]] = LEVELS
    return StandardizedFrame(z, slope * root, spot * root, spot_columns.reshape(changes.shape), level, u, v)


def _orthonormalize(rows: np.ndarray) -> np.ndarray:
    """Return orthonormal rows [spot parameter, pixel] with the span of the given ones; 0 for directions of length 0."""
    products = (rows @ rows.T).astype(float)
    scale = 1 / np.sqrt(np.maximum(np.diag(products), 1e-300))
    eigenvalues, axes = np.linalg.eigh(products * scale[:, None] * scale)
    factor = np.where(eigenvalues > LEAST_EIGENVALUE, 1 / np.sqrt(np.maximum(eigenvalues, LEAST_EIGENVALUE)), 0.0)
    return ((axes * factor).T * scale).astype(rows.dtype) @ rows


def level_cumulants(images: ResidualImages) -> tuple[np.ndarray, np.ndarray]:
    """Return skewness and excess kurtosis of single standardised residuals, each by range of light [LEVELS + 1].

    They are estimated from some frames and shrunk towards 0, the value of normal noise, in ranges of few pixels.
    """
    # Σ zᵏ for k = 0 … 4 [k, level].
    moments = np.zeros((5, LEVELS + 1))
    for frame in np.random.default_rng(0).permutation(len(images.left))[:CUMULANT_FRAMES]:
        standard = standardize(images, frame)
        used = standard.offset > 0
        level, z, z_power = standard.level[used], standard.z[used].astype(float), np.ones(used.sum())
        for order in range(len(moments)):
            moments[order] += np.bincount(level, z_power, LEVELS + 1)
            z_power = z_power * z
    first, second, third, fourth = moments[1:] / np.maximum(moments[0], 1.0)
    variance = np.maximum(second - first**2, 1e-12)
    skewness = (third - 3 * first * second + 2 * first**3) / variance**1.5
    kurtosis = (fourth - 4 * first * third + 6 * first**2 * second - 3 * first**4) / variance**2 - 3
    weight = moments[0] / (moments[0] + CUMULANT_SHRINKAGE)
    return np.clip(skewness, -SKEWNESS_LIMIT, SKEWNESS_LIMIT) * weight, np.clip(kurtosis, *KURTOSIS_RANGE) * weight


# Sums of a frame


def _define_kinds(images: ResidualImages) -> tuple[tuple[CellKind, ...], np.ndarray, np.ndarray]:
    """Return the kinds of cells; and the corner of each crop, its row and column [frame] beyond `CellKind.corner`."""
    _, rows, columns = images.residual.shape
    # Blocks begin at multiples of their side on the sensor.
    corner = int(images.top.min()) // BLOCK_PX * BLOCK_PX, int(images.left.min()) // BLOCK_PX * BLOCK_PX
    top, left = images.top - corner[0], images.left - corner[1]
    extent = rows + int(top.max()), columns + int(left.max())
    if np.prod(extent) > MOST_CANVAS * rows * columns:
        # Spots that lie far apart share no pixels: rows and columns are those of the crops.
        top, left, extent, corner = 0 * top, 0 * left, (rows, columns), (0, 0)
    block_rows, block_columns = (-(-length // BLOCK_PX) for length in extent)
    crop = rows, columns
    kinds = (
        CellKind("blocks", block_rows * block_columns, block_columns, (BLOCK_PX, BLOCK_PX), corner),
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
    """Return the sums over all cells of all kinds in a frame [cell, column]; columns as by `CELL_FIELDS`.

    `top`, `left`: corner of the crop as by `_define_kinds`; `skewness`, `kurtosis` [level]: as by `level_cumulants`.
    """
    rows, columns = standard.z.shape
    y, x = (top + np.arange(rows))[:, None], (left + np.arange(columns))[None, :]
    ring = np.searchsorted(RING_BOUNDS, np.hypot(standard.u, standard.v), side="right")
    turn = (np.arctan2(standard.v, standard.u) + np.pi) / (2 * np.pi)
    sector = np.minimum((turn * SECTORS).astype(int), SECTORS - 1)
    block = y // BLOCK_PX * kinds[0].width + x // BLOCK_PX
    labels = np.empty((rows, columns, len(kinds)), np.int32)
    first = 0
    for k, label in enumerate((block, ring * SECTORS + sector, y, x, standard.level, 0)):
        labels[:, :, k] = first + label
        first += kinds[k].count
    count = rows * columns
    a, level = standard.offset.ravel().astype(float), standard.level.ravel()
    square = a * a
    # By `CELL_FIELDS`. The cumulants of a z in a pixel are a³ times the skewness and a⁴ times the excess kurtosis.
    values = np.column_stack(
        [a * standard.z.ravel(), square, a * square * skewness[level], square**2 * kurtosis[level], a > 0, square**2,
         square * standard.relative.ravel() ** 2, *(a * standard.absorbed.reshape(SPOT_PARAMETERS, -1))]
    )  # fmt: skip
    # A sparse matrix [cell, pixel] of ones sums over all kinds at once; each column has one entry for each kind.
    pointers = np.arange(0, labels.size + 1, len(kinds))
    members = sparse.csc_matrix((np.ones(labels.size), labels.ravel(), pointers), shape=(first, count))
    return members @ values


def _cells_of_means(kind: CellKind, sums: np.ndarray, fit_products: np.ndarray) -> CellSums:
    """Return sums [frame, cell, column] of `_sum_cells` by name; `fit_products` is Σ g² q q' [frame, q, q']."""
    first_absorbed = len(CELL_FIELDS)
    named = dict(zip(CELL_FIELDS, np.moveaxis(sums[..., :first_absorbed], -1, 0), strict=True))
    absorbed = sums[..., first_absorbed:]
    shift = np.sum((absorbed @ fit_products) * absorbed, axis=2)
    return CellSums(kind=kind, absorbed=absorbed, common=np.zeros(sums.shape[:2]), shift=shift, **named)


def _sum_noise(standard: StandardizedFrame, slope: np.ndarray, kurtosis: np.ndarray) -> np.ndarray:
    """Return sums over ranges of light [level, 6]: e, ν, k, k e/ν, k²/ν, and the number of pixels.

    e = z² − 1 + |q|² is the excess of a squared residual, ν its variance, and k its derivative by the variance of the
    read noise. `slope` [row, column] is that of the mean reading by the light, `kurtosis` [level] as by
    `level_cumulants`.
    """
    used = (standard.offset > 0) & (slope > LEAST_VARIANCE_SLOPE)
    level = standard.level[used]
    absorbed = np.sum(standard.absorbed[:, used].astype(float) ** 2, axis=0)
    e = standard.z[used].astype(float) ** 2 - 1 + absorbed
    nu = np.maximum(2 + kurtosis[level] - 4 * absorbed, LEAST_SQUARE_VARIANCE)
    k = standard.offset[used].astype(float) ** 2
    columns = (e, nu, k, k * e / nu, k**2 / nu, np.ones_like(e))
    return np.stack([np.bincount(level, values, LEVELS + 1) for values in columns], 1)


def _cells_of_noise(sums: np.ndarray) -> CellSums:
    """Return the excess of the variance by range of light, beside a fitted read noise.

    `sums` [frame, level, 6] are those of `_sum_noise`. With I = Σ k²/ν the fit of the read noise absorbs δ = Σ (k
    e/ν)/I: a cell's sum is Σ e − (Σ k) δ, with the variance Σ ν − (Σ k)²/I. There is one δ each for dark pixels, for
    the faintest light and for the remaining light, since k is not known well where rounding outweighs the read noise.
    The third cumulant is that of a scaled χ² with the same mean and variance.
    """
    e, nu, k, score, information, pixels = np.moveaxis(sums, -1, 0)
    # Region of each level: 0 the faintest light, 1 the remaining light, 2 dark pixels.
    region = np.minimum(np.arange(LEVELS + 1), 1)
    region[LEVELS] = 2
    score, information = (np.bincount(region, by_level.sum(axis=0))[region] for by_level in (score, information))
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
    """Return Σ z z' over pairs of neighbours, and their number [lag, not dark or dark, sum and number].

    The covariance that the fit of the spot causes is taken off. Both pixels of a pair are dark, or none.
    """
    used, is_dark = standard.offset > 0, standard.level == LEVELS
    rows, columns = used.shape
    pairs = np.zeros((len(LAGS), 2, 2))
    for j, (dy, dx) in enumerate(LAGS):
        first = np.s_[..., : rows - dy, max(0, -dx) : columns - max(0, dx)]
        second = np.s_[..., dy:, max(0, dx) : columns - max(0, -dx)]
        # The fit leaves z with the covariance −q q'.
        product = standard.z[first] * standard.z[second]
        for column in standard.absorbed:
            product += column[first] * column[second]
        is_pair = used[first] & used[second] & (is_dark[first] == is_dark[second])
        region = is_dark[first][is_pair].astype(int)
        pairs[j, :, 0] = np.bincount(region, product[is_pair], 2)
        pairs[j, :, 1] = np.bincount(region, minlength=2)
    return pairs


def _power_sums(standard: StandardizedFrame) -> np.ndarray:
    """Return a z, (a z)², a², a⁴ and a⁶ of each pixel for two weights a [weight, 5, row, column].

    The weights are the derivatives of z by an offset and by a relative change of the light; the latter is scaled to a
    maximum of 1.
    """
    a = np.stack([standard.offset, standard.relative / max(float(standard.relative.max()), 1e-30)]).astype(float)
    z, square = a * standard.z, a**2
    return np.stack([z, z**2, square, square**2, square**3], 1)


def _pair_moments(
    total: np.ndarray, squares: np.ndarray, s1: np.ndarray, s2: np.ndarray, s3: np.ndarray
) -> tuple[float, float, float]:
    """Return the sum of a z a' z' over pairs of frames, its variance and its third cumulant; 0, 0, 0 without pairs.

    Arguments are sums over frames at each pixel [row, column]: of a z, (a z)², a², a⁴ and a⁶. The sum over pairs, each
    in both orders, is (Σ a z)² − Σ (a z)². With the power sums S₁, S₂, S₃ of a² its variance is 2 (S₁² − S₂), and its
    third cumulant is 8 (S₁³ − 3 S₁ S₂ + 2 S₃).
    """
    variance = 2 * float(np.sum(s1**2 - s2))
    # Rounding of S₁² − S₂ remains with a single frame.
    if variance <= 1e-9 * float(np.sum(s1**2)):
        return 0.0, 0.0, 0.0
    return float(np.sum(total**2 - squares)), variance, 8 * float(np.sum(s1**3 - 3 * s1 * s2 + 2 * s3))
