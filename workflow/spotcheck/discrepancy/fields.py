"""Relative fields: granular light (grains), different at each site, and gains of pixels, which are fixed to the sensor.

A relative field is a random image that multiplies the light. Its covariance is estimated from products of residuals
that share no noise. For residual r [DN], G = d mean/d ln peak [DN] (`ResidualImages.spot`) and weight w [1/DN²], the
inverse variance of a reading, let a = r G w and b = G² w.
The covariance at a lag is then Σ a a'/Σ b b' over pairs of pixels at this lag. Here a' and b' belong to the second
pixel, a lag is its displacement from the first one, and b stands for light below. Pairs of frames of one site share
grains and gains; frames of different sites share gains alone. Errors come from a jackknife over sites, or over blocks
of the sensor.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft, optimize

from spotcheck.discrepancy.residuals import ResidualImages, place_on_sensor

# Largest lag of a covariance along rows and columns [px]; also the index of lag 0 on an axis of lags.
LAG = 12
# Least light of a pixel that is used for fields, as a part of that of the brightest pixel of its frame.
LIT_SHARE = 0.05
# Blocks of the sensor along each side for the jackknife of gains.
BLOCKS = 40
# Area of the part of the sensor that holds all crops, in areas of a crop. If it is larger, sites share no pixels.
MOST_CANVAS = 3.0
# Largest lag at which the grain is fitted, and the range of grains [px].
GRAIN_LAGS, GRAIN_RANGE = 5.0, (0.3, 12.0)
# Largest lag of neighbouring pixels [px]: rows, columns and diagonals.
NEIGHBOUR_LAG = 1.5
# Lag [px] beyond which grains are not correlated, and the largest part of the variance that may remain there.
FAR_LAG, FAR_SHARE = 8.0, 0.15
# Least lag [px] along a row or a column at which a covariance is due to lines, not to grains.
LINE_LAG = 5
# Σ b b' below this part of the largest is rounding error of Fourier transforms.
ROUNDING_SHARE = 1e-12
# Least Σ b b' of a block in the jackknife of gains, as a part of the largest.
LEAST_BLOCK_SHARE = 1e-3
# Standard deviations of a Gaussian correlation beyond which it is neglected: it is 4e-6 there.
FARTHEST = 5
# Largest part of a field's variance that lines along rows or columns may have.
LINE_SHARE = 0.2


@dataclass(frozen=True)
class Products:
    """Sums of products whose ratio is a covariance. A jackknife leaves out one entry of the first axis at a time."""

    residuals: np.ndarray  # Σ a a'
    light: np.ndarray  # Σ b b'

    def covariance(self) -> np.ndarray:
        """Return the covariance from the sums over the first axis."""
        return divide_lit(self.residuals.sum(axis=0), self.light.sum(axis=0))


@dataclass(frozen=True)
class FieldCovariances:
    """Covariances of relative fields; axes of lags are −LAG … LAG px along rows and columns."""

    within_frames: Products  # [site, lag, lag] of single frames; lag 0 includes the noise of pixels
    within_sites: Products  # [site, lag, lag] between frames of one site
    between_sites: Products  # [1, lag, lag] between frames of different sites
    same_pixel: Products  # [block] between sites at lag 0
    ring: Products  # [block] between sites at lags of 2 px
    along_lines: tuple[Products, Products]  # [block] between sites at 3 and 5 px along rows, and along columns


@dataclass(frozen=True)
class FieldEstimate:
    """Variance and correlation of a relative field."""

    variance: float  # relative variance [1]; NaN if no pixel can be used
    stderr: float  # standard error of the variance; NaN if a jackknife has one entry
    # Standard deviation g of the correlation exp(−d²/2g²) of pixels d apart [px]; NaN if pixels are independent.
    grain_px: float
    reasons: tuple[str, ...]  # reasons against the field, in words; empty if there is none
    frames: float = 1.0  # mean number of frames that share the field at a pixel, weighted with information


def measure_fields(images: ResidualImages) -> FieldCovariances:
    """Measure the covariances of relative fields from the residuals of a fit.

    A sum over pairs of different frames is the autocorrelation of the summed images less those of the single ones. If
    the spots of different sites lie far apart, all sums between sites are 0.
    """
    is_lit = images.spot > LIT_SHARE * images.spot.max(axis=(1, 2), keepdims=True)
    weighted = images.spot * images.weight * is_lit
    # Images of a and of b [frame, row, column].
    factors = [images.residual * weighted, images.spot * weighted]
    site, shape = images.design.site, images.residual.shape[1:]
    extent = [int(np.ptp(corner)) + length for corner, length in zip((images.top, images.left), shape, strict=True)]
    is_together = np.prod(extent) < MOST_CANVAS * np.prod(shape)
    if is_together:
        factors = [place_on_sensor(factor, images.left, images.top) for factor in factors]
    within_frames, within_sites, site_sums = [], [], []
    for number in np.unique(site):
        members = np.flatnonzero(site == number)
        of_site = [factor[members] for factor in factors]
        if not is_together:
            of_site = [place_on_sensor(factor, images.left[members], images.top[members]) for factor in of_site]
        single = np.array([sum(_autocorrelate(image) for image in factor) for factor in of_site])
        sums = np.array([factor.sum(axis=0, dtype=float) for factor in of_site])
        within_frames.append(single)
        within_sites.append(np.array([_autocorrelate(image) for image in sums]) - single)
        site_sums.append(sums)
    sums = np.array(site_sums) if is_together else np.zeros((1, 2, *shape))
    total = sums.sum(axis=0)
    between = np.array([_autocorrelate(total[k]) - sum(map(_autocorrelate, sums[:, k])) for k in range(2)])

    def at_lags(*lags: tuple[int, int]) -> Products:
        """Return the products [block] between sites, added over some lags (dy, dx) [px]."""
        return Products(*np.sum([_between_sites(sums, total, dy, dx) for dy, dx in lags], axis=0))

    return FieldCovariances(
        within_frames=Products(*np.array(within_frames).transpose(1, 0, 2, 3)),
        within_sites=Products(*np.array(within_sites).transpose(1, 0, 2, 3)),
        between_sites=Products(between[:1], between[1:]),
        same_pixel=at_lags((0, 0)),
        ring=at_lags((0, 2), (2, 0), (2, 2), (2, -2)),
        along_lines=(at_lags((0, 3), (0, 5)), at_lags((3, 0), (5, 0))),
    )


def estimate_granular_light(covariances: FieldCovariances) -> FieldEstimate:
    """Estimate the field that is different at each site: the covariance within sites less that between sites.

    Without two frames of a site, pairs of pixels of single frames are used. Their covariance at lag 0 contains noise,
    so that the variance is then extrapolated from other lags.
    """
    sites = len(covariances.within_frames.light)
    between = covariances.between_sites
    static_covariance = between.covariance() if sites > 1 else np.zeros_like(between.residuals[0])
    has_pairs = bool((covariances.within_sites.light[:, LAG, LAG] > 0).any())
    sums = covariances.within_sites if has_pairs else covariances.within_frames
    is_usable = sums.light[:, LAG, LAG] > 0
    sums = Products((sums.residuals - sums.light * static_covariance)[is_usable], sums.light[is_usable])
    covariance, distance = sums.covariance(), lag_distance()
    grain_px, extrapolated_variance = fit_grain(covariance, without_origin=not has_pairs)
    is_neighbour = (distance < NEIGHBOUR_LAG) & (distance > 0)

    def central_covariance(residuals: np.ndarray, light: np.ndarray) -> float:
        """Return the covariance at lag 0, or the mean of neighbours without pairs of frames, from sums [lag, lag]."""
        by_lag = divide_lit(residuals, light)
        return float(by_lag[LAG, LAG] if has_pairs else by_lag[is_neighbour].mean())

    variance, stderr = jackknife(sums, central_covariance)
    if not has_pairs:
        # The extrapolated variance has the relative error of the covariance of neighbours.
        variance, stderr = extrapolated_variance, stderr * extrapolated_variance / max(variance, 1e-12)
    reasons = []
    if sites < 2:
        reasons.append("one site: tied with gains of pixels")
    if covariance[distance > FAR_LAG].mean() > FAR_SHARE * variance:
        reasons.append("not granular: correlated over more than 8 px")
    lines = (covariance[LAG, LAG + LINE_LAG :].mean(), covariance[LAG + LINE_LAG :, LAG].mean())
    if max(map(abs, lines)) > LINE_SHARE * variance:
        reasons.append("lines, not grains")
    single, pairs = covariances.within_frames.light, covariances.within_sites.light
    frames = 1 + float(pairs[:, LAG, LAG].sum()) / max(float(single[:, LAG, LAG].sum()), 1e-300)
    return FieldEstimate(variance, stderr, grain_px, tuple(reasons), frames)


def estimate_white_field(images: ResidualImages) -> FieldEstimate:
    """Estimate the field that neighbouring pixels do not share, from blocks of 2 × 2 px of single frames.

    Offsets of rows and columns, and a constant slope of the mean image, cancel in the second difference over a block.
    Its expected square is the noise of the four pixels plus the field's variance times their summed squared light.
    """

    def combine_blocks(values: np.ndarray, row_sign: int, column_sign: int) -> np.ndarray:
        """Return signed sums over blocks of 2 × 2 px of `values` [frame, row, column].

        `row_sign` (1 or −1) is the sign of the second row of a block, `column_sign` that of its second column.
        """
        rows, columns = (length // 2 * 2 for length in values.shape[1:])
        row_pairs = values[:, 0:rows:2] + row_sign * values[:, 1:rows:2]
        return row_pairs[:, :, 0:columns:2] + column_sign * row_pairs[:, :, 1:columns:2]

    is_lit = (images.spot > LIT_SHARE * images.spot.max(axis=(1, 2), keepdims=True)) & (images.weight > 0)
    is_whole = combine_blocks(is_lit.astype(np.int8), 1, 1) == 4
    noise = combine_blocks(1 / np.where(is_lit, images.weight, 1.0), 1, 1)[is_whole]
    excess = combine_blocks(images.residual.astype(float), -1, -1)[is_whole] ** 2 - noise
    light = combine_blocks(images.spot.astype(float) ** 2, 1, 1)[is_whole]
    if not light.size:
        return FieldEstimate(np.nan, np.nan, np.nan, ("no pixel is lit",))
    total = np.sum(light / noise**2)
    variance = float(np.sum(excess / noise**2) / total)
    stderr = float(np.sqrt(np.sum(((excess - variance * light) / noise**2) ** 2)) / total)
    return FieldEstimate(variance, stderr, np.nan, ())


def estimate_pixel_gains(covariances: FieldCovariances) -> FieldEstimate:
    """Estimate the gains of pixels: the covariance of a pixel with itself between sites, less that with its ring."""
    pixel, ring = covariances.same_pixel, covariances.ring
    if not pixel.light.any():
        return FieldEstimate(np.nan, np.nan, np.nan, ("no pixel is lit at two sites",))
    is_used = pixel.light > LEAST_BLOCK_SHARE * pixel.light.max()
    residuals = np.stack([pixel.residuals, ring.residuals], 1)[is_used]
    light = np.stack([pixel.light, ring.light], 1)[is_used]
    variance, stderr = jackknife(Products(residuals, light), lambda a, b: float(a[0] / b[0] - a[1] / b[1]))
    ring_covariance = float(ring.residuals.sum() / ring.light.sum())
    line = max(float(lines.residuals.sum() / lines.light.sum()) - ring_covariance for lines in covariances.along_lines)
    reasons = ("lines, not pixels",) if line > LINE_SHARE * variance else ()
    return FieldEstimate(variance, stderr, np.nan, reasons)


def correlated_area(grain_px: float, block_px: int | None = None) -> float:
    """Return the area, in pixels, of a field's correlation: its sum over all pixels; 1 if pixels are independent.

    With `block_px`, the side of a square block, the sum is over the pixels of the block, in the mean over the pixel.
    """
    if not grain_px > 0:
        return 1.0
    farthest = FARTHEST * int(np.ceil(grain_px)) if block_px is None else block_px - 1
    lags = np.arange(-farthest, farthest + 1)
    # Part of the pixels of a block that have a partner at a lag.
    pair_share = 1.0 if block_px is None else 1 - np.abs(lags) / block_px
    return float((pair_share * np.exp(-(lags**2) / (2 * grain_px**2))).sum() ** 2)


def divide_lit(residuals: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return the quotient of two sums of products, and 0 where that of the light is only rounding error.

    `residuals` are sums Σ a a' over pairs of pixels and `light` the sums Σ b b' over the same pairs, arrays of one
    shape.
    """
    is_lit = light > ROUNDING_SHARE * np.max(light, initial=0.0)
    return np.divide(residuals, light, out=np.zeros_like(residuals), where=is_lit)


def fit_grain(covariance: np.ndarray, without_origin: bool) -> tuple[float, float]:
    """Fit variance × exp(−d²/2 grain²) to a covariance [lag, lag] by least squares; return (grain [px], variance).

    `without_origin` leaves out lag 0, where the covariance may contain noise.
    """
    distance = lag_distance()
    is_used = distance <= GRAIN_LAGS
    if without_origin:
        is_used &= distance > 0

    def fit_variance(log_grain: float) -> tuple[float, float]:
        """Return the best variance for a ln grain, and its sum of squared residuals."""
        shape = np.exp(-((distance[is_used] / np.exp(log_grain)) ** 2) / 2)
        variance = float(shape @ covariance[is_used] / (shape @ shape))
        return variance, float(np.sum((covariance[is_used] - variance * shape) ** 2))

    best = optimize.minimize_scalar(lambda x: fit_variance(x)[1], bounds=np.log(GRAIN_RANGE), method="bounded").x
    return float(np.exp(best)), fit_variance(best)[0]


def jackknife(sums: Products, function: Callable[[np.ndarray, np.ndarray], float]) -> tuple[float, float]:
    """Return a function of the total products and its delete-one standard error; NaN error for a single entry.

    The function takes Σ a a' and Σ b b', summed over the first axis.
    """
    residuals, light = sums.residuals.sum(axis=0), sums.light.sum(axis=0)
    value, count = function(residuals, light), len(sums.residuals)
    if count < 2:
        return value, np.nan
    reduced = np.array([function(residuals - a, light - b) for a, b in zip(sums.residuals, sums.light, strict=True)])
    return value, float(np.sqrt((count - 1) / count * np.sum((reduced - reduced.mean()) ** 2)))


def lag_distance() -> np.ndarray:
    """Return the length of each lag [px], [lag, lag]."""
    return np.hypot(*np.mgrid[-LAG : LAG + 1, -LAG : LAG + 1])


def _autocorrelate(image: np.ndarray) -> np.ndarray:
    """Return the sum over pixels of an image [row, column] times the shifted image [lag, lag]."""
    # Padding by 2 LAG keeps the two ends of the image apart.
    size = tuple(fft.next_fast_len(length + 2 * LAG, real=True) for length in image.shape)
    correlation = fft.irfft2(np.abs(fft.rfft2(image.astype(np.float32), size)) ** 2, s=size)
    return np.roll(correlation, (LAG, LAG), (0, 1))[: 2 * LAG + 1, : 2 * LAG + 1].astype(float)


def _between_sites(sums: np.ndarray, total: np.ndarray, dy: int, dx: int) -> np.ndarray:
    """Return Σ a a' and Σ b b' over pairs of different sites at one lag, by block of the sensor [2, block].

    sums [site, 2, row, column] are a and b, summed over the frames of each site; total [2, row, column] over all.
    """
    rows, columns = total.shape[1:]
    first = np.s_[..., max(0, -dy) : rows - max(0, dy), max(0, -dx) : columns - max(0, dx)]
    second = np.s_[..., max(0, dy) : rows - max(0, -dy), max(0, dx) : columns - max(0, -dx)]
    products = np.zeros((2, rows, columns))
    same_site = (sums[first] * sums[second]).sum(0)
    products[:, : rows - abs(dy), : columns - abs(dx)] = total[first] * total[second] - same_site
    blocks = min(BLOCKS, rows // 2, columns // 2)
    height, width = rows // blocks, columns // blocks
    whole = products[:, : height * blocks, : width * blocks]
    return whole.reshape(2, blocks, height, blocks, width).sum(axis=(2, 4)).reshape(2, -1)
