"""Speckle: a granular field, the same at every exposure of a site, new at each site."""

import numpy as np
from scipy import ndimage

from spotcheck.old_engine.model.effect import Effect, Parameter, Place, Scatter

# More patterns than these make the field normal.
MOST_PATTERNS = 12


def field(shape, rng, *, contrast, grain):
    """Factor [rows, columns] of mean 1 and relative scatter `contrast`, correlated as exp(−d²/2 grain²).

    # ASSUME: `grain` [px] is the standard deviation of the correlation; contracts and books also call the full width
    # so. Intensities follow a gamma law, as sums of independent speckle patterns do.
    """
    if contrast <= 0:
        return np.ones(shape)
    total = np.zeros(shape)
    for _ in range(min(max(round(1 / contrast**2), 1), MOST_PATTERNS)):
        # A field smoothed with s correlates as exp(−d²/4 s²), its intensity as the square of that: s is the grain.
        parts = [ndimage.gaussian_filter(rng.standard_normal(shape), grain, mode="wrap") for _ in range(2)]
        total += sum(part**2 / np.mean(part**2) for part in parts) / 2
    deviation = total / total.mean() - 1
    return np.maximum(1 + deviation * contrast / max(deviation.std(), 1e-12), 0.0)


EFFECT = Effect(
    number=17,
    name="speckle",
    sentence="a granular field modulates the spot, new at each site",
    noun="contrast of grain",
    place=Place.SCATTER,
    parameters=(
        Parameter("contrast", "1", 0.0, 1.0),
        Parameter("grain", "px", 0.2, lambda c: c.sigma_px),
    ),
    starts=lambda c: [(0.05, 2.0)],
    function=field,
    negligible=0.01,
    scatter=Scatter("field", "site", "grain"),
    # Its intensities are skewed and have a long tail.
    marks=("skewness", "outliers"),
)
