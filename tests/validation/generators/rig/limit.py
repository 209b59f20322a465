"""How strong an effect must be to be found at all, by the rig's own reckoning: nothing of the library is asked."""

from __future__ import annotations

import dataclasses
from collections import defaultdict

import numpy as np
from scipy import optimize, stats

from rig import hidden
from rig.hidden import registry
from rig.hidden.designs import FRAME_PX
from rig.hidden.sensors import FixedPattern
from rig.hidden.strength import Judge, Reference
from rig.hidden.world import World

# Signal-to-noise at which a single known signature is found in 90 of 100 at 1 % false alarms.
FISHER = 3.9
POWER, ALARMS = 0.9, 0.01
# What the contract does not call a disagreement: parts of the peak, and of a pixel's noise.
OF_PEAK, OF_NOISE = 0.002, 0.02
# Sets with and without hot pixels that tell how often these are found: to 1 % of the power.
DRAWS = 4000
# A pixel's reading in standard deviations, in bins much finer than one.
BINS = np.arange(-8.0, 25.0, 0.05)
# Scales of hot pixels between which they begin to be found.
SCALES = (1e-3, 8.0)
# Heights of hot pixels over their scale.
HEIGHTS = np.linspace(0.3, 2.0, 35)


def limit_of(case: hidden.Case) -> float:
    """The signal-to-noise from which on a case's effects should be found: Fisher's limit, or where their size in any
    condition passes the tolerance, if that is more. Sizes grow as the signal-to-noise does."""
    steady = tuple(effect for effect in case.world.effects if not effect.scatters)
    if len(steady) < len(case.world.effects):
        # The tolerance is of means and noise: scatter that stands out is always told.
        hot = [effect for effect in case.world.effects if isinstance(effect, FixedPattern) and effect.hot_pixels]
        return limit_of_hot(case, hot[0]) if hot else FISHER
    judge = Judge(registry.design(case.design), case.shots)
    reference = Reference(World(case.world.base), judge.frames, judge.thin)
    mean, variance = reference.pictures(World(case.world.base, steady))
    left = reference.refitted(mean)
    top = float(np.max(reference.mean)) - case.world.base.black_level
    expected = reference.variance + case.world.base.gain * (mean - left - reference.mean)
    excess = abs(float(np.mean(np.maximum(variance, 1e-2) / np.maximum(expected, 1e-2)))) - 1
    conditions = defaultdict(list)
    for k, site in enumerate(judge.frames):
        for j, shot in enumerate(site):
            conditions[shot.angle_deg, shot.exposure_s].append(
                (left[k, j] ** 2, left[k, j] ** 2 / reference.variance[k, j])
            )
    squares = [np.mean(own, axis=(0, 2, 3)) for own in conditions.values()]
    of_peak, of_noise = (float(np.sqrt(max(own[i] for own in squares))) for i in (0, 1))
    sizes = (of_peak / top / OF_PEAK, of_noise / OF_NOISE, abs(excess) / (2 * OF_NOISE))
    return max(FISHER, case.truth["snr"] / max(*sizes, 1e-9))


def limit_of_hot(case: hidden.Case, effect: FixedPattern) -> float:
    """The signal-to-noise of hot pixels, with the gains beside them, from which the most powerful test finds them.

    Signal-to-noise counts every hot pixel as if its place were known. No test knows the places: by chance the oddest of
    all pixels are as odd as faint hot ones.
    """
    judge = Judge(registry.design(case.design), case.shots)
    reference = Reference(World(case.world.base), judge.frames, judge.thin)
    one_dn = np.sqrt(np.median(reference.per_pixel(reference.d_reading).sum(axis=(0, 1))))

    def at(log_scale: float) -> FixedPattern:
        return effect.at(float(np.exp(log_scale) / (one_dn * effect.hot_ratio)))

    def missing(log_scale: float) -> float:
        gains = dataclasses.replace(at(log_scale), hot_pixels=0).scatter_snr2(reference)
        return power_of_hot(float(np.exp(log_scale)), effect.hot_pixels, FRAME_PX**2, gains) - POWER

    return float(np.sqrt(at(optimize.brentq(missing, *np.log(SCALES), xtol=0.01)).scatter_snr2(reference)))


def power_of_hot(scale: float, hot: int, pixels: int, others: float = 0.0) -> float:
    """Part of the sets in which the likelihood ratio (Neyman and Pearson) finds `hot` of `pixels` pixels off by `scale`
    standard deviations times their heights, at the rate `ALARMS` of false alarms; `others` is the squared
    signal-to-noise of what shows beside them, with a normal law."""
    rng = np.random.default_rng(0)
    middle = (BINS[1:] + BINS[:-1]) / 2
    empty = stats.norm.pdf(middle)
    lit = stats.norm.pdf(middle[:, None], scale * HEIGHTS).mean(axis=1)
    empty, lit = empty / empty.sum(), lit / lit.sum()
    ratio = np.log1p(hot / pixels * (lit / empty - 1))
    without = rng.multinomial(pixels, empty, DRAWS) @ ratio
    found = (rng.multinomial(pixels - hot, empty, DRAWS) + rng.multinomial(hot, lit, DRAWS)) @ ratio
    beside = rng.normal(others / 2, np.sqrt(others), (2, DRAWS))
    threshold = np.quantile(without - beside[0], 1 - ALARMS)
    return float(np.mean(found + beside[1] > threshold))
