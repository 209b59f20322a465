"""What is left as a field: do neighbours look alike, and is there a peak in its spectrum.

Of a field a z with z of variance 1 the products of all pairs of pixels, weighed by a kernel K of their distance, add up
to Σ aᵢzᵢ K(i − j) aⱼzⱼ over i ≠ j: mean 0 less what fits take, variance 2 Σ aᵢ² K² aⱼ², whatever the law of z. Both are
sums over lags, on a window that closes on itself.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import fft, special

from spotcheck.old_engine import criteria
from spotcheck.old_engine.evidence.parts import Part, lower, smallest_of, upper

# Standard deviations of the kernels in steps; of wider structure cells tell more.
GRAINS = (0.7, 2.0, 5.6)
# Padding of a field before its peak is sought: between two frequencies of this grid a peak loses 3 % at most.
PADDED = 2


class Field(NamedTuple):
    """Sums over frames in one window [row, column]: a z and a²; and of pairs what fits take, and of half their variance
    in parts of Σ a² [2, grain]."""

    pull: np.ndarray
    weight: np.ndarray
    taken: np.ndarray

    def add(self, at: tuple[slice, slice], other: "Field") -> None:
        """Add another field in its place."""
        self.pull[at] += other.pull
        self.weight[at] += other.weight
        self.taken[:] += other.taken


def empty(shape: tuple[int, int]) -> Field:
    """A field of no frame."""
    return Field(np.zeros(shape), np.zeros(shape), np.zeros((2, len(GRAINS))))


def field_of(z: np.ndarray, weight: np.ndarray, shape: tuple[int, int], taken: np.ndarray | float = 0.0) -> Field:
    """The field of a frame's z with weights a [pixel], and what fits take of its pairs (`taken_of`)."""
    # What one frame's numbers take of the variance of pairs they take in all frames.
    part = taken / np.array([[1.0], [max(float(weight @ weight), 1e-300)]])
    return Field((weight * z).reshape(shape), (weight * weight).reshape(shape), part * np.ones(len(GRAINS)))


class Pairs(NamedTuple):
    """Sum over pairs of pixels, Σ a² on top, its mean and its variance [grain]."""

    value: np.ndarray
    mean: np.ndarray
    variance: np.ndarray


@lru_cache(maxsize=4)
def kernels_of(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spectra of K and of K² [grain, frequency row, frequency column], and the weight of each frequency [column] in a
    sum over lags, where half of them stand for all."""
    y, x = (np.minimum(np.arange(n), n - np.arange(n)) for n in (rows, columns))
    kernels = np.stack([np.exp(-(y[:, None] ** 2 + x**2) / (2 * grain**2)) for grain in GRAINS])
    kernels[:, 0, 0] = 0
    twice = np.full(columns // 2 + 1, 2.0)
    twice[[0] if columns % 2 else [0, -1]] = 1.0
    return fft.rfft2(kernels).real, fft.rfft2(kernels**2).real, twice / (rows * columns)


def _power(spectra: np.ndarray) -> np.ndarray:
    """|·|² of spectra [field, frequency row, frequency column], all fields together."""
    return (spectra.real**2 + spectra.imag**2).sum(axis=0)


def taken_of(taken: np.ndarray, shape: tuple[int, int], weight: np.ndarray) -> np.ndarray:
    """What fits take of the pairs of the field `weight` z of a frame, and of half their variance [2, grain]; `taken`
    [column, pixel] as of `Standard`."""
    kernels, _, half = kernels_of(*shape)
    # Single precision is enough for what is taken off.
    spectra = fft.rfft2((taken * weight).astype(np.float32).reshape(-1, *shape))
    power = half * _power(spectra)
    if (weight == 1).all():
        square = list(np.tensordot(kernels**2, power, 2))
    else:
        image = weight.astype(np.float32).reshape(shape)
        square = [np.sum((fft.irfft2(spectra * own, s=shape) * image) ** 2) for own in kernels.astype(np.float32)]
    return np.stack([np.tensordot(kernels, power, 2), square])


def pairs_of(field: Field) -> Pairs:
    """Pairs of a field, and their law."""
    kernels, squares, half = kernels_of(*field.pull.shape)
    pull, weight = (half * _power(fft.rfft2(own)[None]) for own in (field.pull, field.weight))
    total, every = float(field.weight.sum()), np.tensordot(squares, weight, 2)
    variance = 2 * np.maximum(every - total * field.taken[1], 0.1 * every)
    return Pairs(total + np.tensordot(kernels, pull, 2), total - field.taken[0], variance)


def grain_part(name: str, pairs: Sequence[Pairs], step: int) -> Part | None:
    """Whether pixels look more or less alike than they should, over some grain, in independent fields together, each in
    units of what it should have."""
    units = [np.where(own.mean > 0, own.mean, np.inf) for own in pairs]
    value = np.sum([own.value / unit for own, unit in zip(pairs, units, strict=True)], axis=0)
    mean = np.sum([own.mean > 0 for own in pairs], axis=0)
    variance = np.sum([own.variance / unit**2 for own, unit in zip(pairs, units, strict=True)], axis=0)
    good = variance > 0
    if not good.any():
        return None
    value, mean, variance, grain = value[good], mean[good], variance[good], np.array(GRAINS)[good]
    p = np.minimum(2 * np.minimum(upper(value, mean, variance), lower(value, mean, variance)), 1.0)
    z, beyond = (value - mean) / np.sqrt(variance), 2 * mean / variance * (value - mean)
    j = int(np.argmin(p))
    size = float(np.sign(beyond[j]) * np.sqrt(abs(beyond[j])))
    return Part(name, float(z[j]), smallest_of(float(p[j]), p.size), f"grain of {step * grain[j]:.2g} px", size)


def peak_part(name: str, fields: Sequence[Field], step: int) -> Part | None:
    """Whether the highest peak of the fields' power together is too high: a χ² field of two degrees of freedom a field,
    by the expected Euler characteristic of what lies above (Worsley 1994, doi:10.2307/1427576)."""
    fields = [own for own in fields if own.weight.any()]
    if not fields:
        return None
    padded = tuple(PADDED * side for side in fields[0].pull.shape)
    ky, kx = fft.fftfreq(padded[0])[:, None], fft.rfftfreq(padded[1])[None, :]
    power, spread = np.zeros((padded[0], padded[1] // 2 + 1)), np.zeros((2, 2))
    for field in fields:
        power += 2 / float(field.weight.sum()) * np.abs(fft.rfft2(field.pull, s=padded)) ** 2
        spread += _spread(field.weight) / len(fields)
    # Below, the spot's numbers take part, and cosine and sine are no longer alike. Squared weights are those of a light
    # whose σ is narrower by √2.
    sigma = np.sqrt(2 * np.sqrt(max(float(np.linalg.det(spread)), 1e-12)))
    low = 1 / (criteria.LONGEST.value * sigma)
    radius = np.hypot(ky, kx)
    high = 0.5 - low
    sought = (radius >= low) & (radius <= high)
    if not sought.any():
        return None
    power[~sought] = 0
    j, i = np.unravel_index(int(np.argmax(power)), power.shape)
    freedom = 2 * len(fields)
    area, edge = np.pi / 2 * (high**2 - low**2), np.pi / 2 * (high + low)
    p = chance_of_peak(float(power[j, i]), freedom, 4 * np.pi**2 * spread, area, edge)
    period, turn = step / radius[j, i], np.degrees(np.arctan2(ky[j, 0], kx[0, i])) % 180
    beyond, where = float(power[j, i] - freedom), f"stripes of {period:.1f} px across {turn:.0f}°"
    return Part(name, beyond / np.sqrt(2 * freedom), p, where, float(np.sqrt(max(beyond, 0.0))))


def _spread(weight: np.ndarray) -> np.ndarray:
    """Covariance [2, 2] in px² of places weighted by a field's weight."""
    rows, columns = (np.arange(n, dtype=float) for n in weight.shape)
    total = weight.sum()
    down, along = weight.sum(axis=1), weight.sum(axis=0)
    y, x = down @ rows / total, along @ columns / total
    both = float((rows - y) @ weight @ (columns - x)) / total
    return np.array([[down @ (rows - y) ** 2 / total, both], [both, along @ (columns - x) ** 2 / total]])


def chance_of_peak(level: float, freedom: int, gradient: np.ndarray, area: float, edge: float) -> float:
    """The chance that a χ² field gets above a level somewhere: from the expected Euler characteristic of what lies
    above, peaks that come as Poisson's. `gradient` is the covariance of the slopes of its normal components, `edge`
    half the length of the region's boundary."""
    if level <= freedom + 1:
        return 1.0
    log = (freedom - 2) / 2 * np.log(level / 2) - level / 2 - special.gammaln(freedom / 2)
    size = np.sqrt(np.linalg.det(gradient))
    two = area * size * (level - freedom + 1) / (2 * np.pi)
    one = edge * np.sqrt(size) * np.sqrt(level) / np.sqrt(2 * np.pi)
    return float(np.clip(-np.expm1(-(two + one) * np.exp(log)), 1e-300, 1.0))
