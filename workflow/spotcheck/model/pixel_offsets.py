"""Mean and variance of readings of pixels whose offsets differ, as under an uneven pedestal of the converter."""

from dataclasses import replace
from functools import reduce

import numpy as np

from spotcheck.sensor import ROUNDING_VARIANCE, ReadingDistribution, ReadingMoments

# Standard deviation [DN] of Gaussian noise with which rounding is negligible: the mean reading is linear in an offset
# to 1e-4 DN.
HIDDEN_ROUNDING = 0.7
# Distance [standard deviations] of readings from the ends of the converter from which on these have no influence.
FAR_FROM_ENDS = 4.5
# Distance of the tables between which offsets of pixels are interpolated: this part of the noise in the dark, and at
# least so much [DN].
OFFSET_STEP, LEAST_OFFSET_STEP_DN = 1 / 4, 1e-3
# Nodes of the cubic through four neighbouring tables: an offset lies between nodes 0 and 1.
CUBIC_NODES = (-1, 0, 1, 2)


def moments_with_offsets(
    distribution: ReadingDistribution, light: np.ndarray, smear_e=0.0, offset_dn=0.0
) -> ReadingMoments:
    """Return mean and variance of readings and their slopes, each in the shape of the light.

    Parameters
    ----------
    distribution : ReadingDistribution
        Distribution of a reading as a function of its light, for a pixel without offset.
    light : array [row, column]
        Light of each pixel [DN].
    smear_e : float or array that broadcasts
        Electrons without shot noise that are added to each pixel [e-].
    offset_dn : float or array that broadcasts
        Offset of each pixel in addition to the black level [DN]. A number is ignored, as it is part of the black level.

    Notes
    -----
    An offset adds to the mean of pixels whose noise makes rounding negligible and whose readings lie far from both
    ends of the converter. Moments of other pixels are interpolated by cubics between tables for equidistant offsets,
    since rounding and black clipping depend on where a signal lies between whole numbers.
    """
    highest = float(np.max(light)) + distribution.sensor.gain_dn_per_e * float(np.max(smear_e))
    without = distribution.tabulate(highest).moments(light, smear_e)
    if np.ndim(offset_dn) == 0:
        return without
    moments = without._replace(mean=without.mean + offset_dn)
    needs_tables = ~_hides_rounding(distribution, light, without) | ~_is_far_from_ends(distribution, moments)
    if not needs_tables.any():
        return moments
    smear, offset = (np.broadcast_to(values, np.shape(light))[needs_tables] for values in (smear_e, offset_dn))
    interpolated = _interpolate_offsets(distribution, light[needs_tables], smear, offset)
    for values, tabulated in zip(moments, interpolated, strict=True):
        values[needs_tables] = tabulated
    return moments


def _hides_rounding(distribution: ReadingDistribution, light: np.ndarray, moments: ReadingMoments) -> np.ndarray:
    """Return for which pixels the noise is as good as Gaussian noise of `HIDDEN_ROUNDING` at hiding the rounding.

    The mean of a rounded value oscillates with it in proportion to the characteristic function of the noise at one
    cycle per DN, exp(−2π² s²) for Gaussian noise of standard deviation s [DN] and exp(−ν (1 − cos 2πK)) for a Poisson
    number of electrons with mean ν. `moments` are those at `light` [DN]. Stages behind the rounding hide nothing.
    """
    if distribution.digital:
        return np.zeros(np.shape(light), bool)
    electrons = np.maximum(distribution.mean_electrons(light), 0.0)
    shot = electrons * (1 - np.cos(2 * np.pi * distribution.sensor.gain_dn_per_e)) * moments.mean_slope**2
    return 2 * np.pi**2 * (HIDDEN_ROUNDING**2 - distribution.noise_dn**2) < shot


def _is_far_from_ends(distribution: ReadingDistribution, moments: ReadingMoments) -> np.ndarray:
    """Return for which pixels readings with these moments stay clear of both ends of the converter."""
    margin = FAR_FROM_ENDS * np.sqrt(np.maximum(moments.variance, 0.0))
    return (moments.mean - margin > 0) & (moments.mean + margin < distribution.sensor.full_scale_dn)


def _interpolate_offsets(
    distribution: ReadingDistribution, light: np.ndarray, smear_e: np.ndarray, offset_dn: np.ndarray
) -> list[np.ndarray]:
    """Return the moments of pixels [moment, pixel] with offsets, interpolated between tables for equidistant offsets.

    All arguments are as in `moments_with_offsets`, but [pixel].
    """
    highest = float(np.max(light)) + distribution.sensor.gain_dn_per_e * float(np.max(smear_e))
    step = max(np.sqrt(distribution.noise_dn**2 + ROUNDING_VARIANCE) * OFFSET_STEP, LEAST_OFFSET_STEP_DN)
    # Offset of each pixel in steps: its whole number of steps, and the rest.
    offset_steps = offset_dn / step
    low = np.floor(offset_steps).astype(int)
    fraction = offset_steps - low
    sums = [np.zeros(len(light)) for _ in ReadingMoments._fields]
    black_level = distribution.sensor.black_level_dn
    # One table for each whole number of steps. It contributes to the pixels for which it is one of `CUBIC_NODES`.
    for whole_steps in range(int(low.min()) + CUBIC_NODES[0], int(low.max()) + CUBIC_NODES[-1] + 1):
        # Number of this table as a node of each pixel [pixel].
        node = whole_steps - low
        is_near = (node >= CUBIC_NODES[0]) & (node <= CUBIC_NODES[-1])
        if not is_near.any():
            continue
        sensor = replace(distribution.sensor, black_level_dn=black_level + whole_steps * step)
        shifted = replace(distribution, sensor=sensor)
        moments = shifted.tabulate(highest).moments(light[is_near], smear_e[is_near])
        weight = _lagrange(fraction[is_near], node[is_near])
        for total, values in zip(sums, moments, strict=True):
            total[is_near] += weight * values
    return sums


def _lagrange(fraction: np.ndarray, node: np.ndarray) -> np.ndarray:
    """Return the Lagrange weight [pixel] of a node in the cubic through `CUBIC_NODES`.

    The weight is Π (`fraction` − k)/(`node` − k) over the other nodes k. `node` [pixel] is one of `CUBIC_NODES`; the
    cubic is evaluated at `fraction` [pixel] of a step beyond node 0.
    """
    # The node itself has the factor 1; its divisor, which would be 0, is replaced.
    factors = [np.where(node == k, 1.0, (fraction - k) / np.where(node == k, 1, node - k)) for k in CUBIC_NODES]
    return reduce(np.multiply, factors)
