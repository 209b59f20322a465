"""Random readings: one random number and one look-up in a table for each pixel.

Tables hold the distribution of the reading at nodes of light 1/32 of a standard deviation apart. A reading between two
nodes comes from one of them, chosen at random so that the mean light is right: each probability is then off by about
1.3e-4 (z² + 1) of itself, z standard deviations from the mean, and by some times that next to a clip. At a node, an
alias table (Walker 1977, doi:10.1145/355744.355749) turns the rest of the random number into a reading.

An alias table has a word of 32 bits for each code. Its b low bits number another code, where b bits suffice for the
widest node of the sensor; the others hold the probability of the word's own code against that one, to 2^(b−32). As it
is compared with a random number of 32 bits, the probability of a code is off by less than 2^(b−31) in all, which is
1.2e-7 for nodes of up to 256 codes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from spotcheck.sensor.codes import LARGEST_READING, compiled
from spotcheck.sensor.table import LEAST_NOISE_E, saturating_electrons

if TYPE_CHECKING:
    from spotcheck.sensor.distribution import ReadingDistribution

NO_NUMBER = "light: holds NaN; give the light of each pixel in DN"
# Nodes for each standard deviation of the light.
NODES_PER_SD = 32
# Most words of a sensor's tables, 4 bytes each, and most nodes, whose positions then fit in 31 bits. Readings under
# brighter light are drawn step by step.
MOST_WORDS, MOST_NODES = 6_000_000, 32_000
# Nodes that are made at a time.
BLOCK = 64
# Probability of a code that is left out at either end of the codes of a node.
LEFT_OUT = 1e-13
# Pixels at a time: their buffers stay in the fastest cache.
CHUNK = 2048
# Binary digits behind the point of the position of a light among the nodes.
POSITION_BITS = 16
# A node is packed into 64 bits: its number of codes in the 17 low bits, its first code from bit 17 on, and the index of
# its first word from bit 33 on.
CODE_SHIFT, WORD_SHIFT = np.uint64(17), np.uint64(33)


@dataclass(frozen=True, eq=False)
class AliasTables:
    """Alias tables of all nodes; nodes are uniform in the root of (mean electrons + noise²)."""

    first_root: float  # root of the first node [e-^½], the one without electrons
    step: float  # distance of the nodes in the root [e-^½]
    is_complete: bool  # whether readings no longer change beyond the last node
    nodes: np.ndarray  # packed as said at `CODE_SHIFT` [node]
    words: np.ndarray  # of all codes of all nodes [word]
    mask: np.uint32  # low bits of a word, which number the other code, counted from the first code of the node


def sample_from_tables(distribution: ReadingDistribution, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return random readings [DN, uint16] at light [DN], an array of any shape."""
    # Tables are those of mean electrons, which do not depend on the exposure that dark electrons come from.
    tables = tabulate_aliases(replace(distribution, exposure_s=0.0) if distribution.exposure_s else distribution)
    flat = np.ascontiguousarray(light, dtype=float).reshape(-1)
    readings = np.empty(flat.size, np.uint16)
    gain, offset_e = distribution.sensor.gain_dn_per_e, tables.first_root**2 + distribution.mean_electrons(0.0)
    # Light at the last node but one is the brightest that has a node above.
    last = tables.nodes.size - 2.0
    grid = (1 / gain, offset_e, tables.first_root, 1 / tables.step, last)
    # Two raw numbers, as some generators give 32 bits at a time.
    low, high = rng.bit_generator.random_raw(2)
    if not _draw_readings(flat, grid, tables.nodes, tables.words, tables.mask, low ^ (high << np.uint64(32)), readings):
        raise ValueError(NO_NUMBER)
    if not tables.is_complete:
        is_beyond = flat >= gain * ((tables.first_root + last * tables.step) ** 2 - offset_e)
        readings[is_beyond] = distribution.sample_steps(flat[is_beyond], rng)
    return readings.reshape(np.shape(light))[()]


@compiled
def _draw_readings(light, grid, nodes, words, mask, seed, readings):
    """Fill readings [pixel]; return False, with readings unfinished, if a light is no number."""
    node, bits = np.empty(CHUNK, np.uint32), np.empty(CHUNK, np.uint64)
    for k in range(0, light.size, CHUNK):
        if not _choose_nodes(light[k : k + CHUNK], grid, seed + np.uint64(k), bits, node):
            return False
        _draw_codes(node, bits, nodes, words, mask, readings[k : k + CHUNK])
    return True


@compiled
def _random_bits(counter):
    """Return 64 random bits for a counter: splitmix64 (Steele et al. 2014, doi:10.1145/2660193.2660195).

    A call starts at a random counter: two calls for n pixels each share counters with a probability of n/2^63.
    """
    bits = counter * np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


@compiled
def _choose_nodes(light, grid, seed, bits, node):
    """Fill 64 random bits [pixel] and the node [pixel]; return False if a light is no number.

    16 of the bits choose between the next node below and the next above the light.
    """
    per_dn, offset_e, first_root, per_step, last = grid
    are_numbers = True
    for k in range(light.size):
        are_numbers &= light[k] == light[k]
        bits[k] = _random_bits(seed + np.uint64(k))
        position = min((np.sqrt(max(light[k], 0.0) * per_dn + offset_e) - first_root) * per_step, last)
        fraction = np.int32(bits[k] & np.uint64(2**POSITION_BITS - 1))
        node[k] = (np.int32(position * 2**POSITION_BITS) + fraction) >> POSITION_BITS
    return are_numbers


@compiled
def _draw_codes(node, bits, nodes, words, mask, readings):
    """Fill readings [pixel] at nodes [pixel] by the 32 high of the random bits [pixel], which are overwritten.

    Those bits times the number of codes of the node give, above bit 32, a word, and below, what its probability is
    compared with. Look-ups have loops of their own, so that the compiler turns the rest into vector instructions.
    """
    record, word = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint32)
    for k in range(readings.size):
        record[k] = nodes[node[k]]
    for k in range(readings.size):
        width = record[k] & ((np.uint64(1) << CODE_SHIFT) - np.uint64(1))
        bits[k] = (bits[k] >> np.uint64(32)) * width
        word[k] = np.uint32(record[k] >> WORD_SHIFT) + np.uint32(bits[k] >> np.uint64(32))
    for k in range(readings.size):
        word[k] = words[word[k]]
    for k in range(readings.size):
        entry, other = np.uint32(bits[k] >> np.uint64(32)), word[k] & mask
        code = entry if np.uint32(bits[k]) < word[k] - other else other
        readings[k] = np.uint16(np.uint32(record[k] >> CODE_SHIFT) + code)


@lru_cache(maxsize=8)
def tabulate_aliases(distribution: ReadingDistribution) -> AliasTables:
    """Return the alias tables of a distribution, up to saturation, `MOST_WORDS` or `MOST_NODES`."""
    noise_e = float(max(distribution.sensor.read_noise_e, LEAST_NOISE_E))
    step = 1 / (2 * NODES_PER_SD)
    saturated_root = np.sqrt(saturating_electrons(distribution) + noise_e**2)
    rows: list[np.ndarray] = []
    first_codes: list[int] = []
    size, is_complete = 0, False
    while not is_complete:
        codes = distribution.probabilities((noise_e + step * (len(rows) + np.arange(BLOCK))) ** 2 - noise_e**2)
        if rows and (len(rows) + BLOCK > MOST_NODES or size + codes.probability.size > MOST_WORDS):
            break
        # Higher codes are stored as the largest reading.
        first_code = min(codes.first_code, LARGEST_READING)
        stored = np.arange(min(codes.probability.shape[1], LARGEST_READING + 1 - first_code))
        for row in np.add.reduceat(codes.probability, stored, axis=1):
            likely = np.flatnonzero(row > LEFT_OUT)
            rows.append(row[likely[0] : likely[-1] + 1])
            first_codes.append(first_code + likely[0])
            size += rows[-1].size
        is_complete = noise_e + step * (len(rows) - 2) > saturated_root
    widths = np.array([row.size for row in rows], np.uint64)
    nodes = ((np.cumsum(widths) - widths) << WORD_SHIFT) | (np.array(first_codes, np.uint64) << CODE_SHIFT) | widths
    other_bits = int(widths.max() - 1).bit_length()
    words = np.empty(size, np.uint32)
    _fill_words(np.concatenate(rows), widths.astype(np.int64), other_bits, words)
    return AliasTables(noise_e, step, is_complete, nodes, words, np.uint32(2**other_bits - 1))


@compiled
def _fill_words(probability, widths, other_bits, words):
    """Fill the words of all nodes from the probability of their codes [word], by Vose's form of Walker's method."""
    end = 0
    for width in widths:
        start, end = end, end + width
        share = probability[start:end] * (width / np.sum(probability[start:end]))
        # A word without another code stands for its own alone.
        other = np.arange(width)
        small = [k for k in range(width) if share[k] < 1]
        large = [k for k in range(width) if share[k] >= 1]
        while len(small) > 0 and len(large) > 0:
            low, high = small.pop(), large[-1]
            other[low] = high
            share[high] -= 1 - share[low]
            if share[high] < 1:
                small.append(large.pop())
        parts = 2.0 ** (32 - other_bits)
        for k in range(width):
            words[start + k] = (np.int64(min(np.rint(share[k] * parts), parts - 1)) << other_bits) | other[k]
