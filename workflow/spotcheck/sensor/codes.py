"""Probabilities of a pixel's reading given its mean number of electrons, and the cumulants of the reading.

A code is one output value of the converter: a whole number of DN (digital numbers). The number of electrons of a pixel
is Poisson distributed with the mean ν [e-]. A signal is a pixel's value before rounding [DN], without black level.

Brackets give the shape of an array: [mean] has one item for each of several ν, [code] one for each of several codes. A
band [row, code] holds probabilities of consecutive codes; the code of its first column differs from row to row.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.special import ndtr

# Decorator of all compiled functions of the package. They release the lock of the interpreter, so that threads run at
# the same time, and a division by 0 gives inf or NaN as in NumPy.
compiled = njit(cache=True, nogil=True, error_model="numpy")

# Largest reading [DN] of the 16-bit integers that images are stored in.
LARGEST_READING = 65535
# Upper limit of the mean of Poisson draws [e-], whose numbers overflow for much larger means. No converter reads so
# many electrons, so readings are saturated there.
MOST_ELECTRONS = 1e12
# Distance from the mean, in standard deviations, beyond which Poisson and Gaussian noise are neglected. The Gaussian
# probability beyond it is 1e-17 on either side, less than the rounding error of sums near 1.
NOISE_SD = 8.5
# Electrons [e-] added to that distance: for means near 0 the Poisson distribution is skewed, with a longer upper tail.
POISSON_MARGIN = 14


class Cumulants(NamedTuple):
    """Mean and variance of a reading, their derivatives and the Fisher information, each with one item per mean ν.

    Derivatives and information are with respect to the light L [DN]: the signal K ν, with the gain K [DN/e-].
    """

    mean: np.ndarray  # [DN]
    variance: np.ndarray  # [DN²]
    mean_slope: np.ndarray  # d mean/dL [1]
    variance_slope: np.ndarray  # d variance/dL [DN]
    information: np.ndarray  # Fisher information of one reading on L [1/DN²]


class CodeProbabilities(NamedTuple):
    """Probability P of each code at each of several mean numbers of electrons ν.

    The codes are consecutive from `first_code` on and include all that occur, so that each row of `probability` sums
    to 1.
    """

    first_code: int  # code of the first column [DN]
    probability: np.ndarray  # probability P of each code [mean, code]
    slope: np.ndarray  # derivative ∂P/∂ν [mean, code] in 1/e-

    @property
    def codes(self) -> np.ndarray:
        """Code of each column [code] in DN."""
        return self.first_code + np.arange(self.probability.shape[1])

    def cumulants(self, gain_dn_per_e: float = 1.0) -> Cumulants:
        """Return the cumulants of a reading at each mean ν.

        Derivatives and information are computed with respect to ν and converted to the light by the gain
        `gain_dn_per_e` [DN/e-]. With the default 1 they remain those with respect to ν: DN/e-, DN²/e- and 1/e-².
        """
        mean = self.probability @ self.codes
        deviation = self.codes - mean[:, None]
        square = deviation**2
        variance = (self.probability * square).sum(axis=1)
        # The slopes of all codes sum to 0, so that deviations from the mean may replace the codes.
        mean_slope, variance_slope = ((self.slope * power).sum(axis=1) / gain_dn_per_e for power in (deviation, square))
        # The score ∂ ln P/∂ν. It is 0 where P is 0, or so close to the smallest floating-point number that the ratio
        # has no valid digits.
        is_possible = self.probability > 1e-300
        score = np.divide(self.slope, self.probability, out=np.zeros_like(self.slope), where=is_possible)
        information = np.sum(self.slope * score, axis=1) / gain_dn_per_e**2
        return Cumulants(mean, variance, mean_slope, variance_slope, information)


@compiled
def find_possible_counts(mean_e):
    """Return the lowest and the highest number of electrons of a Poisson distribution that are not neglected.

    `mean_e` is the mean of the distribution [e-], a number of at least 0. The numbers are integers at most
    `NOISE_SD` √mean_e + `POISSON_MARGIN` from the mean.
    """
    half_width = NOISE_SD * math.sqrt(mean_e) + POISSON_MARGIN
    return max(math.floor(mean_e - half_width), 0), math.ceil(mean_e + half_width)


def integrate_read_noise(signal: np.ndarray, noise_sd: float, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the probabilities of the codes that Gaussian read noise makes of each signal, as a band.

    Codes are numbered from 0 here. Code k is read if signal plus noise lies between `edges[k − 1]` and `edges[k]`. Code
    0 has no lower end, and code len(edges) has no upper end.

    Parameters
    ----------
    signal : signals without read noise [signal] in DN.
    noise_sd : standard deviation of the read noise [DN], above 0.
    edges : signals at which codes 0, 1, 2 … end [edge] in DN, increasing.

    Returns
    -------
    first : array of int [signal]
        Number of the lowest code that each signal can give: the first column of its row of `probability`.
    probability : array [signal, code]
        Probabilities of consecutive codes from `first` on. Each row sums to 1.
    """
    first = np.searchsorted(edges, signal - NOISE_SD * noise_sd)
    last = np.searchsorted(edges, signal + NOISE_SD * noise_sd)
    code_count = int(np.max(last - first)) + 1
    padded_edges = np.concatenate([edges, np.full(code_count, np.inf)])
    # Upper ends of the codes relative to the signal, in standard deviations [signal, code].
    distance = (padded_edges[first[:, None] + np.arange(code_count)] - signal[:, None]) / noise_sd
    # Probability that signal plus noise lies below, and above, the upper end of each code.
    below, above = ndtr(distance), ndtr(-distance)
    # The probability between two ends is a difference of tails. That of the smaller tail keeps more digits.
    inner = np.where(distance[:, 1:] < 0, below[:, 1:] - below[:, :-1], above[:, :-1] - above[:, 1:])
    return first, np.concatenate([below[:, :1], inner], axis=1)


@compiled
def fill_noisy_moments(signal, noise_sd, edges, nearest, moments):
    """Fill `moments` [2, signal] with mean [DN] and variance [DN²] of the code of signals with Gaussian read noise.

    They are those of the probabilities of `integrate_read_noise`, whose other arguments are explained there. `nearest`
    [signal] is the code of each signal without noise. With m this code, the mean is m + Σ_{k≥m} P(code > k) −
    Σ_{k<m} P(code ≤ k), and the mean of (code − m)² has the weights 2 |k − m| ± 1 in the same sums.
    """
    scale = math.sqrt(0.5) / noise_sd
    farthest = NOISE_SD * math.sqrt(0.5)
    for i in range(signal.size):
        middle, shift, square = nearest[i], 0.0, 0.0
        for k in range(middle, edges.size):
            distance = (edges[k] - signal[i]) * scale
            if distance > farthest:
                break
            above = 0.5 * math.erfc(distance)
            shift += above
            square += (2 * (k - middle) + 1) * above
        for k in range(middle - 1, -1, -1):
            distance = (signal[i] - edges[k]) * scale
            if distance > farthest:
                break
            below = 0.5 * math.erfc(distance)
            shift -= below
            square += (2 * (middle - k) - 1) * below
        moments[0, i], moments[1, i] = middle + shift, square - shift**2


@compiled
def sum_over_electrons(mean_e, lowest_count, first, band, first_code, probability, slope):
    """Add Σ_n Poisson(n | ν) band(n, code) to `probability`, and the derivative of this sum by ν to `slope`.

    n is the number of electrons, and ν the mean of its Poisson distribution. Rows of `band` are for consecutive n. They
    must include all n that `find_possible_counts` gives for any ν.

    Parameters
    ----------
    mean_e : means ν of the Poisson distribution [mean] in e-, at least 0.
    lowest_count : number of electrons n of the first row of `first` and `band`.
    first : code of the first column of each row of `band` [count], integers.
    band : probability of each code, or another value to be summed, given n [count, code].
    first_code : code of the first column of `probability` and `slope`.
    probability, slope : arrays [mean, code] that the results are added to; `slope` is per e-.
    """
    for i in range(mean_e.size):
        mean = mean_e[i]
        low, high = find_possible_counts(mean)
        # Poisson probability P(n) of n = `low`, then of each next n by P(n + 1) = P(n) ν/(n + 1).
        weight = math.exp((low * math.log(mean) if low > 0 else 0.0) - mean - math.lgamma(low + 1.0))
        previous_weight = 0.0
        for count in range(low, high + 1):
            row = count - lowest_count
            # Derivative by the mean: ∂P(n)/∂ν = P(n − 1) − P(n).
            weight_slope = previous_weight - weight
            column = first[row] - first_code
            for j in range(band.shape[1]):
                probability[i, column + j] += weight * band[row, j]
                slope[i, column + j] += weight_slope * band[row, j]
            previous_weight = weight
            weight *= mean / (count + 1.0)
