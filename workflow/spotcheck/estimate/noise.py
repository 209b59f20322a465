"""Gain and noise floor from the differences of neighbouring pixels, for frames without a data sheet.

One frame is enough. The variance of second differences along a row follows, over the grey level L above black,
floor + K L + (c L)²: read noise and rounding, shot noise, and texture such as speckle, whose contrast c is fitted as
well.
"""

from typing import NamedTuple

import numpy as np

BINS = 24
# Fewest differences in a bin: the variance of a bin is then known to 10 %.
FEWEST = 200
# Noise is whole where the level is this many standard deviations above 0.
CUT_AT_SD = 3.5
# ASSUME: texture follows (c L)² to this part of itself.
FORM = 0.01

# Readings gather where the signal stops: bins of this part of a level, that hold this many times the pixels that a
# spot's flank has in as many, from where to where of the highest the flank is looked at, and how near to each other
# the levels of frames of different light must be.
FINE, GATHER, FLANK, ALIKE = 0.04, 4.0, (0.25, 0.6), 0.05


class NoiseCurve(NamedTuple):
    """Variance [DN²] of single pixels against grey level [DN], with the standard error of each variance."""

    level: np.ndarray
    variance: np.ndarray
    stderr: np.ndarray


class Gain(NamedTuple):
    """K [DN/e-] and noise floor [DN²] (read noise and rounding) with standard errors."""

    gain: float
    gain_stderr: float
    floor: float
    floor_stderr: float


def noise_curve(image: np.ndarray, full_scale: float) -> NoiseCurve:
    """Noise against level of one image [rows, columns]; triples that touch a clip or a gap are left out."""
    left, middle, right = image[:, :-2], image[:, 1:-1], image[:, 2:]
    level = (left + middle + right) / 3
    # A second difference kills offset and slope of the spot; its variance is 6 times a pixel's.
    difference = (left - 2 * middle + right) / np.sqrt(6)
    highest = np.maximum(np.maximum(left, middle), right)
    use = np.isfinite(difference) & (highest < full_scale)
    level, difference = level[use], difference[use]
    if level.size < 2 * FEWEST:
        return NoiseCurve(*(np.empty(0) for _ in range(3)))
    edges = np.unique(np.quantile(level, np.linspace(0, 1, BINS + 1)))
    place = np.clip(np.searchsorted(edges, level, side="right") - 1, 0, len(edges) - 2)
    rows = []
    for k in range(len(edges) - 1):
        own, own_level = difference[place == k], level[place == k]
        if own.size >= FEWEST:
            variance = float(np.var(own))
            # Where readings reach 0 the converter has cut the noise: the whole bin goes, since single triples would
            # be picked by their noise.
            if variance == 0 or own_level.mean() < CUT_AT_SD * np.sqrt(variance):
                continue
            # Neighbouring second differences overlap: a third of them is independent.
            rows.append((float(own_level.mean()), variance, variance * np.sqrt(6 / own.size) + 1e-3))
    return NoiseCurve(*np.array(rows).reshape(-1, 3).T)


def gain_from_curve(curve: NoiseCurve, black_level: float) -> Gain | None:
    """Fit floor + K L + (c L)² to a curve; None where K is not seen at three standard errors."""
    if curve.level.size < 5:
        return None
    level = curve.level - black_level
    design = np.stack([np.ones_like(level), level, level**2], axis=1)
    # Errors of the bins are relative ones; they follow the fitted curve, since a bin that fell low by chance must not
    # pull harder.
    relative, model = curve.stderr / curve.variance, curve.variance
    for terms in (3, 2):
        for _ in range(4):
            error = relative * np.maximum(model, 1e-3)
            weighted, target = design[:, :terms] / error[:, None], curve.variance / error
            solution, *_ = np.linalg.lstsq(weighted, target, rcond=None)
            model = design[:, :terms] @ solution
        residual = weighted @ solution - target
        inflation = max(1.0, float(residual @ residual) / max(level.size - terms, 1))
        covariance = np.linalg.pinv(weighted.T @ weighted) * inflation
        # Texture is kept where it is seen: else its freedom costs the gain half of its precision.
        if terms == 2 or solution[2] > 3 * np.sqrt(covariance[2, 2]):
            break
    # The rest of a texture that does not follow its law exactly counts as gain.
    form = FORM * abs(solution[2]) * float(level.mean()) if terms == 3 else 0.0
    gain, gain_error = float(solution[1]), float(np.hypot(np.sqrt(covariance[1, 1]), form))
    if not gain > 3 * gain_error:
        return None
    return Gain(gain, gain_error, float(solution[0]), float(np.sqrt(covariance[0, 0])))


def stop_of(image: np.ndarray, black_level: float) -> float:
    """Level over black [DN] at which the readings of one spot gather; NaN where they do not.

    A Gaussian spot has as many pixels in every step of ln level, so a step that has many more is where light stops.
    """
    level = image[np.isfinite(image)] - black_level
    top = float(np.quantile(level, 0.999)) if level.size else 0.0
    if top <= 0:
        return np.nan
    steps = np.log(level[level > FLANK[0] * top] / top)
    edges = np.arange(np.log(FLANK[0]), 0.15, FINE)
    count, _ = np.histogram(steps, edges)
    flank = count[(edges[:-1] >= np.log(FLANK[0])) & (edges[1:] <= np.log(FLANK[1]))]
    if flank.sum() < FEWEST:
        return np.nan
    fullest = int(np.argmax(count))
    if count[fullest] < GATHER * flank.mean() or edges[fullest] < np.log(FLANK[1]):
        return np.nan
    near = np.abs(steps - edges[fullest] - FINE / 2) < 1.5 * FINE
    return float(top * np.exp(np.median(steps[near])))


def common_stop(stops: list[float]) -> tuple[float, float] | None:
    """The level at which most frames stop, with its standard error; None where fewer than two do, or where each stops
    elsewhere, as plateaus of the light itself would."""
    known = np.array([stop for stop in stops if np.isfinite(stop)])
    if len(known) < 2:
        return None
    middle = float(np.median(known))
    alike = known[np.abs(known - middle) < ALIKE * middle]
    if len(alike) < 2 or len(alike) < 0.6 * len(known):
        return None
    return float(alike.mean()), float(alike.std(ddof=1) / np.sqrt(len(alike)))
