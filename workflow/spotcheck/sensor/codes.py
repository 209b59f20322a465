"""Probability of each code under Poisson electrons, compiled, and the cumulants that follow from it.

A code is a whole reading in DN. Arrays have an axis of mean numbers of electrons, [mean], and one of codes, [code].
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
    """Probability of the codes from `first_code` on at each of some mean numbers of electrons.

    All codes that occur are included, so that each row of `probability` sums to 1.
    """

    first_code: int  # code of the first column [DN]
    probability: np.ndarray  # probability of each code [mean, code]
    slope: np.ndarray  # derivative of the probability by the mean number of electrons [mean, code] in 1/e-

    @property
    def codes(self) -> np.ndarray:
        """Code of each column [code] in DN."""
        return self.first_code + np.arange(self.probability.shape[1])

    def score(self) -> np.ndarray:
        """Return the score ∂ ln P/∂ν [mean, code] in 1/e-, where ν are the mean electrons.

        It is NaN where P is 0 or too small for the ratio.
        """
        is_possible = self.probability > 1e-300
        return np.where(is_possible, self.slope, np.nan) / np.where(is_possible, self.probability, 1.0)

    def cumulants(self, gain_dn_per_e: float = 1.0) -> Cumulants:
        """Return the cumulants of readings at each mean.

        `gain_dn_per_e` converts slopes by electrons to slopes by the light [DN]; with 1 they are by electrons.
        """
        mean = self.probability @ self.codes
        deviation = self.codes - mean[:, None]
        square = deviation**2
        powers = square, square * deviation, square**2
        variance, third, fourth = ((self.probability * power).sum(axis=1) for power in powers)
        mean_slope, variance_slope = ((self.slope * power).sum(axis=1) / gain_dn_per_e for power in (deviation, square))
        information = np.nansum(self.slope * self.score(), axis=1) / gain_dn_per_e**2
        return Cumulants(mean, variance, third, fourth - 3 * variance**2, mean_slope, variance_slope, information)


@compiled
def find_possible_counts(mean_e):
    """Return the lowest and the highest number of electrons that a Poisson distribution of one mean [e-] can give.

    Numbers beyond `NOISE_SD` standard deviations and `POISSON_MARGIN` are left out.
    """
    half_width = NOISE_SD * math.sqrt(mean_e) + POISSON_MARGIN
    return max(math.floor(mean_e - half_width), 0), math.ceil(mean_e + half_width)


def integrate_read_noise(signal: np.ndarray, noise_sd: float, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest code that each signal can give with read noise, and the probabilities of the codes from it on.

    Codes are counted from 0 here: code k has signals plus noise from `edges[k − 1]` to `edges[k]`, and code len(edges)
    has no upper end.

    Parameters
    ----------
    signal : signals without read noise [signal] in DN.
    noise_sd : standard deviation of the Gaussian read noise [DN], above 0.
    edges : upper ends of the codes [code] in DN, increasing.

    Returns
    -------
    first : array [signal]
        Lowest code.
    probability : array [signal, code]
        Probabilities of the codes from the lowest one on. Each row sums to 1.
    """
    first = np.searchsorted(edges, signal - NOISE_SD * noise_sd)
    last = np.searchsorted(edges, signal + NOISE_SD * noise_sd)
    code_count = int(np.max(last - first)) + 1
    padded_edges = np.concatenate([edges, np.full(code_count, np.inf)])
    # Distance of the upper end of each code from the signal, in standard deviations [signal, code].
    distance = (padded_edges[first[:, None] + np.arange(code_count)] - signal[:, None]) / noise_sd
    below, above = ndtr(distance), ndtr(-distance)
    # Differences of the smaller tail keep the digits of small probabilities.
    inner = np.where(distance[:, 1:] < 0, below[:, 1:] - below[:, :-1], above[:, :-1] - above[:, 1:])
    return first, np.concatenate([below[:, :1], inner], axis=1)


@compiled
def sum_over_electrons(mean_e, lowest_count, first, band, first_code, probability, slope):
    """Add, for each code, the Poisson-weighted sum over electrons to `probability`, and its derivative to `slope`.

    Parameters
    ----------
    mean_e : means of the Poisson distribution [mean] in e-, at least 0.
    lowest_count : number of electrons of the first row of `first` and `band`.
    first : code of the first column of `band` for each number of electrons [count].
    band : probabilities of the codes from `first` on, given the number of electrons [count, code].
    first_code : code of the first column of the results.
    probability, slope : results [mean, code], which are added to; the slope is by the mean, in 1/e-.
    """
    for i in range(mean_e.size):
        mean = mean_e[i]
        low, high = find_possible_counts(mean)
        # Poisson probability of `count`; its derivative by the mean is that of one electron less minus it.
        weight = math.exp((low * math.log(mean) if low > 0 else 0.0) - mean - math.lgamma(low + 1.0))
        previous_weight = 0.0
        for count in range(low, high + 1):
            row = count - lowest_count
            weight_slope = previous_weight - weight
            column = first[row] - first_code
            for j in range(band.shape[1]):
                probability[i, column + j] += weight * band[row, j]
                slope[i, column + j] += weight_slope * band[row, j]
            previous_weight = weight
            weight *= mean / (count + 1.0)
