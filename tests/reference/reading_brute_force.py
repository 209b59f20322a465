"""Brute force for the distribution of a camera reading; it shares no code with `spotcheck.sensor`.

P(y | μ) is the sum over electrons n of the Poisson probability of n times the integral of the normal density of the
read noise over the values that give the code y. The boundaries of those values are found by bisection on a scalar
chain. Moments, derivatives, score and Fisher information follow from P(y | μ) and ∂P(y | μ)/∂μ.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.integrate import quad_vec
from scipy.optimize import bisect
from scipy.stats import gamma, norm, poisson


@dataclass(frozen=True)
class PlainSensor:
    """A sensor given by plain numbers and scalar functions, with the same order of stages as the dataset contract."""

    gain: float  # K [DN/e-]
    noise_e: float  # standard deviation σ of the read noise [e-]
    full_scale: int  # largest code [DN]
    black: float = 0.0  # black level [DN]
    dark_e: float = 0.0  # mean dark electrons [e-]
    well_e: float = math.inf  # full well [e-]
    curvature: float = 0.0  # c [1/DN] of the response x − c x²
    smear_e: float = 0.0  # electrons added behind the Poisson draw [e-]
    charge: tuple[Callable[[float], float], ...] = ()  # functions of the signal before read noise [DN]
    response: tuple[Callable[[float], float], ...] = ()  # functions of the signal with read noise [DN]
    digital: tuple[Callable[[float], float], ...] = ()  # functions of the signal with black level [DN]
    _rows: dict[float, np.ndarray] = field(default_factory=dict, compare=False)  # signal [DN] → P(code | signal)

    def signal(self, electrons: float) -> float:
        """Return the signal [DN] of a number of electrons before read noise."""
        signal = self.gain * min(electrons + self.smear_e, self.well_e)
        for function in self.charge:
            signal = float(function(signal))
        return signal

    def code(self, signal: float) -> int:
        """Return the code [DN] of a signal [DN] that includes its read noise."""
        c = self.curvature
        if c > 0:
            signal = min(signal, 1 / (2 * c))
        if c < 0:
            signal = max(signal, 1 / (2 * c))
        value = signal - c * signal**2
        for function in self.response:
            value = float(function(value))
        value += self.black
        for function in self.digital:
            value = float(function(value))
        return int(min(max(np.rint(value), 0), self.full_scale))

    @cached_property
    def boundaries(self) -> list[float]:
        """Signals [DN] at which the code changes: `boundaries[k]` separates the codes up to k from those above k."""
        low, high = -1e4, 1e5
        found = []
        for k in range(self.full_scale):
            if self.code(low) > k:
                found.append(-math.inf)
            elif self.code(high) <= k:
                found.append(math.inf)
            else:
                side = lambda signal, k=k: 1.0 if self.code(signal) > k else -1.0  # noqa: E731
                found.append(bisect(side, low, high, xtol=1e-14, rtol=1e-15, maxiter=200))
        return found

    def given_signal(self, signal: float) -> np.ndarray:
        """Return P(code | signal before read noise) for the codes 0 … full scale."""
        if signal not in self._rows:
            self._rows[signal] = self._integrate(signal)
        return self._rows[signal]

    def _integrate(self, signal: float) -> np.ndarray:
        row = np.zeros(self.full_scale + 1)
        if self.noise_e == 0:
            row[self.code(signal)] = 1.0
            return row
        ends = (np.array([-math.inf, *self.boundaries, math.inf]) - signal) / (self.gain * self.noise_e)
        # A difference of tails; that of the smaller tail keeps more digits.
        return np.where(ends[1:] < 0, np.diff(norm.cdf(ends)), -np.diff(norm.sf(ends)))

    def probabilities(self, mean_e: float) -> tuple[np.ndarray, np.ndarray]:
        """Return P(code | mean electrons) and its derivative by the mean electrons [1/e-], both [code].

        Below 0 the number of electrons is the mean itself. The derivative then follows from the normal density at the
        boundaries, for a sensor without charge functions.
        """
        if mean_e < 0:
            return self._probabilities_below_zero(mean_e)
        reach = 11 * math.sqrt(mean_e) + 40
        counts = np.arange(max(math.floor(mean_e - reach), 0), math.ceil(mean_e + reach) + 1)
        weight = poisson.pmf(counts, mean_e)
        # d/dμ of e^−μ μ^n / n!
        weight_slope = poisson.pmf(counts - 1, mean_e) - weight
        rows = np.array([self.given_signal(self.signal(float(n))) for n in counts])
        return weight @ rows, weight_slope @ rows

    def _probabilities_below_zero(self, mean_e: float) -> tuple[np.ndarray, np.ndarray]:
        signal, sigma = self.signal(mean_e), self.gain * self.noise_e
        ends = np.array([-math.inf, *self.boundaries, math.inf])
        density = norm.pdf((ends - signal) / sigma) / sigma if sigma else np.zeros(ends.size)
        return self.given_signal(signal), -self.gain * np.diff(density)

    def law(self, light: float) -> ReadingLaw:
        """Return the distribution of the reading at a light [DN]."""
        probability, slope = self.probabilities(light / self.gain + self.dark_e)
        return ReadingLaw(probability, slope / self.gain)


@dataclass(frozen=True)
class ReadingLaw:
    """Probabilities of the codes 0, 1, 2 … and what follows from them."""

    probability: np.ndarray  # P(y | L) [code]
    slope: np.ndarray  # ∂P(y | L)/∂L [code, 1/DN]

    @property
    def codes(self) -> np.ndarray:
        return np.arange(self.probability.size)

    @property
    def cdf(self) -> np.ndarray:
        """P(at most y | L) [code]."""
        return np.array([math.fsum(self.probability[: k + 1]) for k in self.codes])

    @property
    def mean(self) -> float:
        return math.fsum(self.codes * self.probability)

    @property
    def variance(self) -> float:
        return math.fsum((self.codes - self.mean) ** 2 * self.probability)

    @property
    def mean_slope(self) -> float:
        return math.fsum(self.codes * self.slope)

    @property
    def variance_slope(self) -> float:
        """d(E[y²] − E[y]²)/dL; the sum is taken around the mean, which changes nothing as the slopes sum to 0."""
        around = self.codes - self.mean
        return math.fsum(around**2 * self.slope) - 2 * self.mean_slope * math.fsum(around * self.probability)

    @property
    def fisher_information(self) -> float:
        """Fisher information on the light [1/DN²]."""
        possible = self.probability > 0
        return math.fsum(self.slope[possible] ** 2 / self.probability[possible])


def mixed_charge_levels(sensor: PlainSensor, levels: Sequence[tuple[float, float]], light: float) -> ReadingLaw:
    """Return the distribution over pixels whose charge stops at different levels, given as (share, level [DN])."""
    laws = []
    for share, level in levels:
        # A fresh cache of rows: the replaced sensor has another charge function.
        stopped = replace(sensor, charge=(*sensor.charge, lambda x, level=level: min(x, level)), _rows={})
        laws.append((share, stopped.law(light)))
    return ReadingLaw(
        np.sum([share * law.probability for share, law in laws], axis=0),
        np.sum([share * law.slope for share, law in laws], axis=0),
    )


def mixed_factor(
    sensor: PlainSensor, density: Callable[[float], float], ends: Sequence[float], light: float, pedestal: float = 0.0
) -> ReadingLaw:
    """Return the distribution where the light is g L + pedestal with a density of g, between the given ends of g.

    `ends` holds increasing break points of the integral over g.
    """

    def integrand(g: float) -> np.ndarray:
        law = sensor.law(g * light + pedestal)
        return density(g) * np.concatenate([law.probability, g * law.slope])

    total = sum(quad_vec(integrand, a, b, epsabs=1e-8, epsrel=1e-8)[0] for a, b in itertools.pairwise(ends))
    probability, slope = np.split(total, 2)
    return ReadingLaw(probability, slope)


def granular_light(sensor: PlainSensor, contrast: float, light: float, pedestal: float = 0.0) -> ReadingLaw:
    """Return the distribution under granular light: g follows a gamma distribution of mean 1 and variance C²."""
    law = gamma(contrast**-2, scale=contrast**2)
    ends = [0.0, *law.ppf([1e-6, 0.01, 0.2, 0.5, 0.8, 0.99]), law.isf(1e-6), law.isf(1e-13)]
    return mixed_factor(sensor, law.pdf, ends, light, pedestal)


def gain_scatter(sensor: PlainSensor, rms: float, light: float) -> ReadingLaw:
    """Return the distribution where the light is multiplied by a normal factor of mean 1 and deviation `rms`."""
    law = norm(1.0, rms)
    return mixed_factor(sensor, law.pdf, [1 + rms * z for z in (-8.0, -4.0, -2.0, 0.0, 2.0, 4.0, 8.0)], light)
