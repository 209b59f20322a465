"""Random readings with the exact law of the chain, compiled.

Poisson counts of means that add up add up themselves. So a mean is split into levels, for which there are tables, and a
rest below 1/16 electron, which seldom holds one. Faint light takes its reading at once, read noise, rounding and clips
included, from the table of its level (`model.law`); bright light takes a count for each digit, to the base 32, of its
mean, and then goes through the chain. Tables are alias tables (Walker 1977, doi:10.1145/355744.355749): one random
number and one look-up a draw, exact to rounding.
"""

import math
from functools import cache, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit
from scipy.stats import poisson

from spotcheck.old_engine.model.law import FAINT_E, faint_law
from spotcheck.old_engine.model.response import top_of

if TYPE_CHECKING:
    from spotcheck.old_engine.model.sensor import SensorModel

DIGIT_BITS = 5
BASE = 2**DIGIT_BITS
# Levels an electron, for readings of faint light as for the lowest digit of bright light.
LEVELS = 16
FAINT_LEVELS = int(FAINT_E) * LEVELS
# Pixels at a time: their buffers stay in the fastest cache.
CHUNK = 2048
# Sums may be taken in any order: that lets the compiler use vector instructions.
compiled = njit(cache=True, error_model="numpy", fastmath={"reassoc", "arcp", "nsz"})


class Aliases(NamedTuple):
    """Alias tables one after the other: `keep` is the chance that an entry stands for itself, `other` what it stands
    for else; `start` and `size` say where a table lies, `first` [table] is the value of its entry 0."""

    keep: np.ndarray
    other: np.ndarray
    start: np.ndarray
    size: np.ndarray
    first: np.ndarray


def aliases(laws: list[np.ndarray], first: np.ndarray) -> Aliases:
    """Tables of probabilities over consecutive whole numbers, which sum to 1 but for rounding."""
    size = np.array([len(law) for law in laws])
    start = np.concatenate([[0], np.cumsum(size)[:-1]])
    keep = np.concatenate([law / law.sum() * len(law) for law in laws])
    return Aliases(keep, _pair(keep, start, size), start, size, np.asarray(first, np.int64))


@compiled
def _pair(keep, start, size):
    """Fill up each entry below average with what another has too much; changes `keep` in place, returns the other."""
    other = np.zeros(keep.size, np.int32)
    small, large = np.empty(size.max(), np.int64), np.empty(size.max(), np.int64)
    for i in range(start.size):
        few = many = 0
        for k in range(start[i], start[i] + size[i]):
            other[k] = k - start[i]
            if keep[k] < 1:
                small[few] = k
                few += 1
            else:
                large[many] = k
                many += 1
        while few > 0 and many > 0:
            poor, rich = small[few - 1], large[many - 1]
            few -= 1
            other[poor] = rich - start[i]
            keep[rich] -= 1 - keep[poor]
            if keep[rich] < 1:
                many -= 1
                small[few] = rich
                few += 1
        # What rounding leaves over stands for itself.
        for k in range(few):
            keep[small[k]] = 1.0
    return other


@cache
def count_tables(digits: int) -> Aliases:
    """Poisson laws of the means 0, 1/16 … 32 and then of v · 32^d for d = 1 … `digits` − 1 and v = 0 … 31; each until
    1e-18 or so."""
    lowest = np.arange(FAINT_LEVELS) / LEVELS
    mean = np.concatenate([lowest, *(np.arange(BASE) * float(BASE**d) for d in range(1, digits))])
    reach = 9 * np.sqrt(mean) + 12
    first = np.maximum(mean - reach, 0).astype(np.int64)
    counts = [np.arange(low, int(high) + 1) for low, high in zip(first, mean + reach, strict=True)]
    return aliases([poisson.pmf(n, m) for n, m in zip(counts, mean, strict=True)], first)


@lru_cache(maxsize=8)
def reading_tables(sensor: "SensorModel") -> Aliases:
    """Laws of whole readings for means of 0, 1/16 … 32 e-."""
    table = faint_law(sensor, 1 / LEVELS)
    lit = table.probability[table.levels > -0.5 / LEVELS]
    return aliases(list(lit), np.zeros(len(lit)))


@compiled
def _split(light, per_dn, dark, ceiling, electrons, uniform, level, rest):
    """Mean electrons, the level of their part below 32, and its rest [e-]; `uniform` becomes u e^rest, which is below
    1, and uniform there, as often as the rest holds no electron."""
    for k in range(light.size):
        electrons[k] = min(max(light[k], 0.0) * per_dn + dark, ceiling)
        low = electrons[k] - (np.floor(electrons[k] / BASE) * BASE if electrons[k] >= FAINT_E else 0.0)
        whole = np.floor(low * LEVELS)
        level[k] = np.int32(whole)
        r = low - whole / LEVELS
        # e^r for r < 1/16: what is left out is below 1e-17.
        tail = 1 / 24 + r * (1 / 120 + r * (1 / 720 + r * (1 / 5040 + r * (1 / 40320 + r / 362880))))
        rest[k] = r
        uniform[k] *= 1 + r * (1 + r * (1 / 2 + r * (1 / 6 + r * tail)))


@compiled
def _uniforms(rng, uniform):
    for k in range(uniform.size):
        uniform[k] = rng.random()


@compiled
def _faint(electrons, uniform, level, keep, other, width, out, late):
    """Readings from their table; where light is bright or its rest holds an electron, the place for later."""
    waiting = 0
    for k in range(electrons.size):
        if electrons[k] >= FAINT_E or uniform[k] >= 1.0:
            late[waiting] = k
            waiting += 1
            continue
        at = uniform[k] * width
        entry = int(at)
        place = level[k] * width + entry
        # 0 or 1 by the sign alone: a choice would be a jump, and one that no processor can guess.
        moved = 0.5 + math.copysign(0.5, at - entry - keep[place])
        out[k] = entry + int(moved * (other[place] - entry))
    return waiting


@compiled
def _bright(electrons, uniform, level, rest, late, sensor, tables, rng, out):
    """Readings one by one: a count from the digits of the mean, then the chain."""
    gain, noise, well, black, full_scale, curvature, highest = sensor
    keep, other, start, size, first = tables
    for k in late:
        number, chance, table, above = 0, uniform[k], level[k], int(electrons[k]) >> DIGIT_BITS
        if chance >= 1.0:
            # An electron or more in the rest, by inversion of what is left of the random number.
            left, term = chance - 1, rest[k]
            while left >= 0 and term > 0:
                number += 1
                left -= term
                term *= rest[k] / (number + 1)
            chance = rng.random()
        digit = FAINT_LEVELS
        while True:
            at = chance * size[table]
            entry = int(at)
            own, else_ = keep[start[table] + entry], other[start[table] + entry]
            number += first[table] + (entry if at - entry < own else else_)
            if above == 0:
                break
            table, chance = digit + (above & (BASE - 1)), rng.random()
            above >>= DIGIT_BITS
            digit += BASE
        signal = min(gain * (min(float(number), well) + noise * rng.standard_normal()), highest)
        reading = np.rint(signal - curvature * signal * signal + black)
        out[k] = int(min(max(reading, 0.0), full_scale))


@compiled
def _fill(light, dark, ceiling, sensor, readings, counts, rng, out):
    electrons, uniform, rest = np.empty(CHUNK), np.empty(CHUNK), np.empty(CHUNK)
    level, late = np.empty(CHUNK, np.int32), np.empty(CHUNK, np.int32)
    for k in range(0, light.size, CHUNK):
        own = out[k : k + CHUNK]
        mean, chance = electrons[: own.size], uniform[: own.size]
        _uniforms(rng, chance)
        _split(light[k : k + CHUNK], 1 / sensor[0], dark, ceiling, mean, chance, level, rest)
        waiting = _faint(mean, chance, level, readings.keep, readings.other, readings.size[0], own, late)
        _bright(mean, chance, level, rest, late[:waiting], sensor, counts, rng, own)


def draw_readings(
    light_dn: np.ndarray, dark_e: float, sensor: "SensorModel", rng: np.random.Generator, out: np.ndarray
) -> None:
    """Fill `out` [pixels, uint16] with random readings [DN] under `light_dn` [pixels, DN] and `dark_e` mean dark
    electrons; light below 0 counts as none."""
    # Forty standard deviations above the lower of well and full scale every reading is clipped.
    end = min(sensor.straight().full_scale_dn, float(sensor.straightened(65535.0)))
    top = min(sensor.full_well_e, max(end - sensor.black_level_dn, 0) / sensor.gain_dn_per_e)
    ceiling = top + 40 * np.sqrt(top + sensor.read_noise_e**2) + 1600
    brightest = min(max(float(light_dn.max(initial=0.0)), 0.0) / sensor.gain_dn_per_e + dark_e, ceiling)
    digits = int(np.ceil(np.log(max(brightest, BASE) + 1) / np.log(BASE)))
    # Floats all: an integer among them would be a type of its own, and compiled again.
    chain = (
        float(sensor.gain_dn_per_e),
        float(sensor.read_noise_e),
        float(sensor.full_well_e),
        float(sensor.black_level_dn),
        float(min(sensor.full_scale_dn, 65535)),
        float(sensor.curvature),
        float(top_of(sensor.curvature)),
    )
    _fill(light_dn, float(dark_e), float(ceiling), chain, reading_tables(sensor), count_tables(digits), rng, out)
