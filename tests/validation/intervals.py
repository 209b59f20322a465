"""95 % intervals of shares and of statistics, and the weakest effect that is found in 90 of 100."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy import stats
from scipy.optimize import isotonic_regression

POWER = 0.9
# Sets without which a curve means nothing.
LEAST = 20


def clopper_pearson(hits: int, count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact interval of a share (Clopper and Pearson 1934, doi:10.1093/biomet/26.4.404)."""
    if count == 0:
        return 0.0, 1.0
    tail = (1 - confidence) / 2
    low = stats.beta.ppf(tail, hits, count - hits + 1) if hits else 0.0
    high = stats.beta.ppf(1 - tail, hits + 1, count - hits) if hits < count else 1.0
    return float(low), float(high)


def bootstrap(
    values: Sequence[float] | np.ndarray, statistic: Callable[[np.ndarray], float], rounds: int = 1000
) -> tuple[float, float]:
    """Percentiles of a statistic over resampled rows."""
    rows = np.asarray(values, float)
    if not len(rows):
        return float("nan"), float("nan")
    rng = np.random.default_rng(1)
    found = [statistic(rows[rng.integers(0, len(rows), len(rows))]) for _ in range(rounds)]
    low, high = np.nanquantile(found, [0.025, 0.975])
    return float(low), float(high)


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
