"""The oddest pixels by the exact law of a reading, in one frame alone and in all frames together.

Where noise is finer than a DN, the largest of a million readings has no law that is nearly normal: chances are summed
over electrons and readings. Only the oddest pixels of each level of noise are looked at so closely.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from spotcheck.old_engine.evidence.fields import Field
from spotcheck.old_engine.evidence.parts import SMALLEST, Part, smallest_of
from spotcheck.old_engine.evidence.windows import Window
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.observe.pixels import Frame
from spotcheck.old_engine.observe.readings import POISSON_E, ROOT_HALF

compiled = njit(cache=True, nogil=True, error_model="numpy")

# Levels of noise, of each of which the oddest pixels are looked at.
LEVELS = 16
# Pixels for which it is found how rare readings can be, each for as many others, and how many are sorted to choose
# them: dark ones are most, and what they can read is in steps that depend on a tenth of an electron.
NODES, SORTED = 300, 30_000
# Chances of sums come from a Fourier transform and are good to so much.
FINEST = 1e-13


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


def _numbers(sensor: SensorModel) -> tuple:
    return (sensor.gain_dn_per_e, sensor.read_noise_e, sensor.black_level_dn, float(sensor.full_well_e),
            float(min(sensor.full_scale_dn, 65535.0)))  # fmt: skip


class Oddest(NamedTuple):
    """The least chance of a pixel among so many, which counts each from both sides, its z, and its row and column on
    the sensor."""

    chance: float
    chances: int
    z: float
    row: int
    column: int


def oddest(
    sums: Field, window: Window, frames: Sequence[Frame], electrons: Sequence[np.ndarray], sensor: SensorModel
) -> Oddest | None:
    """The pixel that reads too much or too little in all frames of a window together: the plain sum of its readings,
    under the exact law of that sum. `sums`: of z with weights √V; `electrons` [row, column] of each frame, mean (NaN:
    masked)."""
    seen = sums.weight > 0
    if not seen.any():
        return None
    bounds = np.quantile(sums.weight[seen], np.linspace(0, 1, LEVELS + 1)[1:-1])
    found, places = [], [window.at(own) for own in frames]
    for j in np.unique(_extremes(sums.pull.ravel(), sums.weight.ravel(), bounds)):
        row, column = divmod(int(j), seen.shape[1])
        inside = [(k, row - down.start, column - along.start) for k, (down, along) in enumerate(places)
                  if down.start <= row < down.stop and along.start <= column < along.stop]  # fmt: skip
        inside = [(k, r, c) for k, r, c in inside if np.isfinite(electrons[k][r, c])]
        total = sum(float(frames[k].pixels[r, c]) for k, r, c in inside)
        z = float(sums.pull[row, column] / np.sqrt(sums.weight[row, column]))
        mean = np.array([electrons[k][r, c] for k, r, c in inside], float)
        chance = chance_of_sum(total, mean, sensor, z > 0)
        found.append(Oddest(chance, 2 * int(seen.sum()), z, window.step * (row + window.corner[0]),
                            window.step * (column + window.corner[1])))  # fmt: skip
    return min(found, key=lambda own: own.chance)


@compiled
def _extremes(rest, square, bounds):
    """The pixels with the highest and the lowest z of each level of noise [level]."""
    best, where = np.zeros((2, bounds.size + 1)), np.full((2, bounds.size + 1), -1)
    for k in range(rest.size):
        if square[k] > 0:
            z = rest[k] / math.sqrt(square[k])
            level = np.searchsorted(bounds, square[k], side="right")
            for side in range(2):
                if where[side, level] < 0 or (z > best[side, level] if side else z < best[side, level]):
                    best[side, level], where[side, level] = z, k
    flat = where.ravel()
    return flat[flat >= 0]


def odd_pixels(
    name: str, found: Sequence[Oddest | None], electrons: Sequence[np.ndarray], sensor: SensorModel
) -> Part | None:
    """Whether one pixel reads too much or too little, by the oddest of each frame, or of one window of them all.

    Readings are whole numbers: of frames each alone it counts how rare these can be; of sums not, so that their p-value
    is too large rather than too small.
    """
    told = [(own, k) for k, own in enumerate(found) if own is not None]
    if not told:
        return None
    best, frame = min(told, key=lambda own: own[0].chance)
    chance, where = best.chance, f"the pixel in row {best.row}, column {best.column}"
    if len(found) == len(electrons):
        every = np.concatenate([own[np.isfinite(own)] for own in electrons])
        chance, where = max(_rarer(chance, every, sensor), SMALLEST), f"{where}, frame {frame}"
    count = sum(own.chances for own, _ in told)
    return Part(name, (best.z**2 - 1) / math.sqrt(2), smallest_of(chance, count), where, best.z)


def _rarer(chance: float, electrons: np.ndarray, sensor: SensorModel) -> float:
    """The mean chance of a reading, on either side, that is no likelier than `chance`."""
    some = np.sort(electrons[:: max(electrons.size // SORTED, 1)]).astype(float)
    some = some[((np.arange(NODES) + 0.5) / NODES * some.size).astype(int)]
    laws, _ = laws_of(some, sensor)
    tails = np.stack([np.cumsum(laws[:, ::-1], axis=1), np.cumsum(laws, axis=1)])
    return float(np.where(tails <= chance, tails, 0.0).max(axis=2).mean())


def chance_of_sum(total: float, electrons: np.ndarray, sensor: SensorModel, upper: bool) -> float:
    """P(Σ y ≥ total), or without `upper` P(Σ y ≤ total), of readings at mean numbers of electrons [reading], by the
    product of their characteristic functions."""
    if electrons.size == 1:
        return float(chance_of(total, electrons[0], *_numbers(sensor), upper))  # type: ignore[call-arg]
    laws, low = laws_of(electrons, sensor)
    span = sum(int(np.flatnonzero(law)[-1]) for law in laws) + 1
    padded = 1 << int(np.ceil(np.log2(span + 1)))
    whole = np.ones(padded // 2 + 1, complex)
    for law in laws:
        whole *= np.fft.rfft(law, padded)
    chances = np.fft.irfft(whole, padded)[:span]
    at = round(total - low.sum())
    return float(max((chances[max(at, 0) :] if upper else chances[: max(at + 1, 0)]).sum(), FINEST))


def laws_of(electrons: np.ndarray, sensor: SensorModel) -> tuple[np.ndarray, np.ndarray]:
    """Chances [reading, value] of all values from a lowest one on [reading]."""
    gain, noise, black, full_well, top = _numbers(sensor)
    reach = 10 * gain * np.sqrt(np.maximum(electrons, 0.0) + noise**2) + 2 + 12 * gain
    low, high = (np.clip(np.round(gain * electrons + black + way * reach), 0, top) for way in (-1, 1))
    laws = np.zeros((electrons.size, int((high - low).max()) + 1))
    _fill(laws, low, high, electrons, gain, noise, black, full_well, top)
    return laws, low


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
