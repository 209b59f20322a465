"""The largest readings by the exact law of a reading, in one frame and of one pixel in all frames.

Where noise is finer than a DN, the largest of a million readings has no law that is nearly normal: chances are summed
over electrons and readings. Only the oddest pixels of each level of light are looked at so closely.
"""

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from spotcheck.discrepancy.evidence.cells import Standard
from spotcheck.discrepancy.evidence.parts import Part, sidak
from spotcheck.model.sensor import SensorModel

compiled = njit(cache=True, nogil=True, error_model="numpy")

# Bins of light, even in its root, of each of which the oddest pixels are looked at.
BINS = 16
# Pixels for which it is found how rare readings can be, each for as many others, and how many are sorted to choose
# them: dark ones are most, and what they can read is in steps that depend on a tenth of an electron.
NODES, SORTED = 300, 30_000
# Above this mean [e-] Poisson's law passes for normal, with its skewness.
POISSON_E = 3000.0
# Chances of sums come from a Fourier transform and are good to so much.
FINEST = 1e-13
ROOT_HALF = math.sqrt(0.5)


@compiled
def _tail(z):
    return 0.5 * math.erfc(z * ROOT_HALF)


@compiled
def chance_of(reading, electrons, gain, noise, black, full_well, top, upper):
    """P(y ≥ reading), or without `upper` P(y ≤ reading), under a mean number of electrons."""
    if upper and reading <= 0:
        return 1.0
    if not upper and reading >= top:
        return 1.0
    edge = (reading - 0.5 if upper else reading + 0.5) - black
    sign = 1.0 if upper else -1.0
    spread = max(gain * noise, 1e-9)
    if electrons <= 0:
        return _tail(sign * (edge - gain * electrons) / spread)
    if electrons > POISSON_E:
        sd = gain * math.sqrt(electrons + noise * noise)
        z = (edge - gain * min(electrons, full_well)) / sd
        skewness = gain**3 * electrons / sd**3
        # Cornish and Fisher's first term.
        return _tail(sign * (z - skewness * (z * z - 1) / 6))
    reach = 9 * math.sqrt(electrons) + 14
    low, high = max(int(electrons - reach), 0), int(electrons + reach)
    top_count = max(int(electrons), low)
    total = value = 0.0
    part = 1.0
    for n in range(top_count, high + 1):
        total += part
        value += part * _tail(sign * (edge - gain * min(n, full_well)) / spread)
        part *= electrons / (n + 1)
    part = top_count / electrons
    for n in range(top_count - 1, low - 1, -1):
        total += part
        value += part * _tail(sign * (edge - gain * min(n, full_well)) / spread)
        part *= n / electrons
    return value / total


@compiled
def reached(chance, electrons, gain, noise, black, full_well, top, upper):
    """The largest chance of an extreme reading that is not above `chance`: readings are whole numbers."""
    mean = gain * max(electrons, 0.0) + black
    reach = 45 * gain * math.sqrt(max(electrons, 0.0) + noise * noise) + 3
    low, high = math.floor(mean - reach), math.ceil(mean + reach)
    if upper:
        low, high = max(low, 0.0), min(high, top + 1)
    else:
        low, high = max(low, -1.0), min(high, top)
    # The nearest reading so rare, by halving.
    while high - low > 1:
        middle = math.floor((low + high) / 2)
        rare = chance_of(middle, electrons, gain, noise, black, full_well, top, upper) <= chance
        if upper == rare:
            high = middle
        else:
            low = middle
    reading = high if upper else low
    if reading > top or reading < 0:
        return 0.0
    out = chance_of(reading, electrons, gain, noise, black, full_well, top, upper)
    return out if out <= chance else 0.0


def _numbers(sensor: SensorModel) -> tuple:
    return (sensor.gain_dn_per_e, sensor.read_noise_e, sensor.black_level_dn, float(sensor.full_well_e),
            float(min(sensor.full_scale_dn, 65535.0)))  # fmt: skip


def _reached(chance: float, electrons: float, sensor: SensorModel, upper: bool) -> float:
    return reached(chance, electrons, *_numbers(sensor), upper)  # type: ignore[call-arg]


def largest_reading(frames: Sequence[Standard], pixels: Sequence[np.ndarray], sensor: SensorModel) -> Part | None:
    """Whether the oddest reading of all frames is odder than the oddest of so many should be."""
    numbers = _numbers(sensor)
    brightest = max(float(own.electrons.max()) for own in frames)
    best, found = 2.0, (0.0, "")
    for k, own in enumerate(frames):
        known = own.spread > 0
        root = np.sqrt(np.clip(own.electrons / brightest, 0, 1))
        for j in oddest(own.z, np.minimum((root * BINS).astype(int), BINS - 1), known, BINS):
            if j < 0:
                continue
            y = float(pixels[k].ravel()[j])
            p = chance_of(y, own.electrons[j], *numbers, bool(own.z[j] > 0))  # type: ignore[call-arg]
            if p < best:
                best, found = p, (float(own.z[j]), f"frame {k}, row {own.row[j]}, column {own.column[j]}")
    if best > 1:
        return None
    count = sum(int(np.count_nonzero(own.spread)) for own in frames)
    every = max(count // SORTED, 1)
    some = np.sort(np.concatenate([own.electrons[own.spread > 0][::every] for own in frames]))
    some = some[((np.arange(NODES) + 0.5) / NODES * some.size).astype(int)]
    rarer = count * float(np.mean([_reached(best, float(e), sensor, True) + _reached(best, float(e), sensor, False)
                                   for e in some]))  # fmt: skip
    return Part("readings: largest", found[0], float(max(-np.expm1(-max(rarer, best)), 1e-300)), found[1])


@compiled
def oddest(z, bins, known, size):
    """The pixels with highest and lowest z of each bin, −1 where a bin has none."""
    out = np.full(2 * size, -1)
    for k in range(z.size):
        if known[k]:
            for side, sign in ((0, 1.0), (1, -1.0)):
                at = 2 * bins[k] + side
                if out[at] < 0 or sign * z[k] > sign * z[out[at]]:
                    out[at] = k
    return out


def hot_pixels(frames: Sequence[Standard], pixels: Sequence[np.ndarray], sensor: SensorModel) -> Part | None:
    """Whether one pixel of the sensor reads too much or too little in all frames together: the plain sum of its
    readings, under the exact law of that sum."""
    top, left = (min(int(getattr(own, axis).min()) for own in frames) for axis in ("row", "column"))
    size = tuple(max(int(getattr(own, axis).max()) for own in frames) - first + 1
                 for axis, first in (("row", top), ("column", left)))  # fmt: skip
    off, square = np.zeros(size), np.zeros(size)
    places = []
    for own in frames:
        row, column = int(own.row.min()) - top, int(own.column.min()) - left
        at = (slice(row, row + own.shape[0]), slice(column, column + own.shape[1]))
        places.append(at)
        off[at] += (own.z * own.spread).reshape(own.shape)
        square[at] += (own.spread**2).reshape(own.shape)
    seen = square > 0
    z = np.where(seen, off / np.sqrt(np.where(seen, square, 1.0)), 0.0)
    bins = np.digitize(square, np.quantile(square[seen], np.linspace(0, 1, BINS + 1)[1:-1]))
    best, found = 2.0, (0.0, "")
    for j in oddest(z.ravel(), bins.ravel(), seen.ravel(), BINS):
        if j < 0:
            continue
        row, column = divmod(int(j), size[1])
        here = [(k, (row - at[0].start) * frames[k].shape[1] + column - at[1].start) for k, at in enumerate(places)
                if at[0].start <= row < at[0].stop and at[1].start <= column < at[1].stop]  # fmt: skip
        here = [(k, p) for k, p in here if frames[k].spread[p] > 0]
        electrons = np.array([frames[k].electrons[p] for k, p in here])
        total = sum(float(pixels[k].ravel()[p]) for k, p in here)
        chance = chance_of_sum(total, electrons, sensor, bool(z[row, column] > 0))
        if chance < best:
            best, found = chance, (float(z[row, column]), f"row {row + top}, column {column + left}")
    if best > 1:
        return None
    return Part("readings: hot pixels", found[0], sidak(best, 2 * int(seen.sum())), found[1])


def chance_of_sum(total: float, electrons: np.ndarray, sensor: SensorModel, upper: bool) -> float:
    """P(Σ y ≥ total), or without `upper` P(Σ y ≤ total), of readings at mean numbers of electrons [reading], by the
    product of their characteristic functions."""
    gain, noise, black, full_well, top = _numbers(sensor)
    reach = 10 * gain * np.sqrt(np.maximum(electrons, 0.0) + noise**2) + 2 + 12 * gain
    low, high = (np.clip(np.round(gain * electrons + black + way * reach), 0, top) for way in (-1, 1))
    laws = np.zeros((electrons.size, int((high - low).max()) + 1))
    _fill(laws, low, high, electrons, gain, noise, black, full_well, top)
    span = int((high - low).sum()) + 1
    padded = 1 << int(np.ceil(np.log2(span + 1)))
    whole = np.ones(padded // 2 + 1, complex)
    for law in laws:
        whole *= np.fft.rfft(law, padded)
    chances = np.fft.irfft(whole, padded)[:span]
    at = round(total - low.sum())
    tail = chances[max(at, 0) :] if upper else chances[: max(at + 1, 0)]
    return float(max(tail.sum(), FINEST))


@compiled
def _fill(laws, low, high, electrons, gain, noise, black, full_well, top):
    """The chance of each reading from `low` to `high` [reading], of each its own, into `laws` [reading, value]."""
    for k in range(electrons.size):
        above = 1.0
        count = int(high[k] - low[k]) + 1
        for j in range(count):
            beyond = 0.0
            if j < count - 1:
                beyond = chance_of(low[k] + j + 1, electrons[k], gain, noise, black, full_well, top, True)
            laws[k, j] = max(above - beyond, 0.0)
            above = beyond
