"""Gain and noise floor from the differences of neighbouring pixels, for frames without a data sheet.

One frame is enough. Of each four pixels a b / c e the difference d = (a − b − c + e)/2 has the variance of one pixel;
what varies along rows or columns alone drops out, and so does the mean of the nine such differences around, in which
all pixels but four corners cancel. Over the grey level L above black the variance follows floor + K L + (c L)²: read
noise and rounding, shot noise, and texture such as unlike pixels or speckle, whose contrast c is fitted where it is
seen. A level is the four pixels' own mean: it shares nothing with d, and of Poisson electrons with one mean the
variance given their sum is that of the sum. Read noise tells no light: the darkest pixels are one bin.
"""

from typing import NamedTuple

import numpy as np

# Bins are even in the root of the level, on which shot noise is even.
BINS = 25
# Fewest differences in a bin: the variance of a bin is then known to 15 %.
FEWEST = 200
# Noise is whole where the level is this many standard deviations above 0, and below full scale.
CUT_AT_SD = 3.5
# Differences beyond so many standard deviations are hot pixels or edges, not noise: one in 5e8 is.
OUTLIER_SD, TRIMS = 6.0, 6
# Within so many DN of the darkest level noise is left out where it is finer than this [DN]: rounding then adds more or
# less than 1/12 DN².
NEAR_DARK, FINE = 5.0, 0.6
# The darkest level is that below which this part of the pixels lie; the first bin reaches so many standard errors of a
# level beyond it, so that it holds all pixels without light.
DARK_PART, DARK_SD = 0.05, 5.0
# Neighbouring differences overlap: 1 + 4/4 + 4/16 squared correlations, so that a variance of n of them is known to
# √(2 · 2.25/n).
OVERLAP = 2.25
# A bin whose variance is below this part of what the bins below it let expect, by this many standard errors, is where
# the signal stops: it and all above go, and the one below, part of which has stopped.
COLLAPSE, COLLAPSE_Z, FIRST = 0.6, 5.0, 6
# Texture is a term of the fit where it is seen at this many standard errors: its freedom costs the gain half of its
# precision. ASSUME: it follows (c L)² to this part of itself.
TEXTURE_Z, FORM = 5.0, 0.01
# Ends of the gain's interval in standard errors.
ENDS = 2.0

# Neighbours' noise is looked at as far as this [px]; a correlation of differences that is off white noise's by this
# much is one; by as much as `NOT_WHITE` between next neighbours, the differences do not tell the noise.
FARTHEST, CORRELATED, NOT_WHITE = 16, 0.06, 0.15


class NoiseCurve(NamedTuple):
    """Variance [DN²] of single pixels against grey level [DN], with the standard error of each variance."""

    level: np.ndarray
    variance: np.ndarray
    stderr: np.ndarray


class Gain(NamedTuple):
    """K [DN/e-] and noise floor [DN²] (read noise and rounding) with standard errors; and the ends of the interval that
    holds K in 95 of 100, whatever texture the frames may have: what is too little to be seen counts as gain."""

    gain: float
    gain_stderr: float
    floor: float
    floor_stderr: float
    low: float
    high: float


class Differences(NamedTuple):
    """Differences of four neighbours [DN], and their levels [DN], both [row, column]; NaN at gaps."""

    level: np.ndarray
    difference: np.ndarray


def differences(image: np.ndarray) -> Differences:
    """Of all fours of an image that have a rim of one pixel around them."""
    image = np.asarray(image, float)
    if min(image.shape) < 4:
        return Differences(np.empty((0, 0)), np.empty((0, 0)))
    a, b, c, e = image[1:-2, 1:-2], image[1:-2, 2:-1], image[2:-1, 1:-2], image[2:-1, 2:-1]
    # The mean of nine differences is that of the four corners of the rim: it tells what bends at 1/81 of the variance.
    bent = (image[:-3, :-3] - image[:-3, 3:] - image[3:, :-3] + image[3:, 3:]) / 18
    return Differences((a + b + c + e) / 4, ((a - b - c + e) / 2 - bent) / np.sqrt(1 + 1 / 81))


def noise_curve(image: np.ndarray, full_scale: float) -> NoiseCurve:
    """Noise against level of one image [rows, columns]; what touches a clip or a gap is left out."""
    rows = [(level, own.variance, own.stderr) for level, own in _bins(differences(image), full_scale)]
    return _unstopped(NoiseCurve(*np.array(rows).reshape(-1, 3).T))


class _Bin(NamedTuple):
    """Variance [DN²] with its error, and which differences (flat) are of the bin and no outliers."""

    variance: float
    stderr: float
    which: np.ndarray


def _bins(seen: Differences, full_scale: float) -> list[tuple[float, _Bin]]:
    """Bins of level, from the darkest on, whose noise is whole."""
    level, difference = seen.level.ravel(), seen.difference.ravel()
    known = np.flatnonzero(np.isfinite(difference))
    if known.size < 2 * FEWEST:
        return []
    ordered = np.sort(level[known])
    dark, low, top = np.quantile(ordered, DARK_PART), ordered[0], ordered[-FEWEST]
    near = known[level[known] < dark + NEAR_DARK]
    noise = float(np.sqrt(_trimmed(difference[near])[0])) if near.size else 0.0
    if near.size < FEWEST or noise < FINE:
        low = dark + NEAR_DARK
    first = max(low, dark + DARK_SD * noise / 2)
    if top <= first:
        return []
    edges = np.concatenate([[low], first + (top - first) * np.linspace(0, 1, BINS) ** 2])
    known = known[(level[known] >= low) & (level[known] <= top)]
    place = np.minimum(np.searchsorted(edges, level[known], side="right") - 1, BINS - 1)
    out = []
    for k in range(BINS):
        own = known[place == k]
        if own.size < FEWEST:
            continue
        variance, kept = _trimmed(difference[own])
        middle, reach = float(level[own].mean()), CUT_AT_SD * np.sqrt(variance)
        # The whole bin goes where a clip has cut the noise, since single fours would be picked by their noise.
        if variance == 0 or middle < reach or middle > full_scale - reach:
            continue
        error = variance * np.sqrt(2 * OVERLAP / own.size) + 1e-3
        out.append((middle, _Bin(variance, error, own[kept])))
    return out


def _trimmed(difference: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean square without outliers, and which are none."""
    kept = np.ones(difference.size, bool)
    square = difference**2
    for _ in range(TRIMS):
        variance = float(square[kept].mean())
        kept = square <= OUTLIER_SD**2 * variance
        if kept.all() or variance == 0:
            break
    return float(square[kept].mean()), kept


def _unstopped(curve: NoiseCurve) -> NoiseCurve:
    """A curve up to where its noise collapses."""
    for k in range(FIRST, curve.level.size):
        below = NoiseCurve(*(part[:k] for part in curve))
        fitted = _fitted(below, curve.level[0], 2)
        expected = max(fitted.value[0] + fitted.value[1] * (curve.level[k] - curve.level[0]), curve.variance[:k].max())
        error = curve.stderr[k] / curve.variance[k] * expected
        if curve.variance[k] < COLLAPSE * expected and expected - curve.variance[k] > COLLAPSE_Z * error:
            return NoiseCurve(*(part[: k - 1] for part in curve))
    return curve


class _Fit(NamedTuple):
    """Terms of a curve [floor, K, c²] and their covariance."""

    value: np.ndarray
    covariance: np.ndarray


def _fitted(curve: NoiseCurve, black_level: float, terms: int) -> _Fit:
    """Least squares; where the scatter of the bins is more than stated, so are the errors."""
    level = curve.level - black_level
    design = np.stack([np.ones_like(level), level, level**2], axis=1)[:, :terms]
    # Errors of the bins are relative ones; they follow the fitted curve, since a bin that fell low by chance must not
    # pull harder.
    relative, model = curve.stderr / curve.variance, curve.variance
    for _ in range(4):
        error = relative * np.maximum(model, 1e-3)
        weighted, target = design / error[:, None], curve.variance / error
        solution, *_ = np.linalg.lstsq(weighted, target, rcond=None)
        model = design @ solution
    residual = weighted @ solution - target
    inflation = max(1.0, float(residual @ residual) / max(level.size - terms, 1))
    return _Fit(solution, np.linalg.pinv(weighted.T @ weighted) * inflation)


def gain_from_curve(curve: NoiseCurve, black_level: float) -> Gain | None:
    """Fit floor + K L + (c L)² to a curve; None where K is not seen at three standard errors."""
    if curve.level.size < 5:
        return None
    plain, textured = (_fitted(curve, black_level, terms) for terms in (2, 3))
    seen = textured.value[2] > TEXTURE_Z * np.sqrt(textured.covariance[2, 2])
    fit = textured if seen else plain
    # The rest of a texture that does not follow its law exactly counts as gain.
    form = FORM * abs(textured.value[2]) * float(np.mean(curve.level - black_level)) if seen else 0.0
    gain, error = float(fit.value[1]), float(np.hypot(np.sqrt(fit.covariance[1, 1]), form))
    if not gain > 3 * error:
        return None
    least = float(textured.value[1]) - ENDS * float(np.hypot(np.sqrt(textured.covariance[1, 1]), form))
    low, high = min(least, gain - ENDS * error), gain + ENDS * error
    return Gain(gain, error, float(fit.value[0]), float(np.sqrt(fit.covariance[0, 0])), max(low, 0.0), high)


class Correlated(NamedTuple):
    """How far apart [px] along rows or columns differences of pixels share what white noise would not let them share,
    0 where they do not; and whether they tell the noise all the same."""

    reach_px: int
    tells: bool


def correlated_px(image: np.ndarray, full_scale: float) -> Correlated:
    """Whether an image's noise is white. Compression and grain of few pixels make it another.

    Of white noise neighbouring differences correlate by −1/2, those further apart not at all.
    """
    seen = differences(image)
    unit = np.full(seen.difference.size, np.nan)
    for _, own in _bins(seen, full_scale):
        unit[own.which] = seen.difference.ravel()[own.which] / np.sqrt(own.variance)
    image_of_units = unit.reshape(seen.difference.shape)
    if np.isfinite(unit).sum() < 2 * FEWEST:
        return Correlated(0, True)
    farthest, tells = 0, True
    for grid in (image_of_units, image_of_units.T):
        for lag in range(1, min(FARTHEST, len(grid) - 1) + 1):
            product = grid[:-lag] * grid[lag:]
            product = product[np.isfinite(product)]
            if product.size < FEWEST:
                break
            off = float(product.mean()) + (0.5 if lag == 1 else 0.0)
            # Three standard errors of a mean of products of white differences, which overlap.
            if abs(off) > CORRELATED + 3 * np.sqrt(OVERLAP / product.size):
                farthest = max(farthest, lag)
                tells &= lag > 1 or abs(off) < NOT_WHITE
    return Correlated(farthest, bool(tells))
