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
from spotcheck.discrepancy.evidence.parts import Part, sidak, two_sided

# Bounds between rings of spatial frequency [cycles/px]; below the first, blocks and numbers tell more.
RINGS = np.array([0.03, 0.06, 0.1, 0.16, 0.25, 0.36, 0.5, 0.72])
# Peaks are sought from this part of the light's own frequency on [cycles per width of the light]: below, the spot's
# numbers take part, and cosine and sine are no longer alike.
LOWEST = 0.35
# Padding of a field before its peak is sought: between two frequencies of this grid a peak loses 3 % at most.
PADDED = 2


class Field(NamedTuple):
    """Sums over frames in one window [row, column]: a z, a² and a⁴κ₄; and power by ring that fits take, the last of
    them in all [ring + 1]."""

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
    """Power that fits take of the field `weight` z of a frame, by ring and in all [ring + 1]; `taken` [column, pixel]
    as of `Standard`, draws beside it."""
    ring, twice, _ = rings_of(*shape)
    fields = (taken * weight).reshape(-1, *shape)
    power = (np.abs(fft.rfft2(fields)) ** 2).sum(axis=0) * twice
    return np.append(_by_ring(power, ring), power.sum())


def field_of(frames: Sequence[Standard], weights: Sequence[np.ndarray], taken: Sequence[np.ndarray]) -> Field:
    """The field that frames share, each in its place on the sensor."""
    top, left = (min(int(getattr(own, axis).min()) for own in frames) for axis in ("row", "column"))
    bottom, right = (max(int(getattr(own, axis).max()) for own in frames) for axis in ("row", "column"))
    out = np.zeros((3, bottom - top + 1, right - left + 1))
    for own, weight in zip(frames, weights, strict=True):
        row, column = int(own.row.min()) - top, int(own.column.min()) - left
        at = (slice(row, row + own.shape[0]), slice(column, column + own.shape[1]))
        square = weight * weight
        for total, values in zip(out, (weight * own.z, square, square * square * own.fourth), strict=True):
            total[at] += values.reshape(own.shape)
    # The power that a frame's numbers take does not depend on the window but for the rings' number of modes.
    size = out[0].size / frames[0].z.size
    return Field(out[0], out[1], out[2], sum(taken, np.zeros(len(RINGS))) * size)


def power_of(field: Field) -> Power:
    """Power by ring of a field, and its law."""
    rows, columns = field.pull.shape
    ring, twice, kernels = rings_of(rows, columns)
    value = _by_ring(np.abs(fft.rfft2(field.pull)) ** 2 * twice, ring)
    modes = _by_ring(twice, ring)
    lags = fft.irfft2(np.abs(fft.rfft2(field.weight)) ** 2, s=(rows, columns))
    mean = modes * field.weight.sum() - field.taken[:-1]
    # What the numbers take is gone from the quadratic form's eigenvalues, in proportion.
    left = np.divide(mean, mean + field.taken[:-1], out=np.zeros_like(mean), where=mean > 0)
    variance = (2 * np.tensordot(kernels, lags, 2) + modes**2 * field.fourth.sum()) * left
    return Power(value, mean, variance)


def evened(power: Power, field: Field) -> Power:
    """Power of a field of even weight by ring, beside its total: that all readings scatter more is asked elsewhere."""
    ring, twice, _ = rings_of(*field.pull.shape)
    size, modes = float(field.weight.sum()), _by_ring(twice, ring)
    share = modes / field.pull.size
    total = field.pull.size * float((field.pull**2).sum())
    left = field.pull.size * size - float(field.taken[-1])
    variance = power.variance - share**2 * field.pull.size**2 * (2 * size + float(field.fourth.sum()))
    return Power(power.value - share * (total - left), power.mean, np.maximum(variance, 0.0))


def rings_part(name: str, powers: Sequence[Power]) -> Part | None:
    """Whether the power of some ring, summed over independent fields of like weight, is off on either side: a gamma law
    of that mean and variance."""
    value, mean, variance = np.sum([tuple(own) for own in powers], axis=0)
    good = (variance > 0) & (mean > 0)
    if not good.any():
        return None
    z = ((value - mean)[good]) / np.sqrt(variance[good])
    p = two_sided(z, 2 * np.sqrt(variance[good]) / mean[good])
    j = int(np.argmin(p))
    low, high = RINGS[:-1][good][j], RINGS[1:][good][j]
    return Part(name, float(z[j]), sidak(float(p[j]), p.size), f"periods {1 / high:.1f} to {1 / low:.1f} px")


def peak_part(name: str, fields: Sequence[Field]) -> Part | None:
    """Whether the highest peak of the fields' power together is too high: a χ² field of two degrees of freedom a field,
    by the expected Euler characteristic of what lies above (Worsley 1994, doi:10.2307/1427576)."""
    rows, columns = fields[0].pull.shape
    padded = PADDED * rows, PADDED * columns
    ky, kx = fft.fftfreq(padded[0])[:, None], fft.rfftfreq(padded[1])[None, :]
    power = np.zeros((padded[0], padded[1] // 2 + 1))
    spread = np.zeros((2, 2))
    count = 0
    for field in fields:
        total = float(field.weight.sum())
        if total <= 0:
            continue
        power += 2 / total * np.abs(fft.rfft2(field.pull, s=padded)) ** 2
        spread += _spread(field.weight)
        count += 1
    if not count:
        return None
    spread /= count
    low = LOWEST / np.sqrt(np.sqrt(max(float(np.linalg.det(spread)), 1e-12)))
    radius = np.hypot(ky, kx)
    high = 0.5 - low
    sought = (radius >= low) & (radius <= high)
    if not sought.any():
        return None
    power[~sought] = 0
    j, i = np.unravel_index(int(np.argmax(power)), power.shape)
    freedom = 2 * count
    area, edge = np.pi / 2 * (high**2 - low**2), np.pi / 2 * (high + low)
    p = chance_of_peak(float(power[j, i]), freedom, 4 * np.pi**2 * spread, area, edge)
    period, turn = 1 / radius[j, i], np.degrees(np.arctan2(ky[j, 0], kx[0, i])) % 180
    statistic = (power[j, i] - freedom) / np.sqrt(2 * freedom)
    return Part(name, float(statistic), p, f"period {period:.1f} px, {turn:.0f}° across")


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
