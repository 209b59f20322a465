"""Fisher information and Cramér–Rao bounds (Eqs. 30–38), in electrons.

Of any parameters of the forward model, effects included: `of_mean` differentiates a mean, `of_moments` takes the
derivatives of mean and variance that `ForwardModel.jacobian` returns. A mean in DN has no Poisson law: the paper's own
bounds put one in, and have K times the information.
"""

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from scipy.special import gammaln
from scipy.stats import norm, poisson

from spotcheck.fitting.reading_kernel import law_of, pixel_information
from spotcheck.model.baseline import jacobian
from spotcheck.sensor import ROUNDING_VARIANCE, ReadingDistribution, SensorModel

NODES_PER_DECADE = 8
# Codes for each read noise in the readings that stand for unrounded ones.
CODES_PER_NOISE = 64
# Below this read noise [e-] electrons can be counted: the information is that of the Poisson law to 1 %.
NOISELESS = 0.2


def log_density(z, mean_e, read_noise_e: float, read_mean_e: float = 0.0):
    """ln ρ(z) of Poisson electrons plus Gaussian read noise (Eq. 30), at readings z [e-] for a mean [e-]."""
    z, mean_e = np.broadcast_arrays(np.asarray(z, float), np.asarray(mean_e, float))
    out = np.empty(z.shape)
    for k in np.ndindex(z.shape):
        counts = _counts(float(mean_e[k]))
        terms = poisson.logpmf(counts, mean_e[k]) + norm.logpdf(z[k], counts + read_mean_e, read_noise_e)
        out[k] = np.logaddexp.reduce(terms)
    return out


def log_density_poisson(z, mean_e):
    """ln ρ(z) of the electrons alone (Eq. 31), at counts z for a mean [e-]."""
    return z * np.log(mean_e) - mean_e - gammaln(np.asarray(z) + 1.0)


def score_squared(z, mean_e):
    """S = (∂ ln ρ/∂ν)² of the Poisson law at counts z (Eq. 35)."""
    return (z / mean_e - 1) ** 2


def poisson_information(mean_e):
    """I(ν) = 1/ν [1/e-²] of a Poisson mean (Eq. 36)."""
    return 1 / np.asarray(mean_e)


def read_noise_information(mean_e, read_noise_e: float):
    """I(ν) [1/e-²] of a Poisson mean read with Gaussian noise: E[(∂ ln ρ/∂ν)²] over the density of Eq. 30.

    Interpolated in the logarithm of ν between quadratures, `NODES_PER_DECADE` of them; between 1/ν (no noise) and 0,
    near 1/(ν + σ²). Below 1e-3 e- the value at 1e-3 holds.
    """
    if read_noise_e < NOISELESS:
        return poisson_information(mean_e)
    mean_e = np.maximum(np.asarray(mean_e, float), 1e-3)
    first, last = (
        int(edge(np.log10(v) * NODES_PER_DECADE)) for edge, v in ((np.floor, mean_e.min()), (np.ceil, mean_e.max()))
    )
    nodes = 10 ** (np.arange(first, max(last, first + 1) + 1) / NODES_PER_DECADE)
    # Relative to 1/(ν + σ²) the information is smooth and close to 1.
    relative = [_quadrature(float(node), read_noise_e) * (node + read_noise_e**2) for node in nodes]
    return np.interp(np.log(mean_e), np.log(nodes), relative) / (mean_e + read_noise_e**2)


@cache
def _quadrature(mean_e: float, read_noise_e: float) -> float:
    """Return the information of readings so fine that their rounding loses 5e-5 of it at most."""
    # Shot noise hides the rounding; where it resolves electrons, eight codes within a read noise are enough.
    gain = max(CODES_PER_NOISE / np.sqrt(1 + mean_e / read_noise_e**2), 8.0) / read_noise_e
    fine = SensorModel(gain, read_noise_e, black_level_dn=10 * gain * read_noise_e)
    return float(ReadingDistribution(fine).fisher_information(gain * mean_e)) * gain**2


def _counts(mean_e: float) -> np.ndarray:
    spread = 9 * np.sqrt(mean_e) + 10
    return np.arange(max(0, int(mean_e - spread)), int(mean_e + spread) + 1)


def reading_information(mean_e, sensor: SensorModel) -> np.ndarray:
    """I(ν) [1/e-²] of a reading of the whole chain: noise, rounding, both clips and the well, from the law that the
    spot fit uses."""
    mean_e = np.asarray(mean_e, float)
    return pixel_information(mean_e.ravel(), law_of(sensor)).reshape(mean_e.shape)


def of_mean(mean_e: Callable, parameters: Sequence[float], pixel_information: Callable) -> np.ndarray:
    """I(θ) [parameter, parameter] of a model mean_e(*θ) [pixels, e-], differentiated by complex step (Eqs. 34 and 37).

    `pixel_information`(ν) is I(ν) [1/e-²] of a pixel: one of the three above.
    """
    return information(jacobian(mean_e, parameters), pixel_information(mean_e(*parameters)))


def of_moments(variance: np.ndarray, mean_slopes: np.ndarray, variance_slopes: np.ndarray) -> np.ndarray:
    """Return I(θ) [parameter, parameter] of normal readings: Σ µ_i µ_j/V + V_i V_j/2V² (Slepian–Bangs).

    Parameters of the sensor move the variance too. `variance` is V [pixels, DN²]; the derivatives of mean and variance
    by the parameters are [parameter, pixels].
    """
    variance = np.ravel(variance)
    # A reading with less variance than rounding is clipped and not normal: it counts for nothing.
    weight = np.where(variance >= ROUNDING_VARIANCE, 1 / np.maximum(variance, ROUNDING_VARIANCE), 0.0)
    return information(mean_slopes, weight) + information(variance_slopes, 0.5 * weight**2)


def information(slopes: np.ndarray, pixel_information: np.ndarray) -> np.ndarray:
    """I(θ) [parameter, parameter] from ∂ν_k/∂θ [parameter, pixels] and each pixel's I(ν_k) (Eqs. 34 and 37)."""
    slopes = slopes.reshape(len(slopes), -1)
    return (slopes * np.ravel(pixel_information)) @ slopes.T


def information_from_scores(scores: np.ndarray, probability: np.ndarray) -> np.ndarray:
    """I(θ) = E[(∂ ln ρ/∂θ)ᵀ (∂ ln ρ/∂θ)] of one pixel (Eq. 33), from scores [parameter, outcome] and their
    probability."""
    return (scores * probability) @ scores.T


def information_from_curvature(second: np.ndarray, probability: np.ndarray) -> np.ndarray:
    """I(θ) = −E[∂² ln ρ/∂θ_i ∂θ_j] (Eq. 32), from second derivatives [parameter, parameter, outcome]."""
    return -(second * probability).sum(axis=-1)


def bounds(matrix: np.ndarray) -> np.ndarray:
    """Cramér–Rao bounds on the variances of the parameters: the diagonal of I(θ)⁻¹ (Eq. 38)."""
    return np.diag(np.linalg.inv(matrix)).copy()
