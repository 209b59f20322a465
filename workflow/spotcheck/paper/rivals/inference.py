"""Fit of a world to summaries by an emulator, and the predictive score of held-out summaries.

A realisation costs a second, so that summaries are emulated: each, or its logarithm, is a quadratic function of the
parameters, with a covariance that is that of realisations. The emulator is refined twice around its optimum.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats
from scipy.stats import qmc

from spotcheck.paper.rivals.summaries import IS_FITTED, IS_SCORED, SUMMARIES
from spotcheck.paper.rivals.worlds import World

# Summaries that can be negative are emulated as they are, all others by their logarithm.
PLAIN = np.array([summary.name in ("p1", "p2") for summary in SUMMARIES])
# Rounds of the emulator: realisations, and half the side of the box in which they lie, as a part of the range.
ROUNDS = ((160, 0.5), (120, 0.25), (120, 0.125))
# Starts of the search for the best parameters.
STARTS = 8
# A world is preferred if held-out summaries are this much more likely than under any other: a factor of 20.
DECISIVE_LOG_RATIO = float(np.log(20.0))
# Smallest value whose logarithm is taken.
SMALLEST = 1e-9

# Draws the summaries of one realisation from parameters in the unit cube and a random generator.
Simulator = Callable[[np.ndarray, np.random.Generator], np.ndarray]


@dataclass(frozen=True)
class Emulator:
    """Transformed summaries of a world as quadratic functions of its parameters, with their covariance."""

    centre: np.ndarray  # middle of the box, in the unit cube [parameter]
    half: np.ndarray  # half the sides of the box [parameter]
    coefficients: np.ndarray  # of the quadratic terms [term, summary]
    covariance: np.ndarray  # of a realisation about the functions [summary, summary]

    def mean(self, point: np.ndarray) -> np.ndarray:
        """Return the mean of the transformed summaries at points of the unit cube [..., parameter]."""
        return expand_quadratic((point - self.centre) / self.half) @ self.coefficients

    def bounds(self) -> optimize.Bounds:
        """Return the box within the unit cube."""
        return optimize.Bounds(np.maximum(self.centre - self.half, 0), np.minimum(self.centre + self.half, 1))


@dataclass(frozen=True)
class WorldFit:
    """Best parameters of a world for one set of summaries."""

    point: np.ndarray  # in the unit cube [parameter]
    chi2: float  # of the fitted summaries
    log_score: float  # ln of the predictive density of the held-out summaries


def transform(summaries: np.ndarray) -> np.ndarray:
    """Return summaries [..., summary] as the emulator has them."""
    return np.where(PLAIN, summaries, np.log(np.maximum(summaries, SMALLEST)))


def expand_quadratic(points: np.ndarray) -> np.ndarray:
    """Return 1, all parameters, and their products [..., term] of points [..., parameter]."""
    rows, columns = np.triu_indices(points.shape[-1])
    return np.concatenate([np.ones((*points.shape[:-1], 1)), points, points[..., rows] * points[..., columns]], axis=-1)


def build_emulator(world: World, simulate: Simulator, observed: np.ndarray, seed: int) -> tuple[Emulator, int]:
    """Return the emulator of a world around its best parameters for observed summaries, and its realisations.

    Realisations whose summaries are not finite, such as those without a spot, are left out.
    """
    size = len(world.parameters)
    centre, points, summaries = np.full(size, 0.5), np.empty((0, size)), np.empty((0, len(SUMMARIES)))
    emulator = None
    for number, (count, half) in enumerate(ROUNDS):
        cube = qmc.Sobol(size, rng=np.random.default_rng([seed, number])).random(count)
        low, high = np.maximum(centre - half, 0), np.minimum(centre + half, 1)
        drawn = low + (high - low) * cube
        results = [simulate(point, np.random.default_rng([seed, number, k])) for k, point in enumerate(drawn)]
        points, summaries = np.concatenate([points, drawn]), np.concatenate([summaries, np.array(results)])
        is_near = np.isfinite(summaries).all(axis=1) & (np.abs(points - centre) <= 1.5 * half).all(axis=1)
        emulator = _fit_emulator(points[is_near], transform(summaries[is_near]), centre, half)
        centre = fit_world(emulator, observed).point
    assert emulator is not None
    return emulator, len(points)


def _fit_emulator(points: np.ndarray, values: np.ndarray, centre: np.ndarray, half: float) -> Emulator:
    """Return the quadratic functions of least squares through transformed summaries [realisation, summary]."""
    halves = np.full(points.shape[1], half)
    terms = expand_quadratic((points - centre) / halves)
    coefficients, *_ = np.linalg.lstsq(terms, values, rcond=None)
    residuals = values - terms @ coefficients
    freedom = max(len(points) - terms.shape[1], 1)
    return Emulator(centre, halves, coefficients, residuals.T @ residuals / freedom)


def fit_world(emulator: Emulator, observed: np.ndarray) -> WorldFit:
    """Return the parameters of least χ² of the fitted summaries, and the score of the others.

    The score is the logarithm of the normal density of the held-out summaries, given the fitted ones.
    """
    data, covariance = transform(observed), emulator.covariance
    of_fitted = np.linalg.inv(covariance[np.ix_(IS_FITTED, IS_FITTED)])

    def chi2(point: np.ndarray) -> float:
        residual = (data - emulator.mean(point))[IS_FITTED]
        return float(residual @ of_fitted @ residual)

    box = emulator.bounds()
    starts = qmc.Sobol(len(box.lb), rng=np.random.default_rng(0)).random(STARTS)
    results = [optimize.minimize(chi2, box.lb + (box.ub - box.lb) * start, bounds=box) for start in starts]
    best = min(results, key=lambda result: result.fun)
    residual = data - emulator.mean(best.x)
    slope = covariance[np.ix_(IS_SCORED, IS_FITTED)] @ of_fitted
    conditional = covariance[np.ix_(IS_SCORED, IS_SCORED)] - slope @ covariance[np.ix_(IS_FITTED, IS_SCORED)]
    predicted_residual = residual[IS_SCORED] - slope @ residual[IS_FITTED]
    score = stats.multivariate_normal(cov=conditional).logpdf(predicted_residual)
    return WorldFit(best.x, float(best.fun), float(score))


def choose_world(scores: dict[str, float]) -> str | None:
    """Return the world whose held-out summaries are decisively more likely than under any other; None if none is."""
    first, second = sorted(scores, key=lambda name: scores[name], reverse=True)[:2]
    return first if scores[first] - scores[second] >= DECISIVE_LOG_RATIO else None


def p_values(realisations: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Return two-sided p-values [summary] of observed summaries among realisations [realisation, summary].

    For an upper limit, the share of realisations that keep it is given.
    """
    below, above = (realisations <= observed).sum(axis=0), (realisations >= observed).sum(axis=0)
    two_sided = np.minimum(1.0, 2 * (np.minimum(below, above) + 1) / (len(realisations) + 1))
    is_limit = np.array([summary.is_limit for summary in SUMMARIES])
    return np.where(is_limit, (below + 1) / (len(realisations) + 1), two_sided)
