"""Restricted maximum likelihood (REML) of variance components, and intervals of standard deviations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from spotcheck.discrepancy.normal_equations import invert_information

# Promised gain in ln L below which the variances have converged, and most steps.
TOLERANCE, ITERATIONS = 1e-5, 40
# Part of a step below which halving it ends.
LEAST_STEP = 1e-4
# Singular values below this part of the largest: columns of the mean that add nothing.
NULL_SINGULAR = 1e-10
# Degrees of freedom of a variance below which its interval begins at 0.
LEAST_DOF = 2.0


@dataclass(frozen=True)
class VarianceComponents:
    """Estimated variances of random effects."""

    names: tuple[str, ...]  # of the components
    variance: np.ndarray  # of each, at least 0 [component]
    covariance: np.ndarray  # of these estimates [component, component]
    deviance: float  # −2 ln L but for a constant that depends on the columns of the mean

    def value_of(self, name: str) -> float:
        """Return the variance of a component, 0 if it is not there."""
        return float(self.variance[self.names.index(name)]) if name in self.names else 0.0


@dataclass(frozen=True)
class Interval:
    """Estimate with its standard error and 95 % interval."""

    value: float
    stderr: float
    low: float
    high: float

    @classmethod
    def around(cls, value: float, stderr: float, quantile: float = 1.96) -> "Interval":
        """Return the symmetric interval of ± quantile standard errors."""
        return cls(float(value), float(stderr), float(value - quantile * stderr), float(value + quantile * stderr))


def fit_reml(
    observations: np.ndarray, mean: np.ndarray, known: np.ndarray, components: Mapping[str, np.ndarray]
) -> VarianceComponents:
    """Estimate variance components beside a linear mean by Fisher scoring on contrasts that are free of the mean.

    Parameters
    ----------
    observations : array [n]
        Values z = X β + e.
    mean : array [n, k]
        Columns X of the mean.
    known : array [n, n]
        Known part C of the covariance V = C + Σ variance_i component_i of e.
    components : mapping of name to array [n, n]
        Covariance of each component at a variance of 1. Variances are at least 0.

    References
    ----------
    Searle, Casella & McCulloch (1992), Variance Components, chapter 6.
    """
    left, singular, _ = np.linalg.svd(mean, full_matrices=True)
    contrasts = left[:, int((singular > NULL_SINGULAR * singular.max(initial=0.0)).sum()) :]
    y, base = contrasts.T @ observations, contrasts.T @ known @ contrasts
    matrices = [contrasts.T @ matrix @ contrasts for matrix in components.values()]

    def evaluate(variance: np.ndarray) -> tuple[float, np.ndarray]:
        total = base + sum((v * m for v, m in zip(variance, matrices, strict=True)), np.zeros_like(base))
        inverse = np.linalg.inv(total)
        return float(np.linalg.slogdet(total)[1] + y @ inverse @ y), inverse

    variance = np.zeros(len(matrices))
    value, inverse = evaluate(variance)
    information = np.zeros((len(matrices), len(matrices)))
    for _ in range(ITERATIONS if matrices else 0):
        gradient, information = _differentiate(matrices, inverse, y)
        active = ~((variance <= 0) & (gradient < 0))
        step = np.zeros(len(matrices))
        if active.any():
            step[active] = np.linalg.lstsq(information[np.ix_(active, active)], gradient[active], rcond=None)[0]
        if gradient @ step < TOLERANCE:
            break
        part = 1.0
        while part > LEAST_STEP:
            trial = np.maximum(variance + part * step, 0.0)
            trial_value, trial_inverse = evaluate(trial)
            if trial_value <= value:
                break
            part /= 2
        else:
            break
        variance, value, inverse = trial, trial_value, trial_inverse
    return VarianceComponents(tuple(components), variance, invert_information(information), value)


def _differentiate(matrices: Sequence[np.ndarray], inverse: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient of ln L by the variances, and their Fisher information."""
    weighted = inverse @ y
    products = [inverse @ matrix for matrix in matrices]
    gradient = [0.5 * (weighted @ m @ weighted - np.trace(p)) for m, p in zip(matrices, products, strict=True)]
    information = [[0.5 * np.sum(first * second.T) for second in products] for first in products]
    return np.array(gradient), np.array(information)


def deviation_interval(variance: float, variance_of_it: float) -> Interval:
    """Return the interval of a standard deviation from the estimate of a variance and the variance of that estimate.

    The estimate is taken as a scaled χ² with 2 variance²/variance_of_it degrees of freedom.
    """
    spread = np.sqrt(max(variance_of_it, 0.0))
    sd = np.sqrt(max(variance, 0.0))
    if spread == 0:
        return Interval(float(sd), 0.0, float(sd), float(sd))
    dof = 2 * variance**2 / variance_of_it
    if dof < LEAST_DOF or sd == 0:
        high = np.sqrt(max(variance, 0.0) + 1.96 * spread)
        return Interval(float(sd), float(high / 1.96), 0.0, float(high))
    low, high = (float(sd * np.sqrt(dof / stats.chi2.ppf(q, dof))) for q in (0.975, 0.025))
    return Interval(float(sd), float(spread / (2 * sd)), low, high)
