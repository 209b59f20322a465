"""The oddest pixels by the exact law of a reading, in one frame alone and in all frames together.

Where noise is finer than a DN, the largest of a million readings has no law that is nearly normal: chances are summed
over electrons and readings. Only the oddest pixels of each level of noise are looked at so closely.
"""

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from spotcheck.discrepancy.evidence.cells import Standard
from spotcheck.discrepancy.evidence.fields import window_of
from spotcheck.discrepancy.evidence.parts import SMALLEST, Part, smallest_of
from spotcheck.discrepancy.observe.readings import POISSON_E, ROOT_HALF
from spotcheck.model.sensor import SensorModel

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


def odd_pixels(
    name: str, groups: Sequence[Sequence[Standard]], pixels: Sequence[Sequence[np.ndarray]], sensor: SensorModel
) -> Part | None:
    """Whether one pixel of the sensor reads too much or too little in all frames of a group together: the plain sum of
    its readings, under the exact law of that sum.

    Readings are whole numbers: of frames each alone it counts how rare these can be; of sums not, so that their p-value
    is too large rather than too small.
    """
    best, count, found = 2.0, 0, (0.0, "")
    for group, (frames, own) in enumerate(zip(groups, pixels, strict=True)):
        corner, size, places = window_of(frames)
        off, square = np.zeros(size), np.zeros(size)
        for one, at in zip(frames, places, strict=True):
            off[at] += (one.z * one.spread).reshape(one.shape)
            square[at] += (one.spread**2).reshape(one.shape)
        seen = square > 0
        if not seen.any():
            continue
        count += 2 * int(seen.sum())
        z = np.where(seen, off / np.sqrt(np.where(seen, square, 1.0)), 0.0)
        levels = np.digitize(square, np.quantile(square[seen], np.linspace(0, 1, LEVELS + 1)[1:-1]))
        flat = z.ravel()
        at_level = [np.flatnonzero(seen.ravel() & (levels.ravel() == own)) for own in range(LEVELS)]
        for j in [int(at[pick(flat[at])]) for at in at_level if at.size for pick in (np.argmax, np.argmin)]:
            row, column = divmod(j, size[1])
            here = [(k, (row - at[0].start) * frames[k].shape[1] + column - at[1].start) for k, at in enumerate(places)
                    if at[0].start <= row < at[0].stop and at[1].start <= column < at[1].stop]  # fmt: skip
            here = [(k, p) for k, p in here if frames[k].spread[p] > 0]
            total = sum(float(own[k].ravel()[p]) for k, p in here)
            electrons = np.array([frames[k].electrons[p] for k, p in here])
            chance = chance_of_sum(total, electrons, sensor, bool(z[row, column] > 0))
            if chance < best:
                place = f"the pixel in row {row + corner[0]}, column {column + corner[1]}"
                best, found = chance, (float(z[row, column]), place + (f", frame {group}" if len(frames) == 1 else ""))
    if best > 1:
        return None
    if max(len(own) for own in pixels) == 1:
        best = max(_rarer(best, np.concatenate([own.electrons[own.spread > 0] for (own,) in groups]), sensor), SMALLEST)
    return Part(name, (found[0] ** 2 - 1) / math.sqrt(2), smallest_of(best, count), found[1], found[0])


def _rarer(chance: float, electrons: np.ndarray, sensor: SensorModel) -> float:
    """The mean chance of a reading, on either side, that is no likelier than `chance`."""
    some = np.sort(electrons[:: max(electrons.size // SORTED, 1)])
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
