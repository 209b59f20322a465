"""95 % intervals of shares and of statistics."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy import stats


def wilson(hits: int, count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of a share (Wilson 1927, doi:10.1080/01621459.1927.10502953)."""
    if count == 0:
        return 0.0, 1.0
    z = float(stats.norm.isf((1 - confidence) / 2))
    share, more = hits / count, z * z / count
    middle, half = (share + more / 2) / (1 + more), z * np.sqrt(share * (1 - share) / count + more / (4 * count))
    half /= 1 + more
    return (float(middle - half) if hits else 0.0), (float(middle + half) if hits < count else 1.0)


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
