"""Whether anything disagrees: statistics of what is left, each on its own scale, and one calibrated p-value.

Every statistic is nearly standardised by theory already; simulated null sets give the rest (mean, spread and skewness
of each, whatever is correlated). The test statistic is the smallest single p; its own law is that of the null sets.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from spotcheck.discrepancy.modes import Modes
from spotcheck.discrepancy.noise import Observable, band_part

# Where a fitted tail is no longer to be believed, one more decade means nothing.
DEEPEST = 300.0
# Skewness from a nearly normal law to one of rare counts; and the spread below which a statistic, of some 1 by theory,
# is a count that few null sets have: its law is not known but for its kind.
LEAST_SKEW, MOST_SKEW, LEAST_SPREAD = 0.05, 4.0, 0.2

# Grains that faint fields are looked for by [px]: one between them keeps 94 of 100 of its signal.
GRAINS = (1.0, 2.0, 4.0)


class Null(NamedTuple):
    """The law of the statistics without any effect: names, mean, spread and skewness of each, and the test statistic of
    every null set, ascending."""

    names: tuple[str, ...]
    mean: np.ndarray
    spread: np.ndarray
    skew: np.ndarray
    surprise: np.ndarray


class Detection(NamedTuple):
    """p = (1 + #)/(1 + N), how many null sets, the largest surprise (−log10 of the smallest single p), and that of
    every statistic by name."""

    p_value: float
    n_simulations: int
    surprise: float
    by_statistic: dict[str, float]


def statistics(
    modes: Modes, chi2: float, freedom: int, seen: Sequence[Observable], together: float = 1.0
) -> dict[str, float]:
    """All statistics by name; large means disagreement. `together` is the number of blocks that scatter as one."""
    out = {"mean: all blocks": (chi2 - freedom) / np.sqrt(2 * freedom * together)}
    for name, z in zip(modes._fields, modes, strict=True):
        own = z[z != 0]
        if own.size:
            out[f"mean: modes by {name}"] = cubic(float((own**2).sum()), own.size)
            if name in ("all", "grey"):
                out[f"mean: largest mode by {name}"] = float(np.abs(own).max())
    noise = [o for o in seen if o.block == "variance"]
    if noise:
        z = np.array([o.value / o.error for o in noise])
        precision = np.array([o.error**-2 for o in noise])
        out["variance: in all"] = abs(float((z * np.sqrt(precision)).sum() / np.sqrt(precision.sum())))
        out["variance: all levels"] = cubic(float((z**2).sum()), z.size)
        labels = sorted({o.label for o in noise})
        sums = [np.array([(o.value / o.error**2, o.error**-2) for o in noise if o.label == own]).sum(axis=0)
                for own in labels]  # fmt: skip
        out["variance: by level"] = cubic(float(sum(a * a / b for a, b in sums)), len(labels))
    bands = [o for o in seen if o.label == "band"]
    if bands:
        z = np.array([o.value / o.error for o in bands])
        out["spectrum: bands"] = cubic(float((z**2).sum()), z.size)
        out["spectrum: sum of bands"] = abs(float(z.sum()))
        for grain in GRAINS:
            # As a field of that grain asks for: a faint one shows in no band alone.
            share = np.array([band_part(o, grain) / o.error for o in bands])
            out[f"spectrum: grain of {grain:g} px"] = float(share @ z / np.sqrt(share @ share))
    for o in seen:
        if o.block != "variance" and o.label != "band":
            signed = o.label not in ("stripes", "hot", "outliers") and not o.label.startswith("code")
            out[f"{o.block}: {o.label}"] = abs(o.value / o.error) if signed else o.value
    return out


def cubic(total: float, count: int) -> float:
    """A sum of squares as a nearly normal number (Wilson and Hilferty 1931, doi:10.1073/pnas.17.12.684)."""
    return float(((total / count) ** (1 / 3) - 1 + 2 / (9 * count)) / np.sqrt(2 / (9 * count)))


def null_of(samples: Sequence[dict[str, float]]) -> Null:
    """The law that null sets show.

    A set that had a part in the law by which it is judged seems less odd than a new one: 400 sets would let 2 % of new
    ones pass for 1 %. So each is judged by the law of all others.
    """
    names = tuple(dict.fromkeys(name for sample in samples for name in sample))
    table = np.array([[sample.get(name, np.nan) for name in names] for sample in samples])
    own, others = moments_of(table), moments_of(table, without_one=True)
    laws = (Null(names, *law, np.zeros(0)) for law in zip(*others, strict=True))
    largest = [max(surprises(law, sample).values()) for law, sample in zip(laws, samples, strict=True)]
    return Null(names, *own, np.sort(largest))


def moments_of(table: np.ndarray, without_one: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, spread and skewness of every statistic over the sets of a table [set, statistic]; `without_one`: for each
    set, over all others [set, statistic]. NaN: a set does not have that statistic."""
    about = np.nanmean(table, axis=0)
    off = table - about
    powers = [np.nan_to_num(off**k) for k in range(4)]
    powers[0] = np.isfinite(off).astype(float)
    count, *sums = (power.sum(axis=0) - (power if without_one else 0.0) for power in powers)
    first, second, third = (total / np.maximum(count, 1.0) for total in sums)
    spread = np.sqrt(np.maximum(second - first**2, 0.0))
    rare = spread < LEAST_SPREAD
    spread = np.where(rare, LEAST_SPREAD, spread)
    skew = np.clip((third - 3 * first * second + 2 * first**3) / spread**3, LEAST_SKEW, MOST_SKEW)
    return about + first, spread, np.where(rare, MOST_SKEW, skew)


def surprises(null: Null, found: dict[str, float]) -> dict[str, float]:
    """−log10 p of every statistic by its fitted law (Pearson's third: normal with a skewness)."""
    value = np.array([found.get(name, np.nan) for name in null.names])
    z = (value - null.mean) / null.spread
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -stats.pearson3.logsf(z, null.skew) / np.log(10)
    # Far out the tail function runs dry: what is known is only that it is far.
    depth = np.where(np.isfinite(depth), depth, np.where(z > 0, DEEPEST, 0.0))
    depth = np.where(np.isnan(value), 0.0, np.minimum(depth, DEEPEST))
    return dict(zip(null.names, depth.tolist(), strict=True))


def detect(null: Null, found: dict[str, float]) -> Detection:
    """Rank of the largest surprise among those of the null sets."""
    by_statistic = surprises(null, found)
    largest = max(by_statistic.values())
    above = len(null.surprise) - int(np.searchsorted(null.surprise, largest, side="left"))
    return Detection((1 + above) / (1 + len(null.surprise)), len(null.surprise), largest, by_statistic)
