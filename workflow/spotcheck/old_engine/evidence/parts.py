"""From sums over cells to p-values: one law of sums of squares, one way to join them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

from spotcheck.old_engine import criteria
from spotcheck.old_engine.evidence.cells import COUNT, FOURTH, NORM, SQUARE, SQUARE_NORM, SUM, TAKEN, Cells

# A p-value below this is not told from 0.
SMALLEST = 1e-300
# Excess kurtosis beyond which a cell's sum is that of a few rare readings, and has no law that two moments tell.
MOST_PEAKED = 8.0


class Part(NamedTuple):
    """One question to the frames: its name, the statistic (in its own standard errors), the p-value, where the frames
    are oddest, and how odd all such places are together (z: the root of χ² beyond its mean, with the sign there)."""

    name: str
    statistic: float
    p_value: float
    where: str = ""
    z: float = 0.0


class Standing(NamedTuple):
    """Sums of a group of cells in their own standard errors before anything was fitted [cell]; what was taken by the
    frames' numbers [cell, number], and of the variance by a learned shape [cell]; excess kurtosis [cell], and the
    labels [cell, 2]."""

    z: np.ndarray
    taken: np.ndarray
    drawn: np.ndarray
    kurtosis: np.ndarray
    label: np.ndarray


def standing_of(z: np.ndarray, taken: np.ndarray, label: np.ndarray) -> Standing:
    """Normal numbers of which no shape takes anything, of a one-column label [cell]."""
    return Standing(z, taken, 0 * z, 0 * z, np.stack([label, 0 * label], 1))


def standing(cells: Cells, *, squares: bool = False) -> Standing:
    """The sums of cells whose law is known, linear ones or of squares. Squares of normal readings have an excess
    kurtosis of 12; where readings are rare, it grows like κ₄, by its mean over the cell."""
    sums, count = cells.sums, np.maximum(cells.sums[:, COUNT], 1.0)
    norm = np.maximum(sums[:, SQUARE_NORM if squares else NORM], SMALLEST)
    drawn, taken = (cells.drawn**2).sum(axis=1) / norm, sums[:, TAKEN:] / np.sqrt(norm)[:, None]
    kurtosis = sums[:, FOURTH] / np.maximum(norm**2, SMALLEST)
    if squares:
        drawn, taken, kurtosis = 0 * drawn, taken[:, :0], (12 + np.maximum(norm / count - 2, 0.0)) / count
    good = (norm > SMALLEST) & (kurtosis < MOST_PEAKED) & (drawn < criteria.DRAWN.value)
    every = sums[:, SQUARE if squares else SUM] / np.sqrt(norm), taken, drawn, kurtosis, cells.label
    return Standing(*(own[good] for own in every))


class Form(NamedTuple):
    """Σ z² over cells, its mean and variance, and the oddest cell: z, its group and its label."""

    total: float
    mean: float
    variance: float
    worst: tuple[float, int, tuple[int, int]]


def form_of(groups: Sequence[Standing]) -> Form:
    """Σ z² of all cells; groups are independent of each other.

    It is a quadratic form of nearly normal numbers of covariance C = 1 − FFᵀ: mean tr C, variance 2 tr C² + Σκ₄. What a
    learned shape takes is nearly a projection: degrees of freedom, no more.
    """
    total = mean = variance = 0.0
    worst = 0.0, 0, (0, 0)
    for at, own in enumerate(groups):
        if not own.z.size:
            continue
        gram = own.taken.T @ own.taken
        count, one = own.z.size - float(own.drawn.sum()), float(np.trace(gram))
        total += float(own.z @ own.z)
        mean += count - one
        variance += 2 * (count - 2 * one + float((gram**2).sum())) + float(own.kurtosis.sum())
        j = int(np.argmax(np.abs(own.z)))
        if abs(own.z[j]) > abs(worst[0]):
            worst = float(own.z[j]), at, (int(own.label[j, 0]), int(own.label[j, 1]))
    return Form(total, mean, variance, worst)


def part_of(name: str, form: Form, where: str) -> Part | None:
    """Whether squares add up to more than they should. Less than half a degree of freedom is rounding, or cells that
    are the same."""
    if min(form.mean, form.variance) < 0.5:
        return None
    statistic = (form.total - form.mean) / np.sqrt(form.variance)
    z = float(np.copysign(np.sqrt(max(form.total - form.mean, 0.0)), form.worst[0]))
    return Part(name, float(statistic), float(upper(form.total, form.mean, form.variance)), where, z)


def upper(total, mean, variance):
    """P(> total) of a sum of squares of that mean and variance: χ² of as many degrees of freedom as have them, scaled
    (Satterthwaite 1946, doi:10.2307/3002019)."""
    return np.maximum(special.gammaincc(mean**2 / variance, np.maximum(total, 0.0) * mean / variance), SMALLEST)


def lower(total, mean, variance):
    """P(< total) by the same law."""
    return np.maximum(special.gammainc(mean**2 / variance, np.maximum(total, 0.0) * mean / variance), SMALLEST)


def smallest_of(p: float, count: float) -> float:
    """The p-value of the smallest of `count` p-values (Šidák); right for independent ones, safe for such as rise and
    fall together."""
    return float(max(-np.expm1(count * np.log1p(-min(p, 1.0))), SMALLEST)) if p < 1 else 1.0
