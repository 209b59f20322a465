"""Speckle: a granular random field multiplies the light; frames of a site share it."""

from enum import Enum

import numpy as np
from scipy import ndimage

from spotcheck.model.effect import Effect, Parameter, RandomStep, Scope, Stage, multiply
from spotcheck.sensor.table import grain_quadrature, partial_grain_quadrature

# Largest number of independent speckle patterns that are summed; a sum of more is close to normal.
MOST_PATTERNS = 12
# Least standard deviation of a field by which it is divided.
LEAST_DEVIATION = 1e-12


class Grains(Enum):
    """Distribution of the light of a pixel: gamma, or gamma plus a constant floor.

    A pixel that averages over parts of several grains is seldom dark, which the floor describes better.
    """

    FULL = ""
    PARTIAL = "over a floor"


def draw_field(rng, shape, *, contrast, grain):
    """Return a random factor [row, column] with mean 1 and standard deviation `contrast` [1].

    The correlation of two pixels at a distance d is exp(−d²/(2 `grain`²)), with the grain in px. `shape` is (rows,
    columns). Values are never below 0, so a high contrast is not reached exactly.
    """
    if contrast <= 0:
        return np.ones(shape)
    total = np.zeros(shape)
    # ASSUME: intensities follow a gamma distribution, as sums of independent speckle patterns do.
    for _ in range(min(max(round(1 / contrast**2), 1), MOST_PATTERNS)):
        # Real and imaginary part of the field of the light. White noise that is smoothed by a Gaussian of deviation s
        # has the correlation exp(−d²/(4 s²)). Its intensity has the square of that, so s is the grain. ASSUME: the
        # grain [px] is the standard deviation of the correlation; elsewhere it may be the full width.
        amplitudes = [ndimage.gaussian_filter(rng.standard_normal(shape), grain, mode="wrap") for _ in range(2)]
        total += sum(amplitude**2 / np.mean(amplitude**2) for amplitude in amplitudes) / 2
    # Scaled to the contrast exactly, which a whole number of patterns gives only roughly.
    deviation = total / total.mean() - 1
    return np.maximum(1 + deviation * contrast / max(deviation.std(), LEAST_DEVIATION), 0.0)


def draw_partial_field(rng, shape, *, contrast, grain, floor):
    """Return a random factor as `draw_field` does, of which the part `floor` [1] is the same in all pixels."""
    # The rest has a higher contrast, so that the sum has `contrast`.
    return floor + (1 - floor) * draw_field(rng, shape, contrast=contrast / (1 - floor), grain=grain)


EFFECT = Effect(
    number=17,
    name="speckle",
    sentence="a granular field modulates the spot, new at each site",
    noun="contrast of grain",
    parameters=(
        Parameter("contrast", "1", 0.0, 1.0, negligible=0.01),
        Parameter("grain", "px", 0.2, lambda scales: scales.sigma_px),
        Parameter("floor", "1", 0.0, 0.9, is_variant_specific=True),
    ),
    variants={
        Grains.FULL: (RandomStep(Stage.SPECKLE_FIELD, multiply, Scope.SITE, draw_field, grain_quadrature),),
        Grains.PARTIAL: (
            RandomStep(Stage.SPECKLE_FIELD, multiply, Scope.SITE, draw_partial_field, partial_grain_quadrature),
        ),
    },
    starts=lambda scales: [(0.05, 2.0, 0.1)],
    reference="Goodman, Speckle Phenomena in Optics, 2nd ed., Section 3.3",
    acts_on_noise=True,
)
