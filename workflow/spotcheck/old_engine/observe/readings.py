"""The law of a reading as a table: mean, variance and slope at each level of light, exact where light is faint.

Given the number of electrons only read noise is random, and what follows it acts on a normal signal: its moments are
the chain's. The moments at a mean number of electrons are those, averaged over Poisson's law.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from spotcheck.old_engine.model.chain import View, behind_charge, grain_law
from spotcheck.old_engine.model.effect import Place, Present
from spotcheck.old_engine.model.sensor import SensorModel

compiled = njit(cache=True, nogil=True, error_model="numpy")

# Nodes over the root of light, on which the noise is even.
NODES = 8000
# Above this mean [e-] Poisson's law passes for normal: its skewness is below 0.02.
POISSON_E = 3000.0
# Readings further than this many standard deviations from their mean do not count [1]: what is beyond is 1e-18.
FARTHEST = 9.0
ROOT_HALF = math.sqrt(0.5)
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


def through_field(law: ReadingLaw, contrast: float, gain: float) -> ReadingLaw:
    """The law of a reading whose light a field of that contrast multiplies."""
    if contrast <= 0:
        return law
    factors, weights = grain_law(contrast)
    root = law.first + law.step * np.arange(law.mean.size)
    means, variances = (
        np.stack([np.interp(root * np.sqrt(f), root, own) for f in factors]) for own in (law.mean, law.variance)
    )
    mean = weights @ means
    variance = weights @ variances + weights @ (means - mean) ** 2
    light = gain * root * np.abs(root)
    slopes = np.gradient(mean, light), np.gradient(variance, light)
    return ReadingLaw(law.first, law.step, mean, variance, *slopes)


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
    """Columns of a table [node, column] at mean electrons [row, column of pixels], into `out` [column, row, column]."""
    last = table.shape[0] - 2
    for r in range(electrons.shape[0]):
        for k in range(electrons.shape[1]):
            e = electrons[r, k]
            place = ((np.sqrt(e) if e >= 0 else -np.sqrt(-e)) - first) / step
            i = min(max(int(place), 0), last)
            part = min(max(place - i, 0.0), 1.0)
            for c in range(table.shape[1]):
                out[c, r, k] = table[i, c] + part * (table[i + 1, c] - table[i, c])


class Cumulants(NamedTuple):
    """Exact mean [DN], variance [DN²], third [DN³] and fourth cumulant [DN⁴] of a linear sensor's readings [level]."""

    mean: np.ndarray
    variance: np.ndarray
    third: np.ndarray
    fourth: np.ndarray


def cumulants_of(sensor: SensorModel, electrons: np.ndarray) -> Cumulants:
    """Cumulants at mean numbers of electrons [level], by sums over electrons and readings: no effect is in them.

    # ASSUME: shot noise above `POISSON_E` is normal but for its own third and fourth cumulant, and no well is full.
    """
    top = min(sensor.full_scale_dn, 65535.0)
    gain, black, noise = sensor.gain_dn_per_e, sensor.black_level_dn, sensor.read_noise_e
    electrons = np.asarray(electrons, float)
    counts = np.arange(int(POISSON_E + 9 * np.sqrt(POISSON_E) + 14), dtype=float)
    read = np.full(counts.size, gain * noise)
    given = _moments_given(gain * np.minimum(counts, sensor.full_well_e) + black, read, top)
    out = np.empty((4, electrons.size))
    dark, bright = electrons < 0, electrons >= POISSON_E
    lit = ~dark & ~bright
    out[:, lit] = _mixed(electrons[lit], given)
    for own in (dark, bright):
        spread = gain * np.sqrt(np.maximum(electrons[own], 0.0) + noise**2)
        out[:, own] = _moments_given(gain * electrons[own] + black, spread, top)
    inside = np.where(bright & (gain * electrons + black < top), electrons, 0.0)
    out[2] += gain**3 * inside
    out[3] += gain**4 * inside - 3 * out[1] ** 2
    return Cumulants(*out)


@compiled
def _moments_given(signal, spread, top):
    """Mean and second, third, fourth central moment [4, signal] of rint(N(signal, spread²)), cut at 0 and `top`."""
    out = np.empty((4, signal.size))
    for k in range(signal.size):
        m, sd = signal[k], max(spread[k], 1e-9)
        low = min(max(math.floor(m - FARTHEST * sd), 0.0), top)
        high = max(min(math.ceil(m + FARTHEST * sd), top), low)
        about = min(max(m, low), high)
        total = a = b = c = d = 0.0
        edge = 0.0
        for j in range(int(high - low) + 1):
            y = low + j
            # Differences of the nearer tail, so that small probabilities keep their digits.
            t = (y + 0.5 - m) / sd * ROOT_HALF
            if y == high:
                part = 0.5 * math.erfc(edge) if j else 1.0
            elif j == 0:
                part = 0.5 * math.erfc(-t)
            elif edge > 0:
                part = 0.5 * (math.erfc(edge) - math.erfc(t))
            else:
                part = 0.5 * (math.erfc(-t) - math.erfc(-edge))
            edge = t
            r = y - about
            total += part
            a += part * r
            b += part * r * r
            c += part * r * r * r
            d += part * r * r * r * r
        a, b, c, d = a / total, b / total, c / total, d / total
        out[0, k] = about + a
        out[1, k] = b - a * a
        out[2, k] = c - 3 * a * b + 2 * a**3
        out[3, k] = d - 4 * a * c + 6 * a * a * b - 3 * a**4
    return out


@compiled
def _mixed(electrons, given):
    """Central moments [4, level] over Poisson's law of moments that each number of electrons gives [4, count]."""
    out = np.zeros((4, electrons.size))
    for k in range(electrons.size):
        nu = electrons[k]
        reach = 9 * np.sqrt(nu) + 14
        low, high = max(int(nu - reach), 0), min(int(nu + reach), given.shape[1] - 1)
        top = min(max(int(nu), low), high)
        weight = np.zeros(high - low + 1)
        weight[top - low] = 1.0
        for n in range(top + 1, high + 1):
            weight[n - low] = weight[n - low - 1] * nu / n
        for n in range(top - 1, low - 1, -1):
            weight[n - low] = weight[n - low + 1] * (n + 1) / nu if nu > 0 else 0.0
        total = weight.sum()
        mean = 0.0
        for n in range(low, high + 1):
            mean += weight[n - low] / total * given[0, n]
        out[0, k] = mean
        for n in range(low, high + 1):
            part, d = weight[n - low] / total, given[0, n] - mean
            out[1, k] += part * (d * d + given[1, n])
            square = d * d
            out[2, k] += part * (d * (square + 3 * given[1, n]) + given[2, n])
            out[3, k] += part * (square * (square + 6 * given[1, n]) + 4 * d * given[2, n] + given[3, n])
    return out
