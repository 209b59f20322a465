"""Relative fields: granular light that is new at each site, and gains of pixels that are fixed to the sensor.

Products of residuals that share no noise estimate the covariance of a field that multiplies the light: with a = r G w
and b = G² w (residual r [DN], G = d mean/d ln peak [DN], weight w [1/DN²]), Σ a a'/Σ b b' is that covariance. Pairs are
frames of one site, which share grains and gains, or frames of different sites, which share gains alone. Errors come
from a jackknife over sites, or over blocks of the sensor.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft, optimize

from spotcheck.discrepancy.residuals import ResidualImages, place_on_sensor

# Largest lag of a covariance [px].
LAG = 12
# Part of the brightest pixel's light below which a pixel says nothing about a field.
LIT_SHARE = 0.05
# Blocks of the sensor along each side for the jackknife of gains.
BLOCKS = 40
# Part of the sensor that holds all crops, in crops, beyond which sites share no pixels.
MOST_CANVAS = 3.0
# Lags at which the grain is fitted, and the grains that are tried [px].
GRAIN_LAGS, GRAIN_RANGE = 5.0, (0.3, 12.0)
# Lag [px] beyond which grains are not correlated, and the part of the variance that may be left there.
FAR_LAG, FAR_SHARE = 8.0, 0.15
# Part of the largest product of light below which products are rounding of Fourier transforms.
ROUNDING_SHARE = 1e-12
# Standard deviations of a correlation beyond which it is nothing: 4e-6.
FARTHEST = 5
# Part of a field's variance that lines along rows or columns may have.
LINE_SHARE = 0.2


@dataclass(frozen=True)
class Products:
    """Sums of products; their ratio is a covariance. The first axis is what a jackknife leaves out."""

    residuals: np.ndarray  # Σ a a'
    light: np.ndarray  # Σ b b'

    def covariance(self) -> np.ndarray:
        """Return the covariance over all entries."""
        return divide_lit(self.residuals.sum(axis=0), self.light.sum(axis=0))


@dataclass(frozen=True)
class FieldCovariances:
    """Covariances of relative fields by lag, −LAG … LAG along rows and columns."""

    within_frames: Products  # [site, lag, lag] of single frames; the noise of pixels sits at lag 0
    within_sites: Products  # [site, lag, lag] between frames of one site
    between_sites: Products  # [1, lag, lag] between frames of different sites
    same_pixel: Products  # [block] between sites at lag 0
    ring: Products  # [block] between sites at lags of 2 px
    along_lines: tuple[Products, Products]  # [block] between sites at 3 and 5 px along rows, and along columns


@dataclass(frozen=True)
class FieldEstimate:
    """Variance of a relative field."""

    variance: float  # relative variance [1]
    stderr: float  # its standard error
    grain_px: float  # standard deviation of the correlation exp(−d²/2 grain²) [px]; NaN for gains of pixels
    reasons: tuple[str, ...]  # against it; empty: the field is there
    frames: float = 1.0  # frames in which a pixel shows the same value of the field, weighted by information


def measure_fields(images: ResidualImages) -> FieldCovariances:
    """Return the covariances of the residuals of a fit."""
    is_lit = images.spot > LIT_SHARE * images.spot.max(axis=(1, 2), keepdims=True)
    weighted = images.spot * images.weight * is_lit
    factors = [images.residual * weighted, images.spot * weighted]
    site, shape = images.design.site, images.residual.shape[1:]
    extent = [int(np.ptp(corner)) + length for corner, length in zip((images.top, images.left), shape, strict=True)]
    # Sites whose spots lie far apart share no pixels.
    is_together = np.prod(extent) < MOST_CANVAS * np.prod(shape)
    if is_together:
        factors = [place_on_sensor(factor, images.left, images.top) for factor in factors]
    within_frames, within_sites, site_sums = [], [], []
    for number in np.unique(site):
        members = np.flatnonzero(site == number)
        parts = [factor[members] for factor in factors]
        if not is_together:
            parts = [place_on_sensor(part, images.left[members], images.top[members]) for part in parts]
        size = tuple(fft.next_fast_len(length + 2 * LAG, real=True) for length in parts[0].shape[1:])
        alone = np.array([sum(_autocorrelate(image, size) for image in part) for part in parts])
        sums = np.array([part.sum(axis=0, dtype=float) for part in parts])
        within_frames.append(alone)
        within_sites.append(np.array([_autocorrelate(image, size) for image in sums]) - alone)
        site_sums.append(sums)
    sums = np.array(site_sums) if is_together else np.zeros((1, 2, *shape))
    total = sums.sum(axis=0)
    size = tuple(fft.next_fast_len(length + 2 * LAG, real=True) for length in total.shape[1:])
    of_sites = [sum(_autocorrelate(image, size) for image in sums[:, k]) for k in range(2)]
    between = np.array([_autocorrelate(total[k], size) - of_sites[k] for k in range(2)])

    def at_lags(*lags: tuple[int, int]) -> Products:
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
    """Return the field that is new at each site: what sites share is taken off."""
    sites = len(covariances.within_frames.light)
    between = covariances.between_sites
    static = between.covariance() if sites > 1 else np.zeros_like(between.residuals[0])
    has_pairs = bool((covariances.within_sites.light[:, LAG, LAG] > 0).any())
    sums = covariances.within_sites if has_pairs else covariances.within_frames
    kept = sums.light[:, LAG, LAG] > 0
    sums = Products((sums.residuals - sums.light * static)[kept], sums.light[kept])
    covariance, distance = sums.covariance(), lag_distance()
    grain, amplitude = fit_grain(covariance, without_origin=not has_pairs)
    near = (distance < 1.5) & (distance > 0)

    def central(residuals: np.ndarray, light: np.ndarray) -> float:
        values = divide_lit(residuals, light)
        return float(values[LAG, LAG] if has_pairs else values[near].mean())

    variance, stderr = jackknife(sums, central)
    if not has_pairs:
        variance, stderr = amplitude, stderr * amplitude / max(variance, 1e-12)
    reasons = []
    if sites < 2:
        reasons.append("one site: tied with gains of pixels")
    if covariance[distance > FAR_LAG].mean() > FAR_SHARE * variance:
        reasons.append("not granular: correlated over more than 8 px")
    lines = (covariance[LAG, LAG + 5 :].mean(), covariance[LAG + 5 :, LAG].mean())
    if max(map(abs, lines)) > LINE_SHARE * variance:
        reasons.append("lines, not grains")
    alone, pairs = covariances.within_frames.light, covariances.within_sites.light
    frames = 1 + float(pairs[:, LAG, LAG].sum()) / max(float(alone[:, LAG, LAG].sum()), 1e-300)
    return FieldEstimate(variance, stderr, grain, tuple(reasons), frames)


def estimate_white_field(images: ResidualImages) -> FieldEstimate:
    """Return the field that neighbouring pixels do not share, from blocks of 2 × 2 px of single frames.

    The difference of the differences of a block knows no rows, no columns and no slope of the mean image.
    """

    def of_blocks(values: np.ndarray, signs: tuple[int, int]) -> np.ndarray:
        rows, columns = (length // 2 * 2 for length in values.shape[1:])
        tall = values[:, 0:rows:2] + signs[0] * values[:, 1:rows:2]
        return tall[:, :, 0:columns:2] + signs[1] * tall[:, :, 1:columns:2]

    is_lit = (images.spot > LIT_SHARE * images.spot.max(axis=(1, 2), keepdims=True)) & (images.weight > 0)
    whole = of_blocks(is_lit.astype(np.int8), (1, 1)) == 4
    noise = of_blocks(1 / np.where(is_lit, images.weight, 1.0), (1, 1))[whole]
    squares = of_blocks(images.residual.astype(float), (-1, -1))[whole] ** 2 - noise
    light = of_blocks(images.spot.astype(float) ** 2, (1, 1))[whole]
    if not light.size:
        return FieldEstimate(np.nan, np.nan, np.nan, ("no pixel is lit",))
    total = np.sum(light / noise**2)
    variance = float(np.sum(squares / noise**2) / total)
    stderr = float(np.sqrt(np.sum(((squares - variance * light) / noise**2) ** 2)) / total)
    return FieldEstimate(variance, stderr, np.nan, ())


def estimate_pixel_gains(covariances: FieldCovariances) -> FieldEstimate:
    """Return the gains of pixels: the covariance of a pixel with itself between sites, above that of its surround."""
    zero, ring = covariances.same_pixel, covariances.ring
    if not zero.light.any():
        return FieldEstimate(np.nan, np.nan, np.nan, ("no pixel is lit at two sites",))
    used = zero.light > 1e-3 * zero.light.max()
    sums = Products(np.stack([zero.residuals, ring.residuals], 1)[used], np.stack([zero.light, ring.light], 1)[used])
    variance, stderr = jackknife(sums, lambda r, b: float(r[0] / b[0] - r[1] / b[1]))
    surround = float(ring.residuals.sum() / ring.light.sum())
    line = max(float(lines.residuals.sum() / lines.light.sum()) - surround for lines in covariances.along_lines)
    reasons = ("lines, not pixels",) if line > LINE_SHARE * variance else ()
    return FieldEstimate(variance, stderr, np.nan, reasons)


def correlated_area(grain_px: float, block_px: int | None = None) -> float:
    """Return the sum of a field's correlation over the pixels about one [px]; 1 without a grain.

    With `block_px` it is taken over the pairs of pixels of a square block, for each of its pixels.
    """
    if not grain_px > 0:
        return 1.0
    farthest = FARTHEST * int(np.ceil(grain_px)) if block_px is None else block_px - 1
    lags = np.arange(-farthest, farthest + 1)
    share = 1.0 if block_px is None else 1 - np.abs(lags) / block_px
    return float((share * np.exp(-(lags**2) / (2 * grain_px**2))).sum() ** 2)


def divide_lit(residuals: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return residuals over light, and 0 where the light is nothing but the rounding of its transform."""
    is_lit = light > ROUNDING_SHARE * np.max(light, initial=0.0)
    return np.divide(residuals, light, out=np.zeros_like(residuals), where=is_lit)


def fit_grain(covariance: np.ndarray, without_origin: bool) -> tuple[float, float]:
    """Return the grain [px] and the variance of the correlation exp(−d²/2 grain²) that comes nearest."""
    distance = lag_distance()
    used = distance <= GRAIN_LAGS
    if without_origin:
        used &= distance > 0

    def variance_of(log_grain: float) -> tuple[float, np.ndarray]:
        shape = np.exp(-((distance[used] / np.exp(log_grain)) ** 2) / 2)
        return float(shape @ covariance[used] / (shape @ shape)), shape

    def misfit(log_grain: float) -> float:
        variance, shape = variance_of(log_grain)
        return float(np.sum((covariance[used] - variance * shape) ** 2))

    best = optimize.minimize_scalar(misfit, bounds=np.log(GRAIN_RANGE), method="bounded").x
    return float(np.exp(best)), variance_of(best)[0]


def jackknife(sums: Products, function: Callable[[np.ndarray, np.ndarray], float]) -> tuple[float, float]:
    """Return a function of the added products and its delete-one standard error, NaN for a single entry."""
    residuals, light = sums.residuals.sum(axis=0), sums.light.sum(axis=0)
    value, count = function(residuals, light), len(sums.residuals)
    if count < 2:
        return value, np.nan
    parts = np.array([function(residuals - r, light - b) for r, b in zip(sums.residuals, sums.light, strict=True)])
    return value, float(np.sqrt((count - 1) / count * np.sum((parts - parts.mean()) ** 2)))


def lag_distance() -> np.ndarray:
    """Return the distance of the lags [lag, lag, px]."""
    return np.hypot(*np.mgrid[-LAG : LAG + 1, -LAG : LAG + 1])


def _autocorrelate(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the sum over pixels of an image times the shifted image [lag, lag]."""
    correlation = fft.irfft2(np.abs(fft.rfft2(image.astype(np.float32), size)) ** 2, s=size)
    return np.roll(correlation, (LAG, LAG), (0, 1))[: 2 * LAG + 1, : 2 * LAG + 1].astype(float)


def _between_sites(sums: np.ndarray, total: np.ndarray, dy: int, dx: int) -> np.ndarray:
    """Return sums of products at one lag between different sites by block of the sensor [2, block].

    sums [site, 2, row, column] over the frames of each site; total [2, row, column].
    """
    rows, columns = total.shape[1:]
    first = np.s_[..., max(0, -dy) : rows - max(0, dy), max(0, -dx) : columns - max(0, dx)]
    second = np.s_[..., max(0, dy) : rows - max(0, -dy), max(0, dx) : columns - max(0, -dx)]
    products = np.zeros((2, rows, columns))
    products[:, : rows - abs(dy), : columns - abs(dx)] = total[first] * total[second] - (
        sums[first] * sums[second]
    ).sum(0)
    blocks = min(BLOCKS, rows // 2, columns // 2)
    height, width = rows // blocks, columns // blocks
    used = products[:, : height * blocks, : width * blocks]
    return used.reshape(2, blocks, height, blocks, width).sum(axis=(2, 4)).reshape(2, -1)
