"""Variance components by restricted maximum likelihood, beside a covariance that is known.

Rows y = µ(θ) + e, e ~ N(0, V), V = C + Σ τ Z Zᵀ with τ ≥ 0. Patterson & Thompson 1971 (doi:10.1093/biomet/58.3.545);
Fisher's scoring as in Searle, Casella & McCulloch, Variance Components (1992), sec. 6.6 and 8.3; degrees of freedom by
Satterthwaite 1946 (doi:10.2307/3002019).
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import linalg, special, stats

# Steps of scoring; one that gains less than ENOUGH in −2 ln L ends it: far below the 1 that a standard error is worth.
STEPS, ENOUGH, HALVINGS = 40, 1e-4, 8
# Part of the mean variance of a component's rows at which its scoring begins: any start above 0 will do.
START = 0.3
# Ridge on the components' information, relative: two components that a design cannot part share what they explain.
RIDGE = 1e-9
# Directions of parameters with less than this part of their own information do not show beside the others.
HIDDEN, TINY = 1e-11, 1e-200
# Logs of tails below this are no longer to be trusted in double precision.
UNDERFLOW = -700.0


class Component(NamedTuple):
    """A variance component: of what (`brightness`, `width`), what shares it (`site`, `frame`), and Z [row, member]."""

    of: str
    shared: str
    members: np.ndarray


class Weights(NamedTuple):
    """V's Cholesky factor and V⁻¹ at some components [component]."""

    tau: np.ndarray
    factor: np.ndarray
    inverse: np.ndarray

    @property
    def log_determinant(self) -> float:
        """ln |V|."""
        return 2 * float(np.log(np.diag(self.factor)).sum())


class Scored(NamedTuple):
    """At some components: −2 ln L but for constants, its score (of ln L), and the components' expected information."""

    deviance: float
    score: np.ndarray
    information: np.ndarray


def weights_at(known: np.ndarray, components: tuple[Component, ...], tau: np.ndarray) -> Weights:
    """V of rows with the covariance `known` [row, row] and components of variance `tau`."""
    total = known.copy()
    for own, variance in zip(components, tau, strict=True):
        if variance > 0:
            total += variance * (own.members @ own.members.T)
    factor = linalg.cholesky(total, lower=True, check_finite=False)
    inverse = linalg.lapack.dpotri(factor, lower=1)[0]
    return Weights(tau, factor, inverse + np.tril(inverse, -1).T)


def scored(
    weights: Weights, components: tuple[Component, ...], slopes: np.ndarray, rest: np.ndarray, *, restricted: bool
) -> Scored:
    """Likelihood of residuals `rest` [row] about a mean with `slopes` [row, parameter], which are fitted; `restricted`:
    that of what the parameters leave."""
    inverse = weights.inverse
    heavy = inverse @ slopes
    half, log_determinant = _half_inverse(slopes.T @ heavy)
    made = half.T @ heavy.T
    pulled = inverse @ rest - made.T @ (made @ rest)
    deviance = weights.log_determinant + float(rest @ pulled)
    left = inverse
    if restricted:
        left = inverse - made.T @ made
        deviance += log_determinant
    if not components:
        return Scored(deviance, np.zeros(0), np.zeros((0, 0)))
    members = np.concatenate([own.members for own in components], 1)
    ends = np.cumsum([0, *(own.members.shape[1] for own in components)])
    shared = members.T @ (left @ members)
    drawn = members.T @ pulled
    blocks = [slice(a, b) for a, b in pairwise(ends)]
    score = np.array([drawn[b] @ drawn[b] - np.trace(shared[b, b]) for b in blocks]) / 2
    information = np.array([[np.sum(shared[a, b] ** 2) for b in blocks] for a in blocks]) / 2
    return Scored(deviance, score, information)


def _half_inverse(information: np.ndarray) -> tuple[np.ndarray, float]:
    """H [parameter, direction] with H Hᵀ the inverse of an information, without directions that hardly show, and the
    log of its determinant in the others: the phase of an amplitude that comes out as 0 does not show at all."""
    scale = np.sqrt(np.maximum(np.diag(information), TINY))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    kept = values > HIDDEN
    values, vectors = values[kept], vectors[:, kept]
    return vectors / np.sqrt(values) / scale[:, None], float(np.log(values).sum() + 2 * np.log(scale).sum())


class Estimated(NamedTuple):
    """Components that fit best, V there, and the likelihood there."""

    weights: Weights
    at: Scored


def estimate(
    known: np.ndarray,
    components: tuple[Component, ...],
    slopes: np.ndarray,
    rest: np.ndarray,
    start: np.ndarray,
    *,
    restricted: bool,
) -> Estimated:
    """Components of the residuals `rest` by Fisher's scoring from `start`, none below 0."""
    tau = np.asarray(start, float)
    weights = weights_at(known, components, tau)
    now = scored(weights, components, slopes, rest, restricted=restricted)
    for _ in range(STEPS if components else 0):
        step = _scoring(now, tau)
        for _ in range(HALVINGS):
            tried = np.maximum(tau + step, 0.0)
            then_weights = weights_at(known, components, tried)
            then = scored(then_weights, components, slopes, rest, restricted=restricted)
            if then.deviance <= now.deviance:
                break
            step = step / 2
        else:
            break
        gained = now.deviance - then.deviance
        tau, weights, now = tried, then_weights, then
        if gained < ENOUGH:
            break
    return Estimated(weights, now)


def _scoring(now: Scored, tau: np.ndarray) -> np.ndarray:
    """A step of scoring that leaves alone what stands at 0 and would go below."""
    free = (tau > 0) | (now.score > 0)
    step = np.zeros(len(tau))
    for _ in range(len(tau)):
        own = np.ix_(free, free)
        scale = np.sqrt(np.diag(now.information))[free]
        inner = now.information[own] / np.outer(scale, scale) + RIDGE * np.eye(free.sum())
        step[:] = 0
        step[free] = linalg.solve(inner, now.score[free] / scale, assume_a="pos") / scale
        stuck = free & (tau == 0) & (step < 0)
        if not stuck.any():
            break
        free &= ~stuck
    return step


def begun(known: np.ndarray, components: tuple[Component, ...]) -> np.ndarray:
    """Components from which scoring may begin."""
    means = [np.sum(own.members**2 * np.diag(known)[:, None]) / np.sum(own.members**2) for own in components]
    return START * np.array(means)


class Reckoned(NamedTuple):
    """Of parameters: covariance, the row of weights [parameter, row] that makes each of the rows, and the variance of
    the variance of each."""

    covariance: np.ndarray
    rows: np.ndarray
    doubt: np.ndarray


def reckoned(found: Estimated, components: tuple[Component, ...], slopes: np.ndarray) -> Reckoned:
    """Errors of parameters at estimated components, and how well those errors are known.

    The errors of components that came out as 0 count as well: another set would have had some.
    """
    half, _ = _half_inverse(slopes.T @ found.weights.inverse @ slopes)
    covariance = half @ half.T
    rows = covariance @ slopes.T @ found.weights.inverse
    if not components:
        return Reckoned(covariance, rows, np.zeros(len(rows)))
    by = np.stack([np.sum((rows @ own.members) ** 2, 1) for own in components], 1)
    scale = np.sqrt(np.diag(found.at.information))
    sure = found.at.information / np.outer(scale, scale) + RIDGE * np.eye(len(scale))
    by = by / scale
    return Reckoned(covariance, rows, np.sum(by * linalg.solve(sure, by.T, assume_a="pos").T, 1))


def spread(found: Estimated) -> np.ndarray:
    """Standard errors of the components."""
    scale = np.sqrt(np.diag(found.at.information))
    sure = found.at.information / np.outer(scale, scale) + RIDGE * np.eye(len(scale))
    return np.sqrt(np.diag(np.linalg.inv(sure))) / scale


def root_of(tau: float, error: float) -> tuple[float, float]:
    """Root of a variance and its standard error; where the variance is less than its own, that of a variance as large
    as its error."""
    return float(np.sqrt(tau)), float(error / (2 * np.sqrt(max(tau, error))))


def z_of(t: float, freedom: float, parameters: int = 1, tries: int = 1) -> float:
    """The standard normal number as unlikely (both sides) as Student's t with so many degrees of freedom; as the
    largest t among the directions of several parameters, by Fisher's F; and as the largest of so many tries, by
    Bonferroni."""
    if not np.isfinite(t):
        return 0.0
    if parameters > 1:
        log_p = stats.f.logsf(t * t / parameters, parameters, freedom)
    else:
        log_p = stats.t.logsf(abs(t), freedom) + np.log(2)
    log_p = min(log_p + np.log(tries), 0.0)
    if not log_p > UNDERFLOW:
        # Wallace 1959 (doi:10.1214/aoms/1177706092), good to a part in a hundred where tails underflow.
        return float(np.sign(t) * np.sqrt(freedom * np.log1p(t * t / freedom)))
    return float(np.sign(t) * max(-special.ndtri_exp(log_p - np.log(2)), 0.0))
