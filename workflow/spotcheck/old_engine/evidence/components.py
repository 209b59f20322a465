"""Variance components by restricted maximum likelihood, beside a covariance that is known.

Rows y = µ(θ) + e, e ~ N(0, V), V = C + Σ τ Z Zᵀ with τ ≥ 0. Patterson & Thompson 1971 (doi:10.1093/biomet/58.3.545);
Fisher's scoring as in Searle, Casella & McCulloch, Variance Components (1992), sec. 6.6 and 8.3; degrees of freedom by
Satterthwaite 1946 (doi:10.2307/3002019).
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg, special, stats

# Steps of scoring; one that gains less than ENOUGH in −2 ln L ends it: far below the 1 that a standard error is worth.
STEPS, ENOUGH, HALVINGS = 40, 1e-4, 8
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


class Estimated(NamedTuple):
    """Components of variance `tau` [component]: V's Cholesky factor and V⁻¹; −2 ln L but for constants, its score (of
    ln L), and the components' expected information."""

    components: tuple[Component, ...]
    tau: np.ndarray
    factor: np.ndarray
    inverse: np.ndarray
    deviance: float
    score: np.ndarray
    information: np.ndarray


def factor_of(known: np.ndarray, components: tuple[Component, ...], tau: np.ndarray) -> np.ndarray:
    """Cholesky factor of V, of rows with the covariance `known` [row, row]."""
    total = known.copy()
    for own, variance in zip(components, tau, strict=True):
        if variance > 0:
            total += variance * (own.members @ own.members.T)
    return linalg.cholesky(total, lower=True, check_finite=False)


def estimated(
    known: np.ndarray,
    components: tuple[Component, ...],
    slopes: np.ndarray,
    rest: np.ndarray,
    tau: np.ndarray,
    *,
    restricted: bool,
) -> Estimated:
    """Likelihood of residuals `rest` [row] about a mean with `slopes` [row, parameter], which are fitted; `restricted`:
    that of what the parameters leave."""
    factor = factor_of(known, components, tau)
    inverse = linalg.lapack.dpotri(factor, lower=1)[0]
    inverse += np.tril(inverse, -1).T
    heavy = inverse @ slopes
    half, log_determinant = _half_inverse(slopes.T @ heavy)
    made = half.T @ heavy.T
    pulled = inverse @ rest - made.T @ (made @ rest)
    deviance = 2 * float(np.log(np.diag(factor)).sum()) + float(rest @ pulled)
    left = inverse
    if restricted:
        left = inverse - made.T @ made
        deviance += log_determinant
    members = [own.members for own in components]
    drawn = [left @ own for own in members]
    score = (
        np.array([np.sum((own.T @ pulled) ** 2) - np.sum(own * b) for own, b in zip(members, drawn, strict=True)]) / 2
    )
    information = np.array([[np.sum((own.T @ b) ** 2) for b in drawn] for own in members]) / 2
    return Estimated(components, tau, factor, inverse, deviance, score, information.reshape(len(members), -1))


def _half_inverse(information: np.ndarray) -> tuple[np.ndarray, float]:
    """H [parameter, direction] with H Hᵀ the inverse of an information, without directions that hardly show, and the
    log of its determinant in the others: the phase of an amplitude that comes out as 0 does not show at all."""
    scale = np.sqrt(np.maximum(np.diag(information), TINY))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    kept = values > HIDDEN
    values, vectors = values[kept], vectors[:, kept]
    return vectors / np.sqrt(values) / scale[:, None], float(np.log(values).sum() + 2 * np.log(scale).sum())


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
    now = estimated(known, components, slopes, rest, np.asarray(start, float), restricted=restricted)
    for _ in range(STEPS if components else 0):
        step, then = _scoring(now), now
        for _ in range(HALVINGS):
            tau = np.maximum(now.tau + step, 0.0)
            then = estimated(known, components, slopes, rest, tau, restricted=restricted)
            if then.deviance <= now.deviance:
                break
            step = step / 2
        gained = now.deviance - then.deviance
        now = then if gained >= 0 else now
        if gained < ENOUGH:
            break
    return now


def _scoring(now: Estimated) -> np.ndarray:
    """A step of scoring that leaves alone what stands at 0 and would go below."""
    free = (now.tau > 0) | (now.score > 0)
    step = np.zeros(len(free))
    for _ in step:
        step[:] = 0
        step[free] = _sure(now.information[np.ix_(free, free)]) @ now.score[free]
        stuck = free & (now.tau == 0) & (step < 0)
        if not stuck.any():
            break
        free &= ~stuck
    return step


def _sure(information: np.ndarray) -> np.ndarray:
    """The inverse of components' information, with the ridge."""
    scale = np.sqrt(np.diag(information))
    return np.linalg.inv(information / np.outer(scale, scale) + RIDGE * np.eye(len(scale))) / np.outer(scale, scale)


def reckoned(found: Estimated, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Covariance of parameters at estimated components, weights [parameter, row] that make each of them of the rows,
    and the variance of the variance of each.

    The errors of components that came out as 0 count as well: another set would have had some.
    """
    half, _ = _half_inverse(slopes.T @ found.inverse @ slopes)
    covariance = half @ half.T
    rows = covariance @ slopes.T @ found.inverse
    by = [np.sum((rows @ own.members) ** 2, 1) for own in found.components]
    doubt = np.einsum("kp,kl,lp->p", by, _sure(found.information), by) if by else np.zeros(len(rows))
    return covariance, rows, doubt


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
