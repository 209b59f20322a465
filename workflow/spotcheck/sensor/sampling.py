"""Random readings: one random number and one look-up in a table for each pixel.

Tables hold the distribution of the reading at certain values of the light, the nodes, which are 1/32 of a standard
deviation of the light's shot noise and read noise apart. The light is K times the mean photo-electrons of a pixel, in
DN (digital numbers) without black level; K is the gain [DN/e-]. Brackets give the shape of an array. For light
between two nodes one of them is chosen at random, so that the mean light is right. Each probability then has a relative
error of about 1.3e-4 (z² + 1), z standard deviations from the mean, and of some times that next to a clip. At a node,
an alias table (Walker 1977, doi:10.1145/355744.355749) converts the rest of the random number to a reading.

A code is a whole reading in DN. An alias table has a word of 32 bits for each code of its node, the main code of the
word. The b low bits of a word are the index of another code of the node, where b bits suffice for the node of the
sensor with the most codes. The other bits are the probability of the main code rather than the other one, to 2^(b−32).
As it is compared with a random number of 32 bits, the probability of a code has an error below 2^(b−31), which is
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

# Message of the error for NaN light.
NAN_LIGHT = "light: holds NaN; give the light of each pixel in DN"
# Nodes for each standard deviation of the light.
NODES_PER_SD = 32
# Most words of a sensor's tables, 4 bytes each, and most nodes, whose positions then fit in 31 bits. Readings under
# brighter light are drawn step by step.
MOST_WORDS, MOST_NODES = 6_000_000, 32_000
# Number of nodes whose distributions are computed at a time.
BLOCK = 64
# Codes of less probability are left out at the lower and the upper end of a node's distribution.
LEFT_OUT = 1e-13
# Pixels that are drawn at a time: their buffers stay in the fastest cache.
CHUNK = 2048
# Binary digits after the point in the position of a light among the nodes.
POSITION_BITS = 16
# A node is packed into 64 bits: its number of codes in the 17 low bits, its first code [DN] from bit 17 on, and the
# index of its first word from bit 33 on.
CODE_SHIFT, WORD_SHIFT = np.uint64(17), np.uint64(33)


@dataclass(frozen=True, eq=False)
class AliasTables:
    """Alias tables of all nodes; nodes are uniform in √(mean electrons + noise²), called the root below.

    The noise is the read noise [e-], but at least `LEAST_NOISE_E`. Mean electrons include the dark current.
    """

    first_root: float  # root of the first node [e-^½], the one without electrons
    step: float  # distance between nodes in the root [e-^½]
    is_complete: bool  # whether readings no longer change beyond the last node
    nodes: np.ndarray  # number of codes, first code and first word of each node, packed as at `CODE_SHIFT` [node]
    words: np.ndarray  # words of all codes of all nodes [word]
    mask: np.uint32  # selects the low bits of a word: the index of the other code, from the first code of the node


def sample_from_tables(distribution: ReadingDistribution, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return random readings [DN, uint16] in the shape of the light [DN]; raises ValueError for NaN light."""
    # Tables are over mean electrons, dark electrons included, and so do not depend on the exposure.
    tables = tabulate_aliases(replace(distribution, exposure_s=0.0) if distribution.exposure_s else distribution)
    flat_light = np.ascontiguousarray(light, dtype=float).reshape(-1)
    readings = np.empty(flat_light.size, np.uint16)
    gain, offset_e = distribution.sensor.gain_dn_per_e, tables.first_root**2 + distribution.mean_electrons(0.0)
    # Light at the last node but one is the brightest that has a node above.
    last = tables.nodes.size - 2.0
    # The root of (mean electrons + noise²), and the position among the nodes, follow from the light with these numbers:
    # electrons per DN of light, electrons and noise² without light, root of the first node, nodes per root, last
    # position.
    grid = (1 / gain, offset_e, tables.first_root, 1 / tables.step, last)
    # Two raw numbers, as some generators give 32 bits at a time.
    low, high = rng.bit_generator.random_raw(2)
    counter = low ^ (high << np.uint64(32))
    if not _draw_readings(flat_light, grid, tables.nodes, tables.words, tables.mask, counter, readings):
        raise ValueError(NAN_LIGHT)
    if not tables.is_complete:
        is_beyond = flat_light >= gain * ((tables.first_root + last * tables.step) ** 2 - offset_e)
        readings[is_beyond] = distribution.sample_steps(flat_light[is_beyond], rng)
    return readings.reshape(np.shape(light))[()]


@compiled
def _draw_readings(light, grid, nodes, words, mask, counter, readings):
    """Fill random readings [pixel] in DN for light [pixel] in DN; return False if a light is NaN.

    The readings are then incomplete. `grid` is that of `sample_from_tables`; `nodes`, `words` and `mask` are those of
    `AliasTables`; `counter` is that of the first pixel for `_random_bits`.
    """
    chosen_nodes, bits = np.empty(CHUNK, np.uint32), np.empty(CHUNK, np.uint64)
    for k in range(0, light.size, CHUNK):
        if not _choose_nodes(light[k : k + CHUNK], grid, counter + np.uint64(k), bits, chosen_nodes):
            return False
        _draw_codes(chosen_nodes, bits, nodes, words, mask, readings[k : k + CHUNK])
    return True


@compiled
def _random_bits(counter):
    """Return 64 random bits for a counter of 64 bits: splitmix64 (Steele et al. 2014, doi:10.1145/2660193.2660195).

    Each pixel has its own counter. A call of `sample_from_tables` starts at a random one: two calls for n pixels each
    share counters with a probability of n/2^63.
    """
    bits = counter * np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


@compiled
def _choose_nodes(light, grid, counter, bits, chosen_nodes):
    """Fill 64 random bits [pixel] and the index of a node [pixel] for light [pixel] in DN; return False if one is NaN.

    The 16 low bits choose between the next node below and the next above the light. `counter` is that of the first
    pixel, and `grid` that of `sample_from_tables`.
    """
    e_per_dn, offset_e, first_root, nodes_per_root, last = grid
    has_no_nan = True
    for k in range(light.size):
        has_no_nan &= light[k] == light[k]  # False for NaN
        bits[k] = _random_bits(counter + np.uint64(k))
        position = min((np.sqrt(max(light[k], 0.0) * e_per_dn + offset_e) - first_root) * nodes_per_root, last)
        # A random number from 0 to 1, as a binary fraction like that of the position, rounds the position up or down.
        fraction = np.int32(bits[k] & np.uint64(2**POSITION_BITS - 1))
        chosen_nodes[k] = (np.int32(position * 2**POSITION_BITS) + fraction) >> POSITION_BITS
    return has_no_nan


@compiled
def _draw_codes(chosen_nodes, bits, nodes, words, mask, readings):
    """Fill readings [pixel] in DN at the chosen nodes [pixel] by the 32 high bits of `bits` [pixel].

    These bits times the number of codes of the node give a product of 64 bits, which overwrites `bits`. Its upper half
    is the index of a word in the node; its lower half is compared with the probability in that word. Look-ups have
    loops of their own, so that the compiler turns the rest into vector instructions.
    """
    packed_nodes, pixel_words = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint32)
    for k in range(readings.size):
        packed_nodes[k] = nodes[chosen_nodes[k]]
    # The array holds first the index of each word, then the word itself.
    for k in range(readings.size):
        code_count = packed_nodes[k] & ((np.uint64(1) << CODE_SHIFT) - np.uint64(1))
        bits[k] = (bits[k] >> np.uint64(32)) * code_count
        pixel_words[k] = np.uint32(packed_nodes[k] >> WORD_SHIFT) + np.uint32(bits[k] >> np.uint64(32))
    for k in range(readings.size):
        pixel_words[k] = words[pixel_words[k]]
    for k in range(readings.size):
        main_code, other_code = np.uint32(bits[k] >> np.uint64(32)), pixel_words[k] & mask
        code = main_code if np.uint32(bits[k]) < pixel_words[k] - other_code else other_code
        readings[k] = np.uint16(np.uint32(packed_nodes[k] >> CODE_SHIFT) + code)


@lru_cache(maxsize=8)
def tabulate_aliases(distribution: ReadingDistribution) -> AliasTables:
    """Return the alias tables of a distribution, cached, up to saturation, `MOST_WORDS` or `MOST_NODES`."""
    noise_e = float(max(distribution.sensor.read_noise_e, LEAST_NOISE_E))
    # The root of (mean electrons + noise²) has a standard deviation of about 1/2.
    step = 1 / (2 * NODES_PER_SD)
    saturated_root = np.sqrt(saturating_electrons(distribution) + noise_e**2)
    # Probabilities of the codes of each node [code], from its first code on.
    node_probabilities: list[np.ndarray] = []
    first_codes: list[int] = []
    word_count, is_complete = 0, False
    while not is_complete:
        node_count = len(node_probabilities)
        codes = distribution.probabilities((noise_e + step * (node_count + np.arange(BLOCK))) ** 2 - noise_e**2)
        if node_count and (node_count + BLOCK > MOST_NODES or word_count + codes.probability.size > MOST_WORDS):
            break
        # Higher codes are stored as the largest reading.
        first_code = min(codes.first_code, LARGEST_READING)
        stored_codes = np.arange(min(codes.probability.shape[1], LARGEST_READING + 1 - first_code))
        for probability in np.add.reduceat(codes.probability, stored_codes, axis=1):
            likely = np.flatnonzero(probability > LEFT_OUT)
            node_probabilities.append(probability[likely[0] : likely[-1] + 1])
            first_codes.append(first_code + likely[0])
            word_count += node_probabilities[-1].size
        is_complete = noise_e + step * (len(node_probabilities) - 2) > saturated_root
    code_counts = np.array([probability.size for probability in node_probabilities], np.uint64)
    first_words = np.cumsum(code_counts) - code_counts
    nodes = (first_words << WORD_SHIFT) | (np.array(first_codes, np.uint64) << CODE_SHIFT) | code_counts
    other_bits = int(code_counts.max() - 1).bit_length()
    words = np.empty(word_count, np.uint32)
    _fill_words(np.concatenate(node_probabilities), code_counts.astype(np.int64), other_bits, words)
    return AliasTables(noise_e, step, is_complete, nodes, words, np.uint32(2**other_bits - 1))


@compiled
def _fill_words(probability, code_counts, other_bits, words):
    """Fill the words [word] of all nodes by Vose's form of Walker's method.

    `probability` [word] is that of the codes of all nodes, `code_counts` [node] are their numbers, and `other_bits` is
    the number of bits for the other code.
    """
    end = 0
    for code_count in code_counts:
        start, end = end, end + code_count
        # Probability of each code in units of the average one. A share above 1 fills up words of codes below 1.
        share = probability[start:end] * (code_count / np.sum(probability[start:end]))
        # A word without another code stands for its main code alone.
        other = np.arange(code_count)
        small = [k for k in range(code_count) if share[k] < 1]
        large = [k for k in range(code_count) if share[k] >= 1]
        while len(small) > 0 and len(large) > 0:
            low, high = small.pop(), large[-1]
            other[low] = high
            share[high] -= 1 - share[low]
            if share[high] < 1:
                small.append(large.pop())
        # Steps in which the share of the main code is stored.
        steps = 2.0 ** (32 - other_bits)
        for k in range(code_count):
            words[start + k] = (np.int64(min(np.rint(share[k] * steps), steps - 1)) << other_bits) | other[k]
