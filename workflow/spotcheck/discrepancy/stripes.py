"""Stripes: the highest peak in the spectrum that the exposures of each site share."""

from typing import NamedTuple

import numpy as np
from scipy import fft
from scipy.optimize import minimize

from spotcheck.discrepancy.measure import Measured

# Frequencies below this part of the light's own are the spot's [cycles per width of the light].
LOWEST = 0.25


class Stripes(NamedTuple):
    """Depth [1], period [px], direction [deg] across the stripes, and the complex amplitude of each site about its own
    window's corner [site]."""

    depth: float
    period: float
    direction: float
    amplitude: np.ndarray


def peak(measured: Measured) -> Stripes:
    """The strongest stripes of any phase: depths of all sites add in power, so that a phase anew at each site does not
    matter."""
    pull, weight = measured.sums.pull, measured.sums.weight
    rows, columns = pull.shape[1:]
    power = np.zeros((rows, columns // 2 + 1))
    for own in pull:
        power += np.abs(fft.rfft2(own)) ** 2
    ky, kx = fft.fftfreq(rows)[:, None], fft.rfftfreq(columns)[None, :]
    total = weight.sum(axis=0, dtype=float)
    x = np.arange(columns)
    mass = total.sum()
    middle = (total.sum(axis=0) @ x) / mass
    width = np.sqrt(max((total.sum(axis=0) @ (x - middle) ** 2) / mass, 1.0))
    radius = np.hypot(kx, ky)
    power[(radius < LOWEST / width) | (radius > 0.5)] = 0
    j, i = np.unravel_index(np.argmax(power), power.shape)
    start = np.array([kx[0, i], ky[j, 0]])

    def minus(k: np.ndarray) -> float:
        return -float((np.abs(amplitudes(measured, k[0], k[1])) ** 2 * (weight.sum(axis=(1, 2)))).sum())

    best = minimize(minus, start, method="Nelder-Mead",
                    options={"initial_simplex": start + 0.5 / columns * np.array([[0, 0], [1, 0], [0, 1]]),
                             "xatol": 1e-6, "fatol": 1e-6})  # fmt: skip
    found = amplitudes(measured, *best.x)
    noise = 4 / weight.sum(axis=(1, 2), dtype=float)
    depth = float(np.sqrt(max(np.mean(np.abs(found) ** 2 - noise), 1e-8)))
    frequency = float(np.hypot(*best.x))
    return Stripes(depth, 1 / max(frequency, 1e-3), float(np.degrees(np.arctan2(best.x[1], best.x[0]))) % 180, found)


def amplitudes(measured: Measured, kx: float, ky: float) -> np.ndarray:
    """Complex amplitude [site] of stripes at a frequency [cycles/px], as 2 Σ pull e^(−2πi k·r)/Σ weight."""
    pull, weight = measured.sums.pull, measured.sums.weight
    across = np.exp(-2j * np.pi * kx * np.arange(pull.shape[2])).astype(np.complex64)
    along = np.exp(-2j * np.pi * ky * np.arange(pull.shape[1])).astype(np.complex64)
    return 2 * np.einsum("j,sj->s", along, pull @ across) / weight.sum(axis=(1, 2), dtype=float)
