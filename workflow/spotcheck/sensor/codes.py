"""Probability of each code under Poisson electrons, compiled, and the cumulants that follow from it.

Arrays have an axis of mean numbers of electrons, [mean], and one of codes, [code].
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.special import ndtr

# For all compiled functions of the package.
compiled = njit(cache=True, nogil=True, error_model="numpy")

# Largest reading [DN] of the 16-bit integers that images are stored in.
LARGEST_READING = 65535
# More electrons than any converter reads [e-], where every clip has set in; Poisson draws of larger means overflow.
MOST_ELECTRONS = 1e12
# Standard deviations beyond which Poisson and Gaussian noise are left out: a probability of 1e-17.
NOISE_SD = 8.5
# Electrons beyond that distance, for means near 0, where the Poisson distribution is skewed.
POISSON_MARGIN = 14


class Cumulants(NamedTuple):
    """Cumulants of a reading and what follows from them, each [mean]; slopes are by the light."""

    mean: np.ndarray  # [DN]
    variance: np.ndarray  # [DN²]
    third: np.ndarray  # third cumulant [DN³]
    fourth: np.ndarray  # fourth cumulant [DN⁴]
    mean_slope: np.ndarray  # d mean/dL [1]
    variance_slope: np.ndarray  # d variance/dL [DN]
    information: np.ndarray  # Fisher information on the light [1/DN²]


class CodeProbabilities(NamedTuple):
    """Probability of the codes [DN] from `first_code` on at each of some mean numbers of electrons.

    All codes that occur are included, so that each row of `probability` sums to 1.
    """

    first_code: int
    probability: np.ndarray  # [mean, code]
    slope: np.ndarray  # derivative of the probability by the mean number of electrons [mean, code, 1/e-]

    @property
    def codes(self) -> np.ndarray:
        """Codes [DN] of the columns."""
        return self.first_code + np.arange(self.probability.shape[1])

    def score(self) -> np.ndarray:
        """Return ∂ ln P/∂ν by the mean electrons ν [mean, code, 1/e-]; NaN where P is 0 or too small for the ratio."""
        is_possible = self.probability > 1e-300
        return np.where(is_possible, self.slope, np.nan) / np.where(is_possible, self.probability, 1.0)

    def cumulants(self, gain_dn_per_e: float = 1.0) -> Cumulants:
        """Return the cumulants of readings at each mean; the gain turns slopes by electrons into those by the light."""
        mean = self.probability @ self.codes
        deviation = self.codes - mean[:, None]
        square = deviation**2
        powers = square, square * deviation, square**2
        second, third, fourth = ((self.probability * power).sum(axis=1) for power in powers)
        mean_slope, variance_slope = ((self.slope * power).sum(axis=1) / gain_dn_per_e for power in (deviation, square))
        information = np.nansum(self.slope * self.score(), axis=1) / gain_dn_per_e**2
        return Cumulants(mean, second, third, fourth - 3 * second**2, mean_slope, variance_slope, information)


@compiled
def find_possible_counts(mean_e):
    """Return the lowest and the highest number of electrons that a Poisson mean [e-] gives."""
    half_width = NOISE_SD * math.sqrt(mean_e) + POISSON_MARGIN
    return max(math.floor(mean_e - half_width), 0), math.ceil(mean_e + half_width)


def integrate_read_noise(signal: np.ndarray, noise: float, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first code of each signal [signal] and the probability of the codes from it on [signal, code].

    A code is at most k if signal plus noise lie below `edges[k]` [DN], increasing, and at most len(edges) in any case.
    `noise` is the standard deviation of the Gaussian read noise [DN], above 0.
    """
    first = np.searchsorted(edges, signal - NOISE_SD * noise)
    last = np.searchsorted(edges, signal + NOISE_SD * noise)
    width = int(np.max(last - first)) + 1
    padded = np.concatenate([edges, np.full(width, np.inf)])
    distance = (padded[first[:, None] + np.arange(width)] - signal[:, None]) / noise
    below, above = ndtr(distance), ndtr(-distance)
    # Differences of the smaller tail keep the digits of small probabilities.
    inner = np.where(distance[:, 1:] < 0, below[:, 1:] - below[:, :-1], above[:, :-1] - above[:, 1:])
    return first, np.concatenate([below[:, :1], inner], axis=1)


@compiled
def sum_over_electrons(mean_e, lowest_count, first, band, first_code, probability, slope):
    """Fill the probability of each code and its slope by the mean, both [mean, code] and 0 before.

    mean_e [mean, e-], at least 0; `first` and `band` say for each number of electrons from `lowest_count` on which
    code is the first and how probable the codes from it on are; columns start at `first_code`.
    """
    for i in range(mean_e.size):
        mean = mean_e[i]
        low, high = find_possible_counts(mean)
        weight = math.exp((low * math.log(mean) if low > 0 else 0.0) - mean - math.lgamma(low + 1.0))
        before = 0.0
        for count in range(low, high + 1):
            row = count - lowest_count
            rise = before - weight
            column = first[row] - first_code
            for j in range(band.shape[1]):
                probability[i, column + j] += weight * band[row, j]
                slope[i, column + j] += rise * band[row, j]
            before = weight
            weight *= mean / (count + 1.0)
