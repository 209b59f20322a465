"""Saturation: the signal is limited to a level, by the full well or by the converter.

Signals and levels are in DN without black level.
"""

from enum import Enum

import numpy as np
from scipy.special import ndtr

from spotcheck.model.effect import Effect, Parameter, RandomStep, Scope, Stage, Step

# Quadrature over levels that scatter from pixel to pixel: number of nodes, and half their range [standard deviations].
LEVEL_COUNT, HALF_RANGE = 61, 5.0
# Signals [DN] up to which the limit is not applied, where its logarithm would be infinite.
LEAST_SIGNAL_DN = 1e-9


class Variant(Enum):
    """Place and shape of the limit: a well in front of the read noise, or a converter behind it ("with noise")."""

    SHARP = "sharp"
    SOFT = "soft"
    POWER = "power"
    SHARP_SCATTERED = "sharp scattered"
    SHARP_WITH_NOISE = "sharp with noise"
    SOFT_WITH_NOISE = "soft with noise"
    POWER_WITH_NOISE = "power with noise"


def limit(signal_dn, *, level):
    """Return the signal [DN], limited to `level` [DN]."""
    return np.minimum(signal_dn, level)


def limit_to_drawn_level(signal_dn, level_dn):
    """Return the signal [DN], limited to the drawn level of each pixel [DN]."""
    return np.minimum(signal_dn, level_dn)


def limit_softly(signal_dn, *, level, knee):
    """Return x − w ln[(1 + exp(x/w − 1/`knee`))/(1 + exp(−1/`knee`))] [DN] with w = `level`/ln(1 + exp(1/`knee`)).

    x is the signal [DN]. The result tends to `level` [DN] with a knee that is about `knee` [1] times the level wide.
    Its slope at 0 is 1/(1 + exp(−1/knee)).
    """
    width = level / np.logaddexp(0.0, 1 / knee)
    reduction = np.logaddexp(0.0, signal_dn / width - 1 / knee) - np.log1p(np.exp(-1 / knee))
    # Negative signals, which are noise, stay as they are.
    return np.where(signal_dn > 0, signal_dn - width * reduction, signal_dn)


def limit_by_power(signal_dn, *, level, knee):
    """Return (x^−m + `level`^−m)^(−1/m) [DN] with m = 1/`knee` for a signal x [DN]; it tends to `level` [DN].

    Signals up to `LEAST_SIGNAL_DN` stay as they are.
    """
    # In logarithms, as powers of a small knee overflow: ln(limited/level) = ln r − knee ln(1 + r^m) with r = x/level.
    log_ratio = np.log(np.maximum(signal_dn, LEAST_SIGNAL_DN) / level)
    limited = level * np.exp(log_ratio - knee * np.logaddexp(0.0, log_ratio / knee))
    return np.where(signal_dn > LEAST_SIGNAL_DN, limited, signal_dn)


def draw_levels(rng, shape, *, level, scatter):
    """Return random levels [row, column] in DN: normal with mean `level` and relative deviation `scatter` [1].

    `shape` is (rows, columns). Levels are never below 0.
    """
    return level * np.maximum(1 + scatter * rng.standard_normal(shape), 0.0)


def make_level_quadrature(*, level, scatter):
    """Return levels [node] in DN and weights [node], which sum to 1, for averages over the levels of `draw_levels`."""
    # Nodes are the centres of the cells of a uniform grid, weights their probabilities. Limiting has a kink at the
    # level, which the few nodes of a Gauss–Hermite quadrature would turn into visible steps.
    step = 2 * HALF_RANGE / (LEVEL_COUNT - 1)
    deviation = step * (np.arange(LEVEL_COUNT) - (LEVEL_COUNT - 1) / 2)
    probability = ndtr(deviation + step / 2) - ndtr(deviation - step / 2)
    return level * np.maximum(1 + scatter * deviation, 0.0), probability / probability.sum()


def find_instrument_keys(sensor, variant, *, level, knee, scatter):
    """Return the key of instrument.yaml, with its value, that does the same: full well [e-], or full scale [DN].

    `sensor` is a `SensorModel`. {} for variants with `knee` or `scatter`, which no key describes.
    """
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
        # A wider knee is a bend of the whole response.
        Parameter("knee", "1", 0.002, 0.25, is_variant_specific=True),
        Parameter("scatter", "1", 0.001, 0.3, is_variant_specific=True),
    ),
    variants={
        Variant.SHARP: (Step(Stage.WELL, limit),),
        Variant.SOFT: (Step(Stage.WELL, limit_softly),),
        Variant.POWER: (Step(Stage.WELL, limit_by_power),),
        Variant.SHARP_SCATTERED: (
            RandomStep(Stage.WELL, limit_to_drawn_level, Scope.SENSOR, draw_levels, make_level_quadrature),
        ),
        Variant.SHARP_WITH_NOISE: (Step(Stage.RESPONSE, limit, rounded="level"),),
        Variant.SOFT_WITH_NOISE: (Step(Stage.RESPONSE, limit_softly),),
        Variant.POWER_WITH_NOISE: (Step(Stage.RESPONSE, limit_by_power),),
    },
    # A limit behind all noise lies at the brightest reading; a fit that starts below it does not find it. A soft limit
    # lies above the brightest reading.
    starts=lambda scales: [
        *((share * scales.peak_dn, 0.03, 0.02) for share in (0.97, 1.0, 0.8, 0.5)),
        (1.1 * scales.peak_dn, 0.08, 0.02),
    ],
    vanishes_at=np.inf,
    hidden_in_flats="",
    instrument_keys=find_instrument_keys,
)
