"""Spectra of what is left: power by ring of spatial frequency, and its highest peak.

A field a z with z of variance 1 has the power |F(k)|², F = Σ a z e^(−2πi k·r), whose sum over a ring is the quadratic
form Σ aᵢzᵢ K(i − j) aⱼzⱼ with the ring's own kernel K: mean K(0) Σa² less what the frames' numbers take, variance
2 Σ aᵢ² K² aⱼ² + K(0)² Σ a⁴κ₄. Both are sums over lags, exact on a window that is not padded.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import fft, special

from spotcheck.discrepancy.evidence.cells import Standard
from spotcheck.discrepancy.evidence.parts import Part, lower, smallest_of, upper

# Bounds between rings of spatial frequency [cycles/px]; below the first, blocks and numbers tell more.
RINGS = np.array([0.03, 0.06, 0.1, 0.16, 0.25, 0.36, 0.5, 0.72])
# Peaks are sought from this part of the light's own frequency on [cycles per width of the light]: below, the spot's
# numbers take part, and cosine and sine are no longer alike.
LOWEST = 0.35
# Padding of a field before its peak is sought: between two frequencies of this grid a peak loses 3 % at most.
PADDED = 2


class Field(NamedTuple):
    """Sums over frames in one window [row, column]: a z, a² and a⁴κ₄; and power by ring that fits take [ring]."""

    pull: np.ndarray
    weight: np.ndarray
    fourth: np.ndarray
    taken: np.ndarray


class Power(NamedTuple):
    """Sum over rings, its mean and its variance [ring]."""

    value: np.ndarray
    mean: np.ndarray
    variance: np.ndarray


@lru_cache(maxsize=4)
def rings_of(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ring of each frequency of a half plane [ky, kx] (0: none), how often each counts, and squares of the rings'
    kernels [ring, lag row, lag column]."""
    ky, kx = fft.fftfreq(rows)[:, None], fft.rfftfreq(columns)[None, :]
    ring = np.digitize(np.hypot(ky, kx), RINGS)
    ring[ring == len(RINGS)] = 0
    twice = np.where((kx > 0) & ~np.isclose(kx, 0.5), 2.0, 1.0) + 0 * ky
    full = np.digitize(np.hypot(ky, fft.fftfreq(columns)[None, :]), RINGS)
    kernels = [(fft.ifft2(full == r).real * rows * columns) ** 2 for r in range(1, len(RINGS))]
    return ring, twice, np.stack(kernels)


def _by_ring(power: np.ndarray, ring: np.ndarray) -> np.ndarray:
    return np.bincount(ring.ravel(), power.ravel(), len(RINGS))[1:]


def taken_power(taken: np.ndarray, shape: tuple[int, int], weight: np.ndarray) -> np.ndarray:
    """Power [ring] that fits take of the field `weight` z of a frame; `taken` [column, pixel] as of `Standard`, draws
    beside it."""
    ring, twice, _ = rings_of(*shape)
    return _by_ring((np.abs(fft.rfft2((taken * weight).reshape(-1, *shape))) ** 2).sum(axis=0) * twice, ring)


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
    out = np.zeros((3, *size))
    for own, weight, at in zip(frames, weights, places, strict=True):
        square = weight * weight
        for total, values in zip(out, (weight * own.z, square, square * square * own.fourth), strict=True):
            total[at] += values.reshape(own.shape)
    # The power that a frame's numbers take does not depend on the window but for the rings' number of modes.
    more = out[0].size / frames[0].z.size
    return Field(out[0], out[1], out[2], sum(taken, np.zeros(len(RINGS) - 1)) * more)


def power_of(field: Field) -> Power:
    """Power by ring of a field, and its law."""
    rows, columns = field.pull.shape
    ring, twice, kernels = rings_of(rows, columns)
    value = _by_ring(np.abs(fft.rfft2(field.pull)) ** 2 * twice, ring)
    modes = _by_ring(twice, ring)
    lags = fft.irfft2(np.abs(fft.rfft2(field.weight)) ** 2, s=(rows, columns))
    mean = modes * field.weight.sum() - field.taken
    # What the numbers take is gone from the quadratic form's eigenvalues, in proportion.
    left = np.divide(mean, mean + field.taken, out=np.zeros_like(mean), where=mean > 0)
    variance = (2 * np.tensordot(kernels, lags, 2) + modes**2 * field.fourth.sum()) * left
    return Power(value, mean, variance)


def rings_part(name: str, powers: Sequence[Power], *, even: bool) -> Part | None:
    """Whether the power of some ring, summed over independent fields, each in units of what it should have, is off on
    either side; `even`: beside what all rings have too much, for fields of even weight, whose rings are independent."""
    units = [np.where(own.mean > 0, own.mean, np.inf) for own in powers]
    value = np.sum([own.value / unit for own, unit in zip(powers, units, strict=True)], axis=0)
    mean = np.sum([own.mean > 0 for own in powers], axis=0)
    variance = np.sum([own.variance / unit**2 for own, unit in zip(powers, units, strict=True)], axis=0)
    good = variance > 0
    if not good.any():
        return None
    value, mean, variance = value[good], mean[good], variance[good]
    if even:
        told = mean**2 / variance
        value, variance = value / np.average(value / mean, weights=told), variance * (1 - told / told.sum())
    p = np.minimum(2 * np.minimum(upper(value, mean, variance), lower(value, mean, variance)), 1.0)
    z = (value - mean) / np.sqrt(variance)
    j = int(np.argmin(p))
    low, high = RINGS[:-1][good][j], RINGS[1:][good][j]
    where = f"structure of {1 / high:.1f} to {1 / low:.1f} px"
    beyond = 2 * mean[j] / variance[j] * (value[j] - mean[j])
    size = float(np.sign(beyond) * np.sqrt(abs(beyond)))
    return Part(name, float(z[j]), smallest_of(float(p[j]), p.size), where, size)


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
