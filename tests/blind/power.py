"""The weakest effect that is found in 90 of 100, from sets of all strengths."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

from tests.blind.intervals import bootstrap

POWER = 0.9
# Sets without which a curve means nothing.
LEAST = 20


def weakest(rows: Sequence[tuple[float, float]]) -> tuple[float, tuple[float, float]]:
    """Strength over limit at which a logistic curve in its logarithm reaches the power, with its interval.

    `rows` are (strength over limit, 1 if found else 0).
    """
    table = np.array(rows, float).reshape(-1, 2)
    if len(table) < LEAST or len(np.unique(table[:, 1])) < 2:
        return float("nan"), (float("nan"), float("nan"))
    return _at_power(table), bootstrap(table, _at_power, rounds=200)


def _at_power(table: np.ndarray) -> float:
    x, found = np.log(table[:, 0]), table[:, 1]

    def cost(p: np.ndarray) -> float:
        z = np.exp(p[1]) * (x - p[0])
        # A weak pull to a sensible steepness holds the curve where the two kinds of sets do not overlap.
        return float(np.sum(np.logaddexp(0, -z) * found + np.logaddexp(0, z) * (1 - found)) + 0.05 * (p[1] - 1.5) ** 2)

    best = minimize(cost, [0.0, 1.5], method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-6})
    middle, steepness = best.x[0], np.exp(best.x[1])
    return float(np.exp(middle + np.log(POWER / (1 - POWER)) / steepness))
