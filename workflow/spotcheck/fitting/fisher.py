"""Fisher information and Cramér–Rao bounds (Eqs. 30–38): in electrons, except `information_of_moments` in DN.

ν [e-] is the mean number of electrons of a pixel, θ a vector of parameters, ρ the density of a reading. The parameters
may be any of the forward model, which predicts a frame from the light and from effects such as nonlinearity.
`information_of_mean` differentiates a mean; `information_of_moments` takes the derivatives of mean and variance that
`ForwardModel.jacobian` returns. A mean in DN has no Poisson distribution. The bounds of the paper assume one, and
therefore have K times the information, with the gain K [DN/e-].
"""

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from scipy.special import gammaln
from scipy.stats import norm, poisson

from spotcheck.fitting.reading_kernel import build_reading_law, compute_pixel_information
from spotcheck.model.baseline import jacobian
from spotcheck.sensor import ROUNDING_VARIANCE, ReadingDistribution, SensorModel

# Means for each decade at which the information with read noise is computed exactly.
NODES_PER_DECADE = 8
# Readings without rounding are approximated by rounded ones with so many codes per standard deviation of the read
# noise, and at least with so many where shot noise hides the rounding.
CODES_PER_NOISE, FEWEST_CODES = 64, 8.0
# Standard deviations of the electrons, and electrons beyond, that the sum over electrons includes.
COUNT_SIGMAS, COUNT_MARGIN = 9, 10
# Mean [e-] below which the information with read noise counts as constant.
LEAST_MEAN_E = 1e-3
# Below this read noise [e-] electrons can be counted: the information is that of the Poisson distribution to 1 %.
NOISELESS = 0.2


def log_density(z, mean_e, read_noise_e: float, read_mean_e: float = 0.0):
    """Return ln ρ(z) of Poisson electrons plus Gaussian read noise (Eq. 30), with ρ in 1/e-.

    Parameters
    ----------
    z, mean_e : readings and mean electrons ν [e-]; they broadcast.
    read_noise_e, read_mean_e : standard deviation and mean of the read noise [e-].
    """
    z, mean_e = np.broadcast_arrays(np.asarray(z, float), np.asarray(mean_e, float))
    log_rho = np.empty(z.shape)
    for k in np.ndindex(z.shape):
        # Counts that are farther from the mean have no weight.
        mean, half_width = float(mean_e[k]), COUNT_SIGMAS * np.sqrt(float(mean_e[k])) + COUNT_MARGIN
        counts = np.arange(max(0, int(mean - half_width)), int(mean + half_width) + 1)
        terms = poisson.logpmf(counts, mean_e[k]) + norm.logpdf(z[k], counts + read_mean_e, read_noise_e)
        log_rho[k] = np.logaddexp.reduce(terms)
    return log_rho


def log_density_poisson(z, mean_e):
    """Return ln ρ(z) of the electrons alone (Eq. 31), at counts z for a mean ν [e-]; the arguments broadcast."""
    return z * np.log(mean_e) - mean_e - gammaln(np.asarray(z) + 1.0)


def score_squared(z, mean_e):
    """Return S = (∂ ln ρ/∂ν)² [1/e-²] of the Poisson distribution at counts z for a mean ν [e-] (Eq. 35)."""
    return (z / mean_e - 1) ** 2


def poisson_information(mean_e):
    """Return I(ν) = 1/ν [1/e-²] of a Poisson mean ν [e-] (Eq. 36)."""
    return 1 / np.asarray(mean_e)


def read_noise_information(mean_e, read_noise_e: float):
    """Return I(ν) [1/e-²] of a Poisson mean with Gaussian read noise: E[(∂ ln ρ/∂ν)²] over the density of Eq. 30.

    `mean_e` is ν [e-] in any shape, `read_noise_e` is σ [e-]. The information is close to 1/(ν + σ²). It is
    interpolated in ln ν between exact values, and constant below `LEAST_MEAN_E`.
    """
    if read_noise_e < NOISELESS:
        return poisson_information(mean_e)
    mean_e = np.maximum(np.asarray(mean_e, float), LEAST_MEAN_E)
    first = int(np.floor(np.log10(mean_e.min()) * NODES_PER_DECADE))
    last = int(np.ceil(np.log10(mean_e.max()) * NODES_PER_DECADE))
    nodes = 10 ** (np.arange(first, max(last, first + 1) + 1) / NODES_PER_DECADE)
    # Relative to 1/(ν + σ²) the information is smooth and close to 1.
    relative = [_integrate_information(float(node), read_noise_e) * (node + read_noise_e**2) for node in nodes]
    return np.interp(np.log(mean_e), np.log(nodes), relative) / (mean_e + read_noise_e**2)


@cache
def _integrate_information(mean_e: float, read_noise_e: float) -> float:
    """Return I(ν) [1/e-²] of readings with codes so narrow that rounding loses at most 5e-5 of it."""
    gain = max(CODES_PER_NOISE / np.sqrt(1 + mean_e / read_noise_e**2), FEWEST_CODES) / read_noise_e
    # The black level is ten standard deviations of the read noise above 0, so that no reading is clipped.
    fine_sensor = SensorModel(gain, read_noise_e, black_level_dn=10 * gain * read_noise_e)
    # From information on the light [1/DN²] to that on electrons.
    return float(ReadingDistribution(fine_sensor).fisher_information(gain * mean_e)) * gain**2


def reading_information(mean_e, sensor: SensorModel) -> np.ndarray:
    """Return I(ν) [1/e-²] of a reading as the spot fit uses it, in the shape of the mean electrons ν [e-].

    It includes shot and read noise, rounding, clips at 0 and at full scale, and the full well.
    """
    mean_e = np.asarray(mean_e, float)
    return compute_pixel_information(mean_e.ravel(), build_reading_law(sensor)).reshape(mean_e.shape)


def information_of_mean(mean_e: Callable, parameters: Sequence[float], pixel_information: Callable) -> np.ndarray:
    """Return I(θ) [parameter, parameter] of a model, differentiated by complex step (Eqs. 34 and 37).

    Parameters
    ----------
    mean_e : function of the parameters that returns the mean electrons ν [pixels]; it must accept complex numbers.
    parameters : values of θ.
    pixel_information : function I(ν) [1/e-²] of a pixel, such as `poisson_information`.
    """
    return information(jacobian(mean_e, parameters), pixel_information(mean_e(*parameters)))


def information_of_moments(variance: np.ndarray, mean_slopes: np.ndarray, variance_slopes: np.ndarray) -> np.ndarray:
    """Return I(θ) [parameter, parameter] of normally distributed readings by the Slepian–Bangs formula.

    I_ij is the sum over pixels of µ_i µ_j/V + V_i V_j/(2 V²), where µ_i and V_i are the derivatives of mean and
    variance by parameter i. Unlike `information_of_mean` it covers parameters of the sensor, which change the variance.

    Parameters
    ----------
    variance : V [pixels] in DN².
    mean_slopes, variance_slopes : µ_i [DN] and V_i [DN²], both per unit of the parameter [parameter, pixels].
    """
    variance = np.ravel(variance)
    # A reading with less variance than rounding is clipped and not normal: it gets no weight.
    weight = np.where(variance >= ROUNDING_VARIANCE, 1 / np.maximum(variance, ROUNDING_VARIANCE), 0.0)
    return information(mean_slopes, weight) + information(variance_slopes, 0.5 * weight**2)


def information(slopes: np.ndarray, pixel_information: np.ndarray) -> np.ndarray:
    """Return I(θ) [parameter, parameter] from ∂ν/∂θ and I(ν) of each pixel (Eqs. 34 and 37).

    `slopes` are ∂ν/∂θ [parameter, pixels], `pixel_information` is I(ν) [pixels]. Pixels may have several dimensions.
    """
    slopes = slopes.reshape(len(slopes), -1)
    return (slopes * np.ravel(pixel_information)) @ slopes.T


def information_from_scores(scores: np.ndarray, probability: np.ndarray) -> np.ndarray:
    """Return I(θ) = E[(∂ ln ρ/∂θ)ᵀ (∂ ln ρ/∂θ)] [parameter, parameter] of one pixel (Eq. 33).

    `scores` are ∂ ln ρ/∂θ of every possible reading [parameter, reading], `probability` is its probability [reading].
    """
    return (scores * probability) @ scores.T


def information_from_curvature(second_derivatives: np.ndarray, probability: np.ndarray) -> np.ndarray:
    """Return I(θ) = −E[∂² ln ρ/∂θ_i ∂θ_j] [parameter, parameter] of one pixel (Eq. 32).

    `second_derivatives` are those of every possible reading [parameter, parameter, reading], `probability` [reading].
    """
    return -(second_derivatives * probability).sum(axis=-1)


def cramer_rao_bounds(matrix: np.ndarray) -> np.ndarray:
    """Return the bounds on the variances of the parameters [parameter]: the diagonal of I(θ)⁻¹ (Eq. 38).

    `matrix` is I(θ) [parameter, parameter]; a singular one raises `LinAlgError`.
    """
    return np.diag(np.linalg.inv(matrix)).copy()
