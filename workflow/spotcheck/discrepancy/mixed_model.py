"""Restricted maximum likelihood (REML) of variance components, and intervals of standard deviations.

Variance components are the variances of independent random effects, such as a scatter from site to site. REML estimates
them from contrasts of the observations, on which the parameters of the mean have no influence.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from spotcheck.discrepancy.normal_equations import invert_information

# Promised gain in ln L below which the variances have converged, and most steps.
TOLERANCE, ITERATIONS = 1e-5, 40
# Fraction of a step at which halving it ends.
LEAST_STEP = 1e-4
# Singular values below this part of the largest belong to columns of the mean that depend on the others.
NULL_SINGULAR = 1e-10
# Degrees of freedom of a variance below which its interval begins at 0.
LEAST_DOF = 2.0
# Normal quantile of a 95 % interval, and the probabilities of its ends.
QUANTILE, LEVELS = 1.96, (0.025, 0.975)


@dataclass(frozen=True)
class VarianceComponents:
    """Estimated variances of random effects."""

    names: tuple[str, ...]  # names of the components
    variance: np.ndarray  # variance of each component, at least 0 [component]
    covariance: np.ndarray  # covariance of these estimates [component, component]
    deviance: float  # −2 ln L up to a constant; comparable only between models with the same columns of the mean

    def value_of(self, name: str) -> float:
        """Return the variance of a component, 0 if the model does not have it."""
        return float(self.variance[self.names.index(name)]) if name in self.names else 0.0


@dataclass(frozen=True)
class Interval:
    """Estimate with its standard error and 95 % interval, all in the unit of the quantity."""

    value: float  # estimate
    stderr: float  # standard error; NaN if unknown
    low: float  # lower end of the interval
    high: float  # upper end of the interval

    @classmethod
    def around(cls, value: float, stderr: float, quantile: float = QUANTILE) -> "Interval":
        """Return the symmetric interval of ± `quantile` standard errors; NaN ends if the error is NaN."""
        return cls(float(value), float(stderr), float(value - quantile * stderr), float(value + quantile * stderr))


def fit_reml(
    observations: np.ndarray, mean: np.ndarray, known: np.ndarray, components: Mapping[str, np.ndarray]
) -> VarianceComponents:
    """Estimate variance components by REML, with Fisher scoring on contrasts K'z for which K'X = 0.

    Parameters
    ----------
    observations : array [n]
        Values z = X β + e with free coefficients β.
    mean : array [n, k]
        Columns X of the mean.
    known : array [n, n]
        Known part C of the covariance V = C + Σ variance_i component_i of e.
    components : mapping of name to array [n, n]
        Covariance of each component at a variance of 1. Without components −2 ln L is all that is computed.

    Returns
    -------
    VarianceComponents
        Estimates, none below 0.

    References
    ----------
    Searle, Casella & McCulloch (1992), Variance Components, chapter 6.
    """
    left, singular, _ = np.linalg.svd(mean, full_matrices=True)
    contrasts = left[:, int((singular > NULL_SINGULAR * singular.max(initial=0.0)).sum()) :]
    y, known_part = contrasts.T @ observations, contrasts.T @ known @ contrasts
    matrices = [contrasts.T @ matrix @ contrasts for matrix in components.values()]

    def evaluate(variance: np.ndarray) -> tuple[float, np.ndarray]:
        """Return −2 ln L at some variances [component], and the inverse covariance of the contrasts."""
        total = known_part + sum(v * m for v, m in zip(variance, matrices, strict=True))
        inverse = np.linalg.inv(total)
        return float(np.linalg.slogdet(total)[1] + y @ inverse @ y), inverse

    variance = np.zeros(len(matrices))
    deviance, inverse = evaluate(variance)
    information = np.zeros((len(matrices), len(matrices)))
    for _ in range(ITERATIONS if matrices else 0):
        gradient, information = _differentiate(matrices, inverse, y)
        # Variances at 0 that a step would make negative stay.
        active = ~((variance <= 0) & (gradient < 0))
        step = np.zeros(len(matrices))
        if active.any():
            step[active] = np.linalg.lstsq(information[np.ix_(active, active)], gradient[active], rcond=None)[0]
        if gradient @ step < TOLERANCE:
            break
        # Halve the step until −2 ln L does not rise.
        fraction = 1.0
        while fraction > LEAST_STEP:
            trial = np.maximum(variance + fraction * step, 0.0)
            trial_deviance, trial_inverse = evaluate(trial)
            if trial_deviance <= deviance:
                break
            fraction /= 2
        else:
            break
        variance, deviance, inverse = trial, trial_deviance, trial_inverse
    return VarianceComponents(tuple(components), variance, invert_information(information), deviance)


def _differentiate(matrices: Sequence[np.ndarray], inverse: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient of ln L by the variances [component] and their information [component, component].

    `matrices` are the covariances of the contrasts by each component at a variance of 1 [contrast, contrast], `inverse`
    is the inverse covariance of the contrasts [contrast, contrast] and `y` their values [contrast].
    """
    weighted_y = inverse @ y
    products = [inverse @ matrix for matrix in matrices]
    gradient = [0.5 * (weighted_y @ m @ weighted_y - np.trace(p)) for m, p in zip(matrices, products, strict=True)]
    information = [[0.5 * np.sum(first * second.T) for second in products] for first in products]
    return np.array(gradient), np.array(information)


def deviation_interval(variance: float, estimate_variance: float) -> Interval:
    """Return the 95 % interval of a standard deviation.

    `variance` is the estimate of the square of the standard deviation, and `estimate_variance` the squared standard
    error of this estimate.

    The estimate is taken as a scaled χ² with 2 variance²/estimate_variance degrees of freedom. With fewer degrees of
    freedom than `LEAST_DOF` the lower end is 0, and the upper end is the root of the normal upper end of the variance.
    An exact estimate (estimate_variance = 0) has an interval of no width.
    """
    stderr_of_variance = np.sqrt(max(estimate_variance, 0.0))
    sd = float(np.sqrt(max(variance, 0.0)))
    if stderr_of_variance == 0:
        return Interval(sd, 0.0, sd, sd)
    dof = 2 * variance**2 / estimate_variance
    if dof < LEAST_DOF or sd == 0:
        high = float(np.sqrt(max(variance, 0.0) + QUANTILE * stderr_of_variance))
        return Interval(sd, high / QUANTILE, 0.0, high)
    high, low = (float(sd * np.sqrt(dof / stats.chi2.ppf(level, dof))) for level in LEVELS)
    return Interval(sd, float(stderr_of_variance / (2 * sd)), low, high)
