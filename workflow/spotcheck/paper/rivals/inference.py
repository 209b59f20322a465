"""Fit of a world to summaries by an emulator, and the predictive score of held-out summaries.

A world is a forward model with free parameters that could have made the paper's frames. A summary is a number that the
paper prints about its frames, such as the largest amplitude. A realisation is the set of summaries of one random
simulation of all frames. A point of the unit cube gives each parameter a value between its limits.

A realisation costs a second. Summaries are therefore emulated: the logarithm of each is a quadratic function of the
parameters, with the covariance of realisations. The emulator is refined around the best of several points, of which its
optimum is one. Realisations at each of them decide, since a quadratic function over the whole cube may mislead.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize, stats
from scipy.stats import qmc

from spotcheck.paper.rivals.summaries import IS_FITTED, IS_SCORED, PRINTED, SUMMARIES
from spotcheck.paper.rivals.worlds import World

# No world is exact: each logarithm of a summary may be off by this much, in the same way for all worlds.
# ASSUME: 3 % for p1, the width at 500 µs and means, 10 % for all else, independently for each summary.
DISCREPANCY = np.where([summary.is_mean for summary in SUMMARIES], 0.03, 0.1)
# Rounds of the emulator: realisations, and half the side of the box in which they lie, as a part of the range. The last
# one is repeated around each new best point until the emulator's optimum is the best and lies inside the box, up to
# this number of rounds in all.
ROUNDS = ((160, 0.5), (120, 0.25), (120, 0.15))
MAX_ROUNDS = 8
# Realisations at each point that is compared: the mean of a summary then has a quarter of its standard deviation.
TRIALS = 16
# Distance from the edge of the box, as a part of half its side, below which a parameter counts as stopped by the edge.
EDGE = 1e-3
# Starts of the search for the best parameters.
STARTS = 8
# A world is preferred if held-out summaries are this much more likely than under any other: a factor of 20.
DECISIVE_LOG_RATIO = float(np.log(20.0))
# Part of the printed value below which a summary counts as this part of it. A spread may be 0, whose logarithm would
# outweigh all other summaries.
LEAST_SHARE = 0.1

# Draws the summaries [point, summary] of one realisation at each point [point, parameter] of the unit cube; the key
# distinguishes the random numbers of several calls.
Simulator = Callable[[np.ndarray, int], np.ndarray]


@dataclass(frozen=True)
class Emulator:
    """Logarithms of the summaries of a world as quadratic functions of its parameters, with their covariance.

    The box is the part of the unit cube in which the realisations lie to which the functions were fitted.
    """

    centre: np.ndarray  # middle of the box, in the unit cube [parameter]
    half: np.ndarray  # half the sides of the box [parameter]
    coefficients: np.ndarray  # coefficients of the quadratic terms [term, summary]
    covariance: np.ndarray  # covariance of a realisation about the functions [summary, summary]
    has_converged: bool = False  # whether realisations confirm that the optimum is the best point and inside the box

    def mean(self, point: np.ndarray) -> np.ndarray:
        """Return the mean of the transformed summaries at points of the unit cube [..., parameter]."""
        return expand_quadratic((point - self.centre) / self.half) @ self.coefficients

    def bounds(self) -> optimize.Bounds:
        """Return the box within the unit cube."""
        return optimize.Bounds(np.maximum(self.centre - self.half, 0), np.minimum(self.centre + self.half, 1))


@dataclass(frozen=True)
class WorldFit:
    """Best parameters of a world for one set of summaries."""

    point: np.ndarray  # parameters in the unit cube [parameter]
    chi2: float  # χ² of the fitted summaries
    log_score: float  # ln of the predictive density of the held-out summaries
    # Whether a parameter lies at an edge of the emulator's box that is not a limit of the parameter [parameter].
    at_edge: np.ndarray


def transform(summaries: np.ndarray) -> np.ndarray:
    """Return the logarithms of summaries [..., summary], which the emulator uses.

    Values below `LEAST_SHARE` of the printed ones count as this share of them.
    """
    return np.log(np.maximum(summaries, LEAST_SHARE * PRINTED))


def expand_quadratic(points: np.ndarray) -> np.ndarray:
    """Return the terms of a quadratic function at points [..., parameter].

    The terms [..., term] are 1, each parameter, and the products of all pairs of parameters, including squares.
    """
    rows, columns = np.triu_indices(points.shape[-1])
    return np.concatenate([np.ones((*points.shape[:-1], 1)), points, points[..., rows] * points[..., columns]], axis=-1)


def build_emulator(world: World, simulate: Simulator, observed: np.ndarray, seed: tuple[int, ...]) -> Emulator:
    """Return the emulator of a world around its best parameters for observed summaries.

    Parameters
    ----------
    world : World
        The world.
    simulate : Simulator
        Draws realisations of the world.
    observed : ndarray
        Observed summaries [summary], in the order of `SUMMARIES`.
    seed : tuple of int
        Seed of the points at which the world is simulated.

    Notes
    -----
    Realisations whose summaries are not finite, such as those without a spot, are left out.
    """
    size = len(world.parameters)
    centre, points, summaries = np.full(size, 0.5), np.empty((0, size)), np.empty((0, len(SUMMARIES)))
    emulator = None
    for number in range(MAX_ROUNDS):
        count, half = ROUNDS[min(number, len(ROUNDS) - 1)]
        cube = qmc.LatinHypercube(size, rng=np.random.default_rng([*seed, number])).random(count)
        low, high = np.maximum(centre - half, 0), np.minimum(centre + half, 1)
        drawn = low + (high - low) * cube
        points, summaries = np.concatenate([points, drawn]), np.concatenate([summaries, simulate(drawn, number)])
        is_near = np.isfinite(summaries).all(axis=1) & (np.abs(points - centre) <= 1.5 * half).all(axis=1)
        near, values = points[is_near], transform(summaries[is_near])
        emulator = _fit_emulator(near, values, centre, half)
        optimum = fit_world(emulator, observed)
        # Points that may be the best: the emulator's optimum, the nearest realisation, and the one of the round before.
        nearest = near[np.argmin([_chi2_of_residual(emulator, transform(observed) - row) for row in values])]
        candidates = np.array([optimum.point, nearest, centre])
        # Keys from MAX_ROUNDS on: random numbers apart from those of the rounds.
        trials = simulate(np.repeat(candidates, TRIALS, axis=0), MAX_ROUNDS + number)
        chi2 = []
        for realisations in transform(trials).reshape(len(candidates), TRIALS, -1):
            finite = realisations[np.isfinite(realisations).all(axis=1)]
            residual = transform(observed) - finite.mean(axis=0) if len(finite) else None
            chi2.append(np.inf if residual is None else _chi2_of_residual(emulator, residual))
        best_index = int(np.argmin(chi2))  # 0 for the emulator's optimum
        if number >= len(ROUNDS) - 1 and best_index == 0 and not optimum.at_edge.any():
            return replace(emulator, has_converged=True)
        centre = candidates[best_index]
    assert emulator is not None
    return emulator


def describe_at_point(emulator: Emulator, point: np.ndarray, realisations: np.ndarray) -> Emulator:
    """Return an emulator with the mean and the covariance of realisations at a point.

    `point` [parameter] is in the unit cube, and `realisations` are [realisation, summary]. The slopes of the result are
    those of the given emulator.
    """
    values = transform(realisations)
    coefficients = emulator.coefficients.copy()
    coefficients[0] += values.mean(axis=0) - emulator.mean(point)
    return replace(emulator, coefficients=coefficients, covariance=_add_discrepancy(np.cov(values, rowvar=False)))


def _fit_emulator(points: np.ndarray, values: np.ndarray, centre: np.ndarray, half: float) -> Emulator:
    """Return the emulator that fits realisations best in least squares.

    `points` [realisation, parameter] lie in a box of the unit cube with the middle `centre` [parameter] and half the
    side `half`. `values` [realisation, summary] are logarithms of summaries.
    """
    halves = np.full(points.shape[1], half)
    terms = expand_quadratic((points - centre) / halves)
    coefficients, *_ = np.linalg.lstsq(terms, values, rcond=None)
    residuals = values - terms @ coefficients
    freedom = max(len(points) - terms.shape[1], 1)
    return Emulator(centre, halves, coefficients, _add_discrepancy(residuals.T @ residuals / freedom))


def _add_discrepancy(covariance: np.ndarray) -> np.ndarray:
    """Return a covariance of logarithms [summary, summary] with that of `DISCREPANCY` added."""
    return covariance + np.diag(DISCREPANCY**2)


def fit_world(emulator: Emulator, observed: np.ndarray) -> WorldFit:
    """Return the parameters of least χ² of the fitted summaries, and the log score of the held-out ones.

    `observed` are summaries [summary] in the order of `SUMMARIES`.
    """
    box = emulator.bounds()
    starts = qmc.Sobol(len(box.lb), rng=np.random.default_rng(0)).random(STARTS)
    results = [
        optimize.minimize(
            lambda point: chi2_of_fitted(emulator, observed, point), box.lb + (box.ub - box.lb) * start, bounds=box
        )
        for start in starts
    ]
    best = min(results, key=lambda result: result.fun)
    is_low, is_high = best.x - box.lb < EDGE * emulator.half, box.ub - best.x < EDGE * emulator.half
    at_edge = (is_low & (box.lb > 0)) | (is_high & (box.ub < 1))
    return WorldFit(best.x, float(best.fun), score_held_out(emulator, observed, best.x), at_edge)


def chi2_of_fitted(emulator: Emulator, observed: np.ndarray, point: np.ndarray) -> float:
    """Return χ² of the fitted ones among observed summaries [summary], at a point [parameter] of the unit cube."""
    return _chi2_of_residual(emulator, transform(observed) - emulator.mean(point))


def _chi2_of_residual(emulator: Emulator, residual: np.ndarray) -> float:
    """Return χ² of the fitted ones among residuals of logarithms [summary]."""
    fitted = residual[IS_FITTED]
    return float(fitted @ np.linalg.solve(emulator.covariance[np.ix_(IS_FITTED, IS_FITTED)], fitted))


def score_held_out(emulator: Emulator, observed: np.ndarray, point: np.ndarray) -> float:
    """Return ln of the normal density of the held-out summaries, given the fitted ones.

    `observed` are summaries [summary], `point` are parameters in the unit cube [parameter].
    """
    residual = transform(observed) - emulator.mean(point)
    covariance = emulator.covariance
    slope = np.linalg.solve(covariance[np.ix_(IS_FITTED, IS_FITTED)], covariance[np.ix_(IS_FITTED, IS_SCORED)]).T
    conditional = covariance[np.ix_(IS_SCORED, IS_SCORED)] - slope @ covariance[np.ix_(IS_FITTED, IS_SCORED)]
    return float(stats.multivariate_normal(cov=conditional).logpdf(residual[IS_SCORED] - slope @ residual[IS_FITTED]))


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
