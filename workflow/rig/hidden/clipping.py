"""Mean and variance of a Gaussian variable after a clip, and after the converter's rounding."""

from __future__ import annotations

import math

import numpy as np
from scipy import special

from rig.hidden.effect import Array, Moments

_TAIL = 8.0  # standard deviations beyond which a clip does nothing
_QUIET = 0.6  # noise [DN] below which a rounding is no longer like uniform noise
_FINE = 20.0  # dead zone [DN] above which its edge need not be resolved step by step


def clip_above(mean: Array, variance: Array, level: float) -> Moments:
    """Moments of min(X, level)."""
    if np.all(mean + _TAIL * np.sqrt(variance) < level):
        return mean, variance
    low, low_variance = keep_above(level - mean, variance, 0.0)
    return level - low, low_variance


def keep_above(mean: Array, variance: Array, threshold: float) -> Moments:
    """Moments of X where X > threshold, of 0 elsewhere; threshold 0 gives max(X, 0)."""
    deviation = np.sqrt(np.maximum(variance, 1e-12))
    z = (mean - threshold) / deviation
    passed = special.ndtr(z)
    density = np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    first = mean * passed + deviation * density
    # Central, without the difference of two large numbers: E[(X - first)^2; passed] + first^2 (1 - passed).
    offset = mean - first
    second = (deviation**2 + offset**2) * passed + deviation * (threshold - mean + 2.0 * offset) * density
    return first, np.maximum(second + first**2 * (1.0 - passed), 0.0)


def digitised(mean: Array, variance: Array, dead: float) -> Moments:
    """Moments of a reading rounded to whole DN, not below 0, and 0 where it was below `dead` before the rounding."""
    deviation = np.sqrt(np.maximum(variance, 1e-12))
    edge = dead if dead > _FINE else 0.0
    first, spread = keep_above(mean, variance, edge)
    # Sum over steps by the midpoint rule's first correction (Euler and Maclaurin): good to 2 % of the noise.
    z = (mean - edge) / deviation
    passed = special.ndtr(z)
    lost = np.exp(-0.5 * z**2) / (24.0 * math.sqrt(2.0 * math.pi) * deviation) if edge == 0.0 else 0.0
    spread = spread + passed / 12.0 + lost * (2.0 * first - lost)
    first = first - lost
    quiet = deviation < _QUIET
    if edge == 0.0 and quiet.any():
        first[quiet], spread[quiet] = _step_by_step(mean[quiet], deviation[quiet])
    if 0.5 < dead <= _FINE:
        first, spread = _without_dead(first, spread, mean, deviation, dead)
    return first, np.maximum(spread, 0.0)


def _step_by_step(mean: Array, deviation: Array) -> Moments:
    """Moments of max(round(X), 0) for little noise: sum of the chances to reach each step."""
    start = np.maximum(np.floor(mean) - 4.0, 0.0)
    first, second = np.zeros_like(mean), np.zeros_like(mean)
    for k in range(1, 10):
        chance = special.ndtr((mean - (start + k - 0.5)) / deviation)
        first += chance
        second += (2 * k - 1) * chance
    return start + first, second - first**2


def _without_dead(first: Array, spread: Array, mean: Array, deviation: Array, dead: float) -> Moments:
    """Take away the steps that a dead zone swallows."""
    beyond = special.ndtr((mean - dead) / deviation)
    lost, lost_square = np.zeros_like(mean), np.zeros_like(mean)
    for k in range(1, math.ceil(dead + 0.5)):
        chance = special.ndtr((mean - (k - 0.5)) / deviation) - beyond
        lost += chance
        lost_square += (2 * k - 1) * chance
    return first - lost, spread - lost_square + lost * (2.0 * first - lost)
