"""Saturation: the signal stops at a level, the full well's or the converter's."""

from enum import Enum

import numpy as np
from scipy.special import ndtr

from spotcheck.model.effect import Effect, Parameter, RandomStep, Scope, Stage, Step

# Levels that stand for a scattering one, and how far they reach [standard deviations].
LEVELS, LEVELS_REACH_TO = 61, 5.0


class Variant(Enum):
    """The place and the shape of the stop: a well in front of the read noise, a converter behind it (with noise)."""

    SHARP = "sharp"
    SOFT = "soft"
    POWER = "power"
    SHARP_SCATTERED = "sharp scattered"
    SHARP_WITH_NOISE = "sharp with noise"
    SOFT_WITH_NOISE = "soft with noise"
    POWER_WITH_NOISE = "power with noise"


def stop(signal_dn, *, level):
    """Return the signal [DN], which stops at `level` [DN without black level]."""
    return np.minimum(signal_dn, level)


def stop_at(signal_dn, level_dn):
    """Return the signal [DN], which stops at the level of each pixel [DN]."""
    return np.minimum(signal_dn, level_dn)


def stop_softly(signal_dn, *, level, knee):
    """Return x − w ln[(1 + exp(x/w − 1/knee))/(1 + exp(−1/knee))] with w = level/ln(1 + exp(1/knee)).

    It tends to the level, over a width of about `knee` times the level. Its slope at 0 is 1/(1 + exp(−1/knee)).
    """
    width = level / np.logaddexp(0.0, 1 / knee)
    bent = np.logaddexp(0.0, signal_dn / width - 1 / knee) - np.log1p(np.exp(-1 / knee))
    return np.where(signal_dn > 0, signal_dn - width * bent, signal_dn)


def stop_by_power(signal_dn, *, level, knee):
    """Return (x^−m + level^−m)^(−1/m) with m = 1/knee."""
    ratio = np.log(np.maximum(signal_dn, 1e-9) / level)
    return np.where(signal_dn > 1e-9, level * np.exp(ratio - knee * np.logaddexp(0.0, ratio / knee)), signal_dn)


def draw_levels(rng, shape, *, level, scatter):
    """Return the level [rows, columns] of each pixel [DN], normal with the relative deviation `scatter`."""
    return level * np.maximum(1 + scatter * rng.standard_normal(shape), 0.0)


def average_levels(*, level, scatter):
    """Return levels [DN] and their shares: the cells of a uniform grid, which follows the kink from level to level."""
    step = 2 * LEVELS_REACH_TO / (LEVELS - 1)
    deviation = step * (np.arange(LEVELS) - (LEVELS - 1) / 2)
    share = ndtr(deviation + step / 2) - ndtr(deviation - step / 2)
    return level * np.maximum(1 + scatter * deviation, 0.0), share / share.sum()


def state_end(sensor, variant, *, level, knee, scatter):
    """Return the full well, or the reading at which the converter stops; no key describes a knee or a scatter."""
    if variant is Variant.SHARP:
        return {"sensor.full_well_e": level / sensor.gain_dn_per_e}
    return {"sensor.full_scale_dn": sensor.black_level_dn + level} if variant is Variant.SHARP_WITH_NOISE else {}


EFFECT = Effect(
    number=1,
    name="saturation",
    sentence="the signal stops at a level, below the converter's full scale",
    noun="clip",
    parameters=(
        Parameter("level", "DN", lambda scales: 0.02 * scales.peak_dn, lambda scales: 3 * scales.full_scale_dn),
        Parameter("knee", "1", 0.002, 1.0, is_variant_specific=True),
        Parameter("scatter", "1", 0.001, 0.3, is_variant_specific=True),
    ),
    variants={
        Variant.SHARP: (Step(Stage.WELL, stop),),
        Variant.SOFT: (Step(Stage.WELL, stop_softly),),
        Variant.POWER: (Step(Stage.WELL, stop_by_power),),
        Variant.SHARP_SCATTERED: (RandomStep(Stage.WELL, stop_at, Scope.SENSOR, draw_levels, average_levels),),
        Variant.SHARP_WITH_NOISE: (Step(Stage.RESPONSE, stop, rounded="level"),),
        Variant.SOFT_WITH_NOISE: (Step(Stage.RESPONSE, stop_softly),),
        Variant.POWER_WITH_NOISE: (Step(Stage.RESPONSE, stop_by_power),),
    },
    # A clip behind all noise lies at the brightest reading; a fit from below it does not find it.
    starts=lambda scales: [(share * scales.peak_dn, 0.03, 0.02) for share in (0.97, 1.0, 0.8, 0.5)],
    vanishes_at=np.inf,
    hidden_in_flats="",
    instrument_keys=state_end,
)
