"""Speckle: a granular field, the same at every exposure of a site, new at each site."""

from enum import Enum

import numpy as np
from scipy import ndimage

from spotcheck.model.effect import Effect, Parameter, RandomStep, Scope, Stage, multiply
from spotcheck.sensor.table import grain_quadrature, partial_grain_quadrature

# More patterns than these make the field normal.
MOST_PATTERNS = 12


class Grains(Enum):
    """Variants: what a pixel receives follows a gamma distribution, or does so beside light that is in every pixel.

    A pixel that averages over part of a grain is seldom dark: the second comes nearer to it.
    """

    FULL = ""
    PARTIAL = "over a floor"


def draw_field(rng, shape, *, contrast, grain):
    """Return a factor [rows, columns] of mean 1 and relative scatter `contrast`, correlated as exp(−d²/2 grain²)."""
    if contrast <= 0:
        return np.ones(shape)
    total = np.zeros(shape)
    # ASSUME: intensities follow a gamma distribution, as sums of independent speckle patterns do.
    for _ in range(min(max(round(1 / contrast**2), 1), MOST_PATTERNS)):
        # A field smoothed with s correlates as exp(−d²/4 s²), its intensity as the square of that: s is the grain.
        # ASSUME: the grain [px] is the standard deviation of the correlation; contracts and books also call the full
        # width so.
        parts = [ndimage.gaussian_filter(rng.standard_normal(shape), grain, mode="wrap") for _ in range(2)]
        total += sum(part**2 / np.mean(part**2) for part in parts) / 2
    deviation = total / total.mean() - 1
    return np.maximum(1 + deviation * contrast / max(deviation.std(), 1e-12), 0.0)


def draw_partial_field(rng, shape, *, contrast, grain, floor):
    """Return a field as `draw_field` does, of which a part, the floor, is the same in all pixels."""
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
