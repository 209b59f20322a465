"""Fisher information and Cramér–Rao bounds (Eqs. 30–38), in electrons.

The parameters may be any of the forward model, effects included: `information_of_mean` differentiates a mean,
`information_of_moments` takes the derivatives of mean and variance that `ForwardModel.jacobian` returns. A mean in DN
has no Poisson distribution; the paper's own bounds assume one and have K times the information.
"""

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from scipy.special import gammaln
from scipy.stats import norm, poisson

from spotcheck.fitting.reading_kernel import build_reading_law, compute_pixel_information
from spotcheck.model.baseline import jacobian
from spotcheck.sensor import ROUNDING_VARIANCE, ReadingDistribution, SensorModel

# Quadratures for each decade of the mean.
NODES_PER_DECADE = 8
# Codes for each read noise of readings that approximate unrounded ones, and the fewest where shot noise hides rounding.
CODES_PER_NOISE, FEWEST_CODES = 64, 8.0
# Mean [e-] below which the information with read noise counts as constant.
LEAST_MEAN_E = 1e-3
# Below this read noise [e-] electrons can be counted: the information is that of the Poisson distribution to 1 %.
NOISELESS = 0.2


def log_density(z, mean_e, read_noise_e: float, read_mean_e: float = 0.0):
    """Return ln ρ(z) of Poisson electrons plus Gaussian read noise (Eq. 30), at readings z [e-] for a mean [e-]."""
    z, mean_e = np.broadcast_arrays(np.asarray(z, float), np.asarray(mean_e, float))
    log_rho = np.empty(z.shape)
    for k in np.ndindex(z.shape):
        # Counts beyond nine standard deviations have no weight.
        mean, spread = float(mean_e[k]), 9 * np.sqrt(float(mean_e[k])) + 10
        counts = np.arange(max(0, int(mean - spread)), int(mean + spread) + 1)
        terms = poisson.logpmf(counts, mean_e[k]) + norm.logpdf(z[k], counts + read_mean_e, read_noise_e)
        log_rho[k] = np.logaddexp.reduce(terms)
    return log_rho


def log_density_poisson(z, mean_e):
    """Return ln ρ(z) of the electrons alone (Eq. 31), at counts z for a mean [e-]."""
    return z * np.log(mean_e) - mean_e - gammaln(np.asarray(z) + 1.0)


def score_squared(z, mean_e):
    """Return S = (∂ ln ρ/∂ν)² of the Poisson distribution at counts z (Eq. 35)."""
    return (z / mean_e - 1) ** 2


def poisson_information(mean_e):
    """Return I(ν) = 1/ν [1/e-²] of a Poisson mean (Eq. 36)."""
    return 1 / np.asarray(mean_e)


def read_noise_information(mean_e, read_noise_e: float):
    """Return I(ν) [1/e-²] of a Poisson mean read with Gaussian noise: E[(∂ ln ρ/∂ν)²] over the density of Eq. 30.

    It is interpolated in ln ν between quadratures and lies near 1/(ν + σ²). Below `LEAST_MEAN_E` it is constant.
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
    """Return the information of readings so fine that rounding loses at most 5e-5 of it."""
    gain = max(CODES_PER_NOISE / np.sqrt(1 + mean_e / read_noise_e**2), FEWEST_CODES) / read_noise_e
    fine = SensorModel(gain, read_noise_e, black_level_dn=10 * gain * read_noise_e)
    return float(ReadingDistribution(fine).fisher_information(gain * mean_e)) * gain**2


def reading_information(mean_e, sensor: SensorModel) -> np.ndarray:
    """Return I(ν) [1/e-²] of a reading with noise, rounding, both clips and the full well, as the spot fit uses it."""
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
    """Return I(θ) [parameter, parameter] of normal readings: Σ µ_i µ_j/V + V_i V_j/2V² (Slepian–Bangs).

    Unlike `information_of_mean` it covers parameters of the sensor, which change the variance too.

    Parameters
    ----------
    variance : V [pixels] in DN².
    mean_slopes, variance_slopes : derivatives of mean and variance by the parameters [parameter, pixels].
    """
    variance = np.ravel(variance)
    # A reading with less variance than rounding is clipped and not normal: it gets no weight.
    weight = np.where(variance >= ROUNDING_VARIANCE, 1 / np.maximum(variance, ROUNDING_VARIANCE), 0.0)
    return information(mean_slopes, weight) + information(variance_slopes, 0.5 * weight**2)


def information(slopes: np.ndarray, pixel_information: np.ndarray) -> np.ndarray:
    """Return I(θ) [parameter, parameter] from ∂ν_k/∂θ [parameter, pixels] and each pixel's I(ν_k) (Eqs. 34 and 37)."""
    slopes = slopes.reshape(len(slopes), -1)
    return (slopes * np.ravel(pixel_information)) @ slopes.T


def information_from_scores(scores: np.ndarray, probability: np.ndarray) -> np.ndarray:
    """Return I(θ) = E[(∂ ln ρ/∂θ)ᵀ (∂ ln ρ/∂θ)] of one pixel (Eq. 33).

    `scores` are [parameter, outcome], `probability` [outcome].
    """
    return (scores * probability) @ scores.T


def information_from_curvature(second: np.ndarray, probability: np.ndarray) -> np.ndarray:
    """Return I(θ) = −E[∂² ln ρ/∂θ_i ∂θ_j] (Eq. 32), from second derivatives [parameter, parameter, outcome]."""
    return -(second * probability).sum(axis=-1)


def cramer_rao_bounds(matrix: np.ndarray) -> np.ndarray:
    """Return the bounds on the variances of the parameters: the diagonal of I(θ)⁻¹ (Eq. 38)."""
    return np.diag(np.linalg.inv(matrix)).copy()
