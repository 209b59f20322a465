"""From sums over cells to p-values, by laws of which a few moments are known."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from spotcheck.discrepancy.evidence.cells import COUNT, FOURTH, NORM, SQUARE, SQUARE_NORM, SUM, TAKEN, THIRD, Cells

# A p-value below this is not told from 0.
SMALLEST = 1e-300
# A cell's sum counts as nearly normal up to this skewness and kurtosis: beyond, it is that of a few rare readings.
# In a largest value the tail of one cell decides, in a sum of squares that of all.
MOST_SKEWED, MOST_PEAKED = 1.0, 8.0
# A cell that the frames' own numbers take more than this part of says little, and its law less.
MOST_TAKEN = 0.9
# Of a learned shape a few draws tell what it takes, to a third or so: where it takes more than this part, what is left
# is not known.
MOST_DRAWN = 0.4


class Part(NamedTuple):
    """One question to the frames: its name, the statistic (in its own standard errors), the p-value, and where the
    frames are oddest."""

    name: str
    statistic: float
    p_value: float
    where: str = ""


class Standing(NamedTuple):
    """Sums of a group of cells in their own standard errors before anything was fitted [cell]; what was taken by the
    frames' numbers [cell, number], and of the variance by a learned shape [cell]; skewness and excess kurtosis [cell],
    and the labels [cell, 2]."""

    z: np.ndarray
    taken: np.ndarray
    drawn: np.ndarray
    skewness: np.ndarray
    kurtosis: np.ndarray
    label: np.ndarray


def standing(cells: Cells) -> Standing:
    """The linear sums of cells."""
    cells = Cells(*(own[cells.sums[:, NORM] > 0] for own in cells))
    sums, norm = cells.sums, cells.sums[:, NORM]
    kurtosis, taken = sums[:, FOURTH] / norm**2, sums[:, TAKEN:] / np.sqrt(norm)[:, None]
    drawn = (cells.drawn**2).sum(axis=1) / norm
    good = kurtosis < MOST_PEAKED
    out = Standing(sums[:, SUM] / np.sqrt(norm), taken, drawn, sums[:, THIRD] / norm**1.5, kurtosis, cells.label)
    return Standing(*(own[good] for own in out))


def standing_squares(cells: Cells) -> Standing:
    """The sums of squares of cells. Squares of normal readings have skewness √8 and excess kurtosis 12; where readings
    are rare, these grow like κ₄, by its mean over the cell."""
    sums = cells.sums[cells.sums[:, SQUARE_NORM] > 0]
    label = cells.label[cells.sums[:, SQUARE_NORM] > 0]
    norm, count = sums[:, SQUARE_NORM], sums[:, COUNT]
    peaked = np.maximum(norm / count - 2, 0.0)
    skewness, kurtosis = np.sqrt((8 + peaked) / count), (12 + peaked) / count
    good = kurtosis < MOST_PEAKED
    taken, drawn = np.zeros((len(sums), 0)), np.zeros(len(sums))
    out = Standing(sums[:, SQUARE] / np.sqrt(norm), taken, drawn, skewness, kurtosis, label)
    return Standing(*(own[good] for own in out))


# Words for a cell: the number of its group and its label.
Words = Callable[[int, tuple[int, int]], str]


def well_known(groups: Sequence[Standing]) -> list[Standing]:
    """The cells of which it is known how much a learned shape leaves."""
    return [Standing(*(column[own.drawn < MOST_DRAWN] for column in own)) for own in groups]


class Form(NamedTuple):
    """Σ z² over cells, its first three cumulants, and the oddest cell: |z| and its words."""

    total: float
    first: float
    second: float
    third: float
    worst: tuple[float, str]


def form_of(groups: Sequence[Standing], words: Words) -> Form:
    """Σ z² of all cells; groups are independent of each other.

    It is a quadratic form of nearly normal numbers of covariance C = 1 − FFᵀ: cumulants tr C, 2 tr C² + Σκ₄ and
    8 tr C³ + Σ(12 κ₄ + 10 κ₃²). What a learned shape takes is nearly a projection: degrees of freedom, no more.
    """
    total = first = second = third = 0.0
    worst = -1.0, ""
    for at, own in enumerate(groups):
        if not own.z.size:
            continue
        gram = own.taken.T @ own.taken
        one, two = float(np.trace(gram)), float((gram**2).sum())
        three = float((gram @ gram * gram).sum())
        count = own.z.size - float(own.drawn.sum())
        total += float(own.z @ own.z)
        first += count - one
        second += 2 * (count - 2 * one + two) + float(own.kurtosis.sum())
        third += 8 * (count - 3 * one + 3 * two - three) + float((12 * own.kurtosis + 10 * own.skewness**2).sum())
        j = int(np.argmax(np.abs(own.z)))
        if abs(own.z[j]) > worst[0]:
            worst = float(abs(own.z[j])), words(at, tuple(own.label[j].tolist()))
    return Form(total, first, second, third, worst)


def excess_part(name: str, form: Form, within: Form | None = None) -> Part | None:
    """Whether squares add up to more than they should, by Pearson's third law of their cumulants.

    `within` are sums of the same cells over more readings, which another part asks for: they are taken off, so that
    parts tell different things and their p-values are nearly independent. What projections onto nested spaces leave
    has the cumulants' differences.
    """
    total, first, second, third = (
        one - (two if within else 0.0) for one, two in zip(form[:4], (within or form)[:4], strict=True)
    )
    # Less than half a degree of freedom is rounding, or cells that are the same.
    if first < 0.5 or second < 0.5:
        return None
    statistic = (total - first) / np.sqrt(second)
    return Part(name, float(statistic), upper_tail(statistic, third / second**1.5), form.worst[1])


def largest(name: str, groups: Sequence[Standing], words: Words) -> Part | None:
    """Whether one cell is odder than the oddest of so many should be (Šidák), each by its own skewness."""
    best, count, found = 2.0, 0, None
    for at, own in enumerate(groups):
        left = 1 - (own.taken**2).sum(axis=1) - own.drawn
        good = (np.abs(own.skewness) < MOST_SKEWED) & (left > 1 - MOST_TAKEN)
        z = own.z[good] / np.sqrt(left[good])
        if not z.size:
            continue
        count += z.size
        p = two_sided(z, own.skewness[good])
        j = int(np.argmin(p))
        if p[j] < best:
            best, found = float(p[j]), (float(z[j]), words(at, tuple(own.label[good][j].tolist())))
    if found is None:
        return None
    return Part(name, found[0], sidak(best, count), found[1])


def evened(form: Form, total: float, variance: float) -> Form:
    """Sums of squares beside their common excess: what they add up to, `total` of a `variance`, is taken off."""
    return form._replace(total=form.total - total**2 / variance, first=form.first - 1, second=form.second - 2,
                         third=form.third - 8)  # fmt: skip


def normal(name: str, total: float, variance: float) -> Part | None:
    """Whether a sum of very many readings is off, on either side."""
    if variance <= 0:
        return None
    z = float(total / np.sqrt(variance))
    return Part(name, z, float(2 * special.ndtr(-abs(z))))


def upper_tail(z: float, skewness: float) -> float:
    """P(> z) of Pearson's third law, standardised."""
    if skewness < 1e-4:
        return float(max(special.ndtr(-z), SMALLEST))
    shape = 4 / skewness**2
    return float(max(special.gammaincc(shape, max(shape + z * np.sqrt(shape), 0.0)), SMALLEST))


def two_sided(z: np.ndarray, skewness: np.ndarray) -> np.ndarray:
    """Twice the smaller tail of Pearson's third law, standardised, of skewness of either sign."""
    size = np.maximum(np.abs(skewness), 1e-3)
    up = np.where(skewness < 0, -z, z)
    shape = 4 / size**2
    at = np.maximum(shape + up * np.sqrt(shape), 0.0)
    # With so little skewness gamma functions of large shapes lose their digits.
    plain = size < 5e-3
    above = np.where(plain, special.ndtr(-up), special.gammaincc(shape, at))
    below = np.where(plain, special.ndtr(up), special.gammainc(shape, at))
    return np.clip(2 * np.minimum(above, below), SMALLEST, 1.0)


def sidak(smallest: float, count: float) -> float:
    """The p-value of the smallest of `count` p-values."""
    return float(max(-np.expm1(count * np.log1p(-min(smallest, 1.0))), SMALLEST)) if smallest < 1 else 1.0


def cauchy(values: Sequence[float]) -> float:
    """p-values of any dependence joined (Liu & Xie 2020, doi:10.1080/01621459.2018.1554485): right where small."""
    p = np.clip(np.asarray(values, float), 1e-15, 1 - 1e-3)
    return float(stats.cauchy.sf(np.mean(np.tan((0.5 - p) * np.pi))))
