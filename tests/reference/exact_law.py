"""The law of one reading as a plain sum over electrons: what tables, moments and random draws must match."""

import numpy as np
from scipy.special import ndtr
from scipy.stats import poisson

from spotcheck.sensor import SensorModel


def reading_law(electrons: float, sensor: SensorModel) -> np.ndarray:
    """Probability of every reading 0 … full scale for a mean number of electrons; below 0 the signal is certain."""
    top = int(min(sensor.full_scale_dn, 65535))
    if electrons < 0:
        counts, weight = np.array([electrons]), np.ones(1)
    else:
        reach = 10 * np.sqrt(electrons)
        counts = np.arange(max(0, int(electrons - reach - 15)), int(electrons + reach + 30))
        weight = poisson.pmf(counts, electrons)
    signal = sensor.gain_dn_per_e * np.minimum(counts, sensor.full_well_e) + sensor.black_level_dn
    if sensor.read_noise_e == 0:
        return np.bincount(np.clip(np.rint(signal), 0, top).astype(int), weight, top + 1)
    spread = sensor.gain_dn_per_e * sensor.read_noise_e
    # P(reading ≤ y) at the edges y + 1/2; ten read noises off the signals it is 0 or 1.
    low, high = np.clip([signal.min() - 10 * spread - 1, signal.max() + 10 * spread + 1], 0, top).astype(int)
    below = np.zeros(top)
    below[high:] = 1.0
    for start in range(low, high, 256):
        y = np.arange(start, min(start + 256, high))
        below[y] = ndtr((y[:, None] + 0.5 - signal) / spread) @ weight
    return np.diff(below, prepend=0.0, append=1.0)


def moments(probability: np.ndarray) -> tuple[float, float, float]:
    """Mean, variance and kurtosis of readings 0, 1, 2 …"""
    k = np.arange(probability.size)
    mean = float(k @ probability)
    variance, fourth = (float((k - mean) ** p @ probability) for p in (2, 4))
    return mean, variance, fourth / variance**2 if variance else 3.0
