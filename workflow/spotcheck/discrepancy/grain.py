"""What a granular field may be: how coarse, and how far it strays in any one place."""

import numpy as np
from scipy import stats

from spotcheck.discrepancy.measure import Measured

# Grains [px] among which a granular field's is sought, then refined between these parts of the best.
GRAINS, REFINED = np.geomspace(0.5, 14.0, 12), (0.85, 1.18)
# A field coarser than this part of σ_g is not granular: it makes the whole spot brighter, or moves it.
COARSEST = 0.5
# From this part of the coarsest on, a grain is at its end.
EDGE = 0.975
# A field strays in some place by what it does there once in so many sets, or it is no granular field.
ONCE_IN = 1e6


def grains_of(sigma_px: float) -> np.ndarray:
    """Grains [px] that a field on a spot of σ_g may have."""
    return GRAINS[GRAINS <= max(COARSEST * sigma_px, GRAINS[0])]


def at_its_coarsest(grain: float, sigma_px: float) -> bool:
    """Whether a field would be coarser than granular ones are, if it could."""
    return grain > EDGE * REFINED[1] * grains_of(sigma_px)[-1]


def strays(measured: Measured, contrast: float) -> bool:
    """Whether the field that exposures of a site share has a place that a granular field of that contrast has not: a
    speck of dust is no speckle.

    Intensities have no long tail below, and above none longer than that of one fully developed pattern, which is
    exponential (Goodman, Speckle Phenomena in Optics, 2nd ed., sec. 3.2).
    """
    pull, weight = (np.asarray(v, float) for v in (measured.sums.pull, measured.sums.weight))
    lit = weight > 0
    z = pull[lit] / np.sqrt(weight[lit] + (contrast * weight[lit]) ** 2)
    if not z.size:
        return False
    rare = min(stats.norm.sf(-z.min()), np.exp(-1 - z.max()))
    return bool(rare * z.size * ONCE_IN < 1)
