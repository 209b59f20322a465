"""The law of a reading as a table: mean, variance and slope at each level of light, exact where light is faint.

Given the number of electrons only read noise is random, and what follows it acts on a normal signal: its moments are
the chain's. The moments at a mean number of electrons are those, averaged over Poisson's law.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from spotcheck.model.chain import View, behind_charge
from spotcheck.model.effect import Place, Present
from spotcheck.model.sensor import SensorModel

compiled = njit(cache=True, nogil=True, error_model="numpy")

# Nodes over the root of light, on which the noise is even.
NODES = 8000
# Above this mean [e-] Poisson's law passes for normal: its skewness is below 0.02.
POISSON_E = 3000.0
# Where the table begins, in read noises below no light: a black level stated too high.
BELOW = 12.0


class ReadingLaw(NamedTuple):
    """Table over even steps of the signed root of the mean electrons, from `first` on: mean [DN], variance [DN²], and
    the slopes of both by the light [1, DN]."""

    first: float
    step: float
    mean: np.ndarray
    variance: np.ndarray
    slope: np.ndarray
    growth: np.ndarray


def reading_law(sensor: SensorModel, present: Sequence[Present], view: View, highest_e: float) -> ReadingLaw:
    """The law of a sensor with the effects that act behind the light alike on every pixel, up to `highest_e` [e-]."""
    noise = sensor.read_noise_e**2
    for own in present:
        noise = own.apply(noise) if own.effect.place is Place.NOISE else noise
    first, last = -np.sqrt(BELOW * np.sqrt(noise) + 1.0), np.sqrt(highest_e)
    root = np.linspace(first, last, NODES)
    electrons = root * np.abs(root)
    gain = sensor.gain_dn_per_e
    mean = gain * electrons
    shot = gain * np.maximum(mean, 0.0)
    out = _moments(mean, shot, gain * shot, view, present, sensor)
    faint = electrons < POISSON_E
    counts = np.arange(int(POISSON_E + 9 * np.sqrt(POISSON_E) + 14), dtype=float)
    given = _moments(gain * counts, 0 * counts, 0 * counts, view, present, sensor)
    below = electrons < 0
    for k, values in enumerate(_moments(mean[below], 0 * mean[below], 0 * mean[below], view, present, sensor)):
        out[k][below] = values
    lit = faint & ~below
    out[0][lit], out[1][lit] = _averaged(electrons[lit], *given)
    slopes = (np.gradient(own, mean) for own in out)
    return ReadingLaw(float(first), float(root[1] - root[0]), *out, *slopes)


def _moments(mean, variance, third, view: View, present: Sequence[Present], sensor: SensorModel):
    """The chain's moments of readings whose charge has these."""
    mean, variance, third = (v.reshape(1, 1, -1) for v in (mean, variance, third))
    own = behind_charge(mean, variance, third, view, present, sensor)
    return [np.array(v, float).ravel() for v in own]


@compiled
def _averaged(electrons, mean, variance):
    """Mean and variance over Poisson's law, of what each number of electrons gives."""
    first, second = np.empty(electrons.size), np.empty(electrons.size)
    for k in range(electrons.size):
        nu = electrons[k]
        reach = 8 * np.sqrt(nu) + 12
        low, high = max(int(nu - reach), 0), min(int(nu + reach), mean.size - 1)
        # Outwards from the likeliest number, so that nothing is too small to begin with.
        top = min(max(int(nu), low), high)
        total = a = b = 0.0
        part = 1.0
        for n in range(top, high + 1):
            total += part
            a += part * mean[n]
            b += part * (variance[n] + mean[n] * mean[n])
            part *= nu / (n + 1)
        part = top / nu if nu > 0 else 0.0
        for n in range(top - 1, low - 1, -1):
            total += part
            a += part * mean[n]
            b += part * (variance[n] + mean[n] * mean[n])
            part *= n / nu
        first[k] = a / total
        second[k] = max(b / total - first[k] ** 2, 1e-8)
    return first, second


@compiled
def look_up(electrons, first, step, table, out):
    """Columns of a table [column, node] at mean electrons [pixel], into `out` [column, pixel]."""
    last = table.shape[1] - 2
    for k in range(electrons.size):
        e = electrons[k]
        place = ((np.sqrt(e) if e >= 0 else -np.sqrt(-e)) - first) / step
        i = min(max(int(place), 0), last)
        part = min(max(place - i, 0.0), 1.0)
        for c in range(table.shape[0]):
            out[c, k] = table[c, i] + part * (table[c, i + 1] - table[c, i])
