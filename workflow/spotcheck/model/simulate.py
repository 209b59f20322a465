"""Random frames of the baseline, and the expected maximum of one."""

from collections.abc import Iterable, Iterator

import numpy as np
from scipy.special import log_ndtr

from spotcheck.model.draws import draw_readings
from spotcheck.model.sensor import SensorModel, reading


def frame_generators(seed: int, count: int) -> list[np.random.Generator]:
    """One independent generator a frame, from one seed: equal frames whatever the order or number of cores."""
    return [np.random.Generator(np.random.SFC64(child)) for child in np.random.SeedSequence(seed).spawn(count)]


def frames(
    light_dn: Iterable[np.ndarray],
    exposure_s: float,
    sensor: SensorModel,
    generators: Iterable[np.random.Generator],
) -> Iterator[np.ndarray]:
    """Random frames [rows, columns] in DN (uint16), one for each mean light [rows, columns] in DN and generator; ends
    with the shorter of the two.

    The whole chain (Eq. 23: H = S + B + W) with its exact law; one frame at a time is in memory.

    # ASSUME: µ_d of Eq. 16 is a count (dark current times exposure); the paper gives it in e-/s.
    """
    dark_e = sensor.dark_current_e_per_s * exposure_s
    for light, rng in zip(light_dn, generators, strict=False):
        mean = np.ascontiguousarray(light, dtype=float)
        readings = np.empty(mean.shape, np.uint16)
        draw_readings(mean.reshape(-1), dark_e, sensor, rng, readings.reshape(-1))
        yield readings


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
