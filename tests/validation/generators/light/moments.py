"""Mean and variance of every reading, in closed form: what second/sensor.py draws.

# ASSUME: between two ends a reading's law is normal; at an end it is the law of a normal number that is cut there.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from tests.validation.generators.second.case import FULL_SCALE, Case, Effect
from tests.validation.generators.second.optics import light, true_exposure
from tests.validation.generators.second.sensor import add_offsets, saturate

# A reading's least variance [DN²]: below it nothing is known of rounding.
LEAST = 1e-3
ROUNDING = 1 / 12


class Moments(NamedTuple):
    """Mean [DN] and variance [DN²] of readings."""

    mean: np.ndarray
    variance: np.ndarray


def moments(case: Case, i: int, image: np.ndarray | None = None) -> Moments:
    """Of all pixels of frame i; `image` in place of its light [DN]."""
    image = light(case, i) if image is None else image
    mean = image / case.gain + case.dark_current * true_exposure(case, case.frames[i])
    variance = mean.copy()
    mean = case.apply("electrons", mean, i, None)
    for effect in case.effects.values():
        variance = variance * effect.variance(effect.s)
    if smeared := case.get("smear"):
        mean = mean + smeared["fraction"] * mean.mean(axis=0, keepdims=True)
    well = case.get("saturation")
    behind = well is not None and well.form["knee"] == "hard_after_read_noise"
    if well and not behind:
        mean, variance = _full(mean, variance, well["level"] / case.gain, well)
    mean, variance = below(mean, variance, case.full_well)
    excess = case.get("excess_read_noise")
    variance = variance + (excess["total"] if excess else case.read_noise) ** 2
    if well and behind:
        mean, variance = below(mean, variance, well["level"] / case.gain)
    mean, variance = case.gain * mean, case.gain**2 * variance
    if bent := case.get("nonlinearity"):
        bend = bent["q"] / FULL_SCALE
        mean, variance = mean - bend * (mean**2 + variance), variance * (1 - 2 * bend * mean) ** 2
    return _digital(case, i, add_offsets(case, i, mean), variance)


def _digital(case: Case, i: int, mean: np.ndarray, variance: np.ndarray) -> Moments:
    """Behind all that is added to the signal: both ends, and what acts on codes."""
    if effect := case.get("black_clipping"):
        threshold = effect["threshold"]
        if effect.form["law"] == "subtraction":
            mean, variance = above(mean - threshold, variance, 0.0)
        else:
            mean, variance = dead_below(mean, variance, threshold)
    else:
        # Behind a clip nothing is below 0, and the law is no longer normal.
        mean, variance = above(mean, variance, 0.0)
    mean, variance = below(mean, variance, FULL_SCALE)
    mean = case.apply("codes", mean, i)
    return Moments(mean, variance + ROUNDING * np.minimum(variance / ROUNDING, 1.0) + LEAST)


def _full(mean: np.ndarray, variance: np.ndarray, level: float, well: Effect) -> tuple[np.ndarray, np.ndarray]:
    """Behind a well [e-], hard or soft."""
    order = well.form.get("order")
    if order is None:
        return below(mean, variance, level)
    h = np.maximum(1e-3 * np.abs(mean), 1e-3)
    low, middle, high = (saturate(mean + d, level, float(str(order))) for d in (-h, 0.0, h))
    return middle + (high - 2 * middle + low) / h**2 * variance / 2, ((high - low) / (2 * h)) ** 2 * variance


def below(mean: np.ndarray, variance: np.ndarray, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of min(X, end) of normal X."""
    cut, variance = above(-mean, variance, -end)
    return -cut, variance


def above(mean: np.ndarray, variance: np.ndarray, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of max(X, end) of normal X (Greene, Econometric Analysis, 19.3)."""
    if not np.isfinite(end) or np.all(mean - end > 7 * np.sqrt(variance)):
        return mean, variance
    sd = np.sqrt(np.maximum(variance, 1e-12))
    z = (mean - end) / sd
    inside, density = ndtr(z), np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
    first = sd * (z * inside + density)
    second = sd**2 * ((z**2 + 1) * inside + z * density)
    return end + first, np.maximum(second - first**2, 0.0)


def dead_below(mean: np.ndarray, variance: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of X where it is above the threshold, else 0."""
    sd = np.sqrt(np.maximum(variance, 1e-12))
    z = (mean - threshold) / sd
    inside, density = ndtr(z), np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
    first = mean * inside + sd * density
    second = (mean**2 + sd**2) * inside + sd * (mean + threshold) * density
    return first, np.maximum(second - first**2, 0.0)
