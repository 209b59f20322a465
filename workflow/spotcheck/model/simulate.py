"""Random frames of the baseline, and the expected maximum of one."""

import numpy as np
from scipy.special import log_ndtr

from spotcheck.model.sensor import SensorModel, draw, reading


def frame_generators(seed: int, count: int) -> list[np.random.Generator]:
    """One independent generator a frame, from one seed: equal frames whatever the order or number of cores."""
    return [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(count)]


def frame(light_dn: np.ndarray, exposure_s: float, sensor: SensorModel, rng: np.random.Generator) -> np.ndarray:
    """One random frame [rows, columns] in DN under a mean light [DN]."""
    return draw(light_dn, exposure_s, sensor, rng)


def expected_maximum(light_dn: np.ndarray, exposure_s: float, sensor: SensorModel) -> float:
    """E[max over pixels] in DN of the reading: E[max] = ∫ (1 − Π_k F_k(z)) dz for independent, nearly normal pixels.

    The maximum of a plateau of n pixels lies about σ √(2 ln n) above its mean: for the paper's spot, 28 DN.
    """
    moments = reading(np.ravel(light_dn), exposure_s, sensor)
    sd = np.sqrt(moments.variance)
    top = moments.mean + 8 * sd
    # A pixel that is 8 sd below another's mean has no say in the maximum.
    keep = top >= np.max(moments.mean)
    mean, sd = moments.mean[keep], np.maximum(sd[keep], 1e-6)
    low, high = float(np.max(mean - 8 * sd)), float(min(np.max(mean + 8 * sd), sensor.full_scale_dn))
    z = np.linspace(low, high, 400)
    log_below = np.array([log_ndtr((value - mean) / sd).sum() for value in z])
    return low + float(np.trapezoid(-np.expm1(log_below), z))
