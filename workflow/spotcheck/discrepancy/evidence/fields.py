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

from spotcheck.discrepancy.evidence.cells import Standard
from spotcheck.discrepancy.evidence.parts import Part, lower, smallest_of, upper

# Standard deviations of the kernels [px]; of wider structure cells tell more.
GRAINS = (0.7, 2.0, 5.6)
# Peaks are sought from this part of the light's own frequency on [cycles per width of the light]: below, the spot's
# numbers take part, and cosine and sine are no longer alike.
LOWEST = 0.35
# Padding of a field before its peak is sought: between two frequencies of this grid a peak loses 3 % at most.
PADDED = 2


class Field(NamedTuple):
    """Sums over frames in one window [row, column]: a z and a²; and of pairs what fits take, and of half their variance
    [2, grain]."""

    pull: np.ndarray
    weight: np.ndarray
    taken: np.ndarray


class Pairs(NamedTuple):
    """Sum over pairs of pixels, Σ a² on top, its mean and its variance [grain]."""

    value: np.ndarray
    mean: np.ndarray
    variance: np.ndarray


@lru_cache(maxsize=4)
def kernels_of(rows: int, columns: int) -> np.ndarray:
    """K [grain, lag row, lag column]."""
    y, x = (np.minimum(np.arange(n), n - np.arange(n)) for n in (rows, columns))
    kernels = np.stack([np.exp(-(y[:, None] ** 2 + x**2) / (2 * grain**2)) for grain in GRAINS])
    kernels[:, 0, 0] = 0
    return kernels


def _alike(fields: np.ndarray) -> np.ndarray:
    """Σ over pairs of pixels, by lag, of fields [field, row, column]."""
    return fft.irfft2((np.abs(fft.rfft2(fields)) ** 2).sum(axis=0), s=fields.shape[1:])


def taken_of(taken: np.ndarray, shape: tuple[int, int], weight: np.ndarray) -> np.ndarray:
    """What fits take of the pairs of the field `weight` z of a frame, and of half their variance [2, grain]; `taken`
    [column, pixel] as of `Standard`, draws beside it."""
    fields, kernels = (taken * weight).reshape(-1, *shape), kernels_of(*shape)
    both = fft.rfft2(fields) * fft.rfft2(kernels)[:, None]
    square = [np.sum((fft.irfft2(own, s=shape) * weight.reshape(shape)) ** 2) for own in both]
    return np.stack([np.tensordot(kernels, _alike(fields), 2), square])


def window_of(frames: Sequence[Standard]) -> tuple[tuple[int, int], tuple[int, int], list[tuple[slice, slice]]]:
    """The part of the sensor that holds some frames: its first row and column, its size, and each frame's place in
    it."""
    first, size = np.array([own.at for own in frames]), np.array([own.shape for own in frames])
    corner, end = first.min(axis=0), (first + size).max(axis=0)
    places = [(slice(r, r + own.shape[0]), slice(c, c + own.shape[1])) for (r, c), own in
              zip(first - corner, frames, strict=True)]  # fmt: skip
    return (int(corner[0]), int(corner[1])), (int(end[0] - corner[0]), int(end[1] - corner[1])), places


def field_of(frames: Sequence[Standard], weights: Sequence[np.ndarray], taken: Sequence[np.ndarray]) -> Field:
    """The field that frames share, each in its place on the sensor."""
    _, size, places = window_of(frames)
    out = np.zeros((2, *size))
    for own, weight, at in zip(frames, weights, places, strict=True):
        for total, values in zip(out, (weight * own.z, weight * weight), strict=True):
            total[at] += values.reshape(own.shape)
    # What one frame's numbers take of the variance of pairs they take in all frames.
    more = [np.array([[1.0], [out[1].sum() / max(float(own @ own), 1e-300)]]) for own in weights]
    every = [own * factor for own, factor in zip(taken, more, strict=False)]
    return Field(out[0], out[1], sum(every, np.zeros((2, len(GRAINS)))))


def pairs_of(field: Field) -> Pairs:
    """Pairs of a field, and their law."""
    kernels, total = kernels_of(*field.pull.shape), float(field.weight.sum())
    mean, every = total - field.taken[0], np.tensordot(kernels**2, _alike(field.weight[None]), 2)
    variance = 2 * np.maximum(every - field.taken[1], 0.1 * every)
    return Pairs(total + np.tensordot(kernels, _alike(field.pull[None]), 2), mean, variance)


def grain_part(name: str, pairs: Sequence[Pairs]) -> Part | None:
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
    return Part(name, float(z[j]), smallest_of(float(p[j]), p.size), f"grain of {grain[j]:.2g} px", size)


def peak_part(name: str, fields: Sequence[Field]) -> Part | None:
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
    low = LOWEST / np.sqrt(np.sqrt(max(float(np.linalg.det(spread)), 1e-12)))
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
    period, turn = 1 / radius[j, i], np.degrees(np.arctan2(ky[j, 0], kx[0, i])) % 180
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
