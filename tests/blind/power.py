"""The weakest effect that is found in 90 of 100, from sets of all strengths."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import isotonic_regression

from tests.blind.intervals import bootstrap

POWER = 0.9
# Sets without which a curve means nothing.
LEAST = 20


def weakest(rows: Sequence[tuple[float, float]]) -> tuple[float, tuple[float, float]]:
    """Strength over limit from which the power is reached, with its interval.

    `rows` are (strength over limit, 1 if found else 0). Of the curve nothing is assumed but that it rises: effects that
    are found far below their limit, such as stripes, would flatten any curve of two numbers. Below 200 sets the value
    is some 5 % low.
    """
    table = np.array(rows, float).reshape(-1, 2)
    if len(table) < LEAST or len(np.unique(table[:, 1])) < 2:
        return float("nan"), (float("nan"), float("nan"))
    return _at_power(table), bootstrap(table, _at_power, rounds=200)


def _at_power(table: np.ndarray) -> float:
    table = table[np.argsort(table[:, 0], kind="stable")]
    risen = isotonic_regression(table[:, 1]).x >= POWER - 1e-9
    return float(table[np.argmax(risen), 0]) if risen.any() else float("nan")
