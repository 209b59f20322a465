"""Random readings: one random number and one look-up in a table for each pixel.

Tables hold the distribution of the reading at levels of light 1/32 of a standard deviation apart. A reading between two
levels comes from one of them, chosen at random so that the mean light is right: each probability is then off by about
1.3e-4 (z² + 1) of itself, z standard deviations from the mean, and by some times that next to a clip. Within a level,
an alias table (Walker 1977, doi:10.1145/355744.355749) turns the rest of the random number into a reading.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from spotcheck.sensor.table import LEAST_NOISE_E, saturating_electrons

if TYPE_CHECKING:
    from spotcheck.sensor.distribution import ReadingDistribution

# Sums may be taken in any order: that lets the compiler use vector instructions.
compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"})

NO_NUMBER = "light: holds NaN; give the light of each pixel in DN"
# Levels for each standard deviation of the light.
LEVELS_PER_SD = 32
# Most entries of a sensor's tables, 8 bytes each; readings under brighter light are drawn step by step.
MOST_ENTRIES = 8_000_000
# Levels that are made at a time.
BLOCK = 64
# Probability of a code that is left out.
LEFT_OUT = 1e-13
# Pixels at a time: their buffers stay in the fastest cache.
CHUNK = 2048
# Generators side by side, which the compiler turns into vector instructions.
LANES = 16
# Parts of the distance of two levels that a light is rounded to, and most levels whose places then fit in 31 bits.
PLACES_PER_LEVEL, MOST_LEVELS = 65536, 32_000


class AliasTables(NamedTuple):
    """Alias tables of all levels; levels are uniform in the root of (mean electrons + noise²)."""

    first_root: float  # root of the first level [e-^½], the one without electrons
    step: float  # distance of the levels in the root [e-^½]
    is_complete: bool  # whether readings no longer change beyond the last level
    start: np.ndarray  # place of the first entry of each level among the words [level]
    mask: np.ndarray  # number of entries of each level, a power of two, less 1 [level]
    # [entry] of all levels: bits 32 to 63 hold the probability that an entry stands for its own reading, bits 16 to 31
    # that reading, bits 0 to 15 the reading that it stands for else.
    words: np.ndarray


def sample_from_tables(distribution: ReadingDistribution, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return random readings [DN, uint16] at light [DN], an array of any shape."""
    # Tables are those of mean electrons, which do not depend on the exposure that dark electrons come from.
    tables = _tables(replace(distribution, exposure_s=0.0) if distribution.exposure_s else distribution)
    flat = np.ascontiguousarray(light, dtype=float).reshape(-1)
    readings = np.empty(flat.size, np.uint16)
    offset_e = tables.first_root**2 + distribution.mean_electrons(0.0)
    last = tables.start.size - 2.0
    state = rng.integers(2**64, size=(4, LANES), dtype=np.uint64)
    grid = (1 / distribution.sensor.gain_dn_per_e, offset_e, tables.first_root, 1 / tables.step, last)
    highest = _look_up(flat, *grid, tables.start, tables.mask, tables.words, state, readings)
    if np.isnan(highest):
        raise ValueError(NO_NUMBER)
    if highest >= last and not tables.is_complete:
        place = (np.sqrt(np.maximum(flat, 0) * grid[0] + offset_e) - tables.first_root) * grid[3]
        is_beyond = place >= last
        readings[is_beyond] = distribution.sample_steps(flat[is_beyond], rng)
    return readings.reshape(np.shape(light))[()]


@compiled
def _look_up(light, per_dn, offset_e, first_root, per_step, last, start, mask, words, state, readings):
    """Fill readings [pixel] and return the highest place of a light among the levels, NaN if one is no number."""
    place, number = np.empty(CHUNK, np.int32), np.empty(CHUNK, np.uint64)
    highest = np.int32(0)
    for k in range(0, light.size, CHUNK):
        part = readings[k : k + CHUNK]
        highest_of_part = _places(light[k : k + CHUNK], per_dn, offset_e, first_root, per_step, last, place)
        if highest_of_part < 0:
            return np.nan
        highest = max(highest, highest_of_part)
        _random_bits(state, number)
        _read(place, number, start, mask, words, part)
    return highest / PLACES_PER_LEVEL


@compiled
def _places(light, per_dn, offset_e, first_root, per_step, last, place):
    """Fill the place [pixel] of each light among the levels, at most `last`, in 65536ths; return the highest.

    The result is negative if a light is no number.
    """
    for k in range(light.size):
        root = np.sqrt(max(light[k], 0.0) * per_dn + offset_e)
        place[k] = np.int32(min((root - first_root) * per_step, last) * PLACES_PER_LEVEL)
    highest, missing = np.int32(0), 0
    for k in range(light.size):
        highest = max(highest, place[k])
    for k in range(light.size):
        missing += light[k] != light[k]
    return highest if missing == 0 else np.int32(-1)


@compiled
def _random_bits(state, number):
    """Fill 64 random bits each, from generators side by side: sfc64 (Doty-Humphrey, PractRand), as numpy has it."""
    a, b, c, count = state[0].copy(), state[1].copy(), state[2].copy(), state[3].copy()
    for k in range(0, number.size, LANES):
        out = number[k : k + LANES]
        for lane in range(LANES):
            total = a[lane] + b[lane] + count[lane]
            count[lane] += np.uint64(1)
            a[lane] = b[lane] ^ (b[lane] >> np.uint64(11))
            b[lane] = c[lane] + (c[lane] << np.uint64(3))
            c[lane] = ((c[lane] << np.uint64(24)) | (c[lane] >> np.uint64(40))) + total
            out[lane] = total
    state[0], state[1], state[2], state[3] = a, b, c, count


@compiled
def _read(place, number, start, mask, words, readings):
    """Fill readings [pixel]: 16 random bits choose the level, the next the entry, 32 whether it stands for itself."""
    for k in range(readings.size):
        bits = number[k]
        level = (np.int64(place[k]) + np.int64(bits >> np.uint64(48))) >> 16
        word = words[start[level] + np.int64((bits >> np.uint64(32)) & mask[level])]
        is_itself = (bits & np.uint64(0xFFFFFFFF)) < (word >> np.uint64(32))
        readings[k] = np.uint16(word >> np.uint64(16)) if is_itself else np.uint16(word)


@lru_cache(maxsize=8)
def _tables(distribution: ReadingDistribution) -> AliasTables:
    """Return the tables of a distribution, up to saturation or `MOST_ENTRIES`."""
    noise_e = max(distribution.sensor.read_noise_e, LEAST_NOISE_E)
    step = 1 / (2 * LEVELS_PER_SD)
    highest_e = saturating_electrons(distribution)
    words: list[np.ndarray] = []
    levels, is_complete = 0, False
    while not is_complete:
        codes = distribution.probabilities((noise_e + step * (levels + np.arange(BLOCK))) ** 2 - noise_e**2)
        width = 1 << (int((codes.probability > LEFT_OUT).sum(axis=1).max()) - 1).bit_length()
        entries = sum(part.size for part in words) + BLOCK * width
        if words and (levels + BLOCK > MOST_LEVELS or entries > MOST_ENTRIES):
            break
        words.append(np.empty((BLOCK, width), np.uint64))
        _fill_words(codes.probability, codes.first_code, words[-1])
        levels += BLOCK
        is_complete = noise_e + step * (levels - 2) > np.sqrt(highest_e + noise_e**2)
    widths = np.repeat([part.shape[1] for part in words], BLOCK)
    start = np.cumsum(widths) - widths
    mask = (widths - 1).astype(np.uint64)
    return AliasTables(noise_e, step, is_complete, start, mask, np.concatenate([part.reshape(-1) for part in words]))


@compiled
def _fill_words(probability, first_code, words):
    """Fill the alias table [level, entry] of each level from the probability of its codes [level, code]."""
    size = words.shape[1]
    share, other, code = np.empty(size), np.empty(size, np.int64), np.empty(size, np.int64)
    small, large = np.empty(size, np.int64), np.empty(size, np.int64)
    for level in range(probability.shape[0]):
        row = probability[level]
        total, used = 0.0, 0
        share[:] = 0.0
        code[:] = 0
        for k in range(row.size):
            if row[k] > LEFT_OUT:
                share[used], code[used] = row[k], min(first_code + k, 65535)
                total += row[k]
                used += 1
        few = many = 0
        for k in range(size):
            share[k] *= size / total
            other[k] = k
            if share[k] < 1:
                small[few] = k
                few += 1
            else:
                large[many] = k
                many += 1
        while few > 0 and many > 0:
            poor, rich = small[few - 1], large[many - 1]
            few -= 1
            other[poor] = rich
            share[rich] -= 1 - share[poor]
            if share[rich] < 1:
                many -= 1
                small[few] = rich
                few += 1
        for k in range(few):
            # What rounding leaves over stands for itself.
            share[small[k]] = 1.0
        for k in range(size):
            threshold = np.uint64(min(share[k], 1.0) * 4294967295.0)
            word = (threshold << np.uint64(32)) | (np.uint64(code[k]) << np.uint64(16))
            words[level, k] = word | np.uint64(code[other[k]])
