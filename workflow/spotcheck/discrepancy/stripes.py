"""Stripes: the highest peak in the spectrum that the exposures of each site share."""

from typing import NamedTuple

import numpy as np
from scipy import fft
from scipy.optimize import minimize

from spotcheck.discrepancy.measure import Measured

# Frequencies below this part of the light's own are the spot's [cycles per width of the light].
LOWEST = 0.25


class Stripes(NamedTuple):
    """Depth [1], period [px], direction [deg] across the stripes."""

    depth: float
    period: float
    direction: float


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
    frequency = float(np.hypot(*best.x))
    period, direction = 1 / max(frequency, 1e-3), float(np.degrees(np.arctan2(best.x[1], best.x[0]))) % 180
    found, noise = beside_places(measured, period, direction)
    return Stripes(depth_of(np.abs(found) ** 2, noise), period, direction)


def depth_of(square: np.ndarray, noise: np.ndarray) -> float:
    """Depth of stripes of which each site tells the square of its own amplitude [site]: root of the mean, less what is
    noise [site]."""
    return float(np.sqrt(max(np.mean(square - noise), 1e-8)))


def depth_error(depth: float, noise: np.ndarray) -> float:
    """Standard error of such a depth."""
    return float(np.sqrt(np.sum(2 * depth**2 * noise + noise**2)) / len(noise) / (2 * depth))


def beside_places(measured: Measured, period: float, direction: float) -> tuple[np.ndarray, np.ndarray]:
    """Complex amplitude [site] of stripes of a period [px] and direction [deg] beside a displacement of the site's
    spot, which would take up a part of long ones; and the mean square of each that is noise alone."""
    pull, weight = measured.sums.pull, measured.sums.weight
    rows, columns = pull.shape[1:]
    y, x = np.mgrid[:rows, :columns].astype(np.float32)
    across = np.deg2rad(direction)
    phase = 2 * np.pi / period * (np.cos(across) * x + np.sin(across) * y)
    # About the middle of the light, which the sites' windows share; where nothing tells anything, about a corner.
    light = weight.sum(axis=0, dtype=float)
    middle = [float((light * axis).sum() / max(light.sum(), 1e-300)) for axis in (x, y)]
    terms = np.stack([np.cos(phase), np.sin(phase), x - middle[0], y - middle[1]]).reshape(4, -1)
    found, noise = np.zeros(len(pull), complex), np.zeros(len(pull))
    for k, (own, heavy) in enumerate(zip(pull, weight, strict=True)):
        normal = ((terms * heavy.ravel()) @ terms.T).astype(float)
        covariance = np.linalg.pinv(normal, hermitian=True)
        cosine, sine = (covariance @ (terms @ own.ravel()))[:2]
        found[k], noise[k] = complex(cosine, -sine), covariance[0, 0] + covariance[1, 1]
    return found, noise


def amplitudes(measured: Measured, kx: float, ky: float) -> np.ndarray:
    """Complex amplitude [site] of stripes at a frequency [cycles/px], as 2 Σ pull e^(−2πi k·r)/Σ weight."""
    pull, weight = measured.sums.pull, measured.sums.weight
    across = np.exp(-2j * np.pi * kx * np.arange(pull.shape[2])).astype(np.complex64)
    along = np.exp(-2j * np.pi * ky * np.arange(pull.shape[1])).astype(np.complex64)
    return 2 * np.einsum("j,sj->s", along, pull @ across) / weight.sum(axis=(1, 2), dtype=float)
