"""95 % intervals of shares and of statistics."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy import stats


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
