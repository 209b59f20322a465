"""The distribution of one reading given its light: the one definition that simulation, fits and bounds share.

Order of the chain (dataset contract): Poisson electrons of light and dark current → + smear → full well → gain K →
charge → + read noise → response → black level → digital → one rounding → 0 … full scale.

A code is one output value of the converter: a whole number of DN (digital numbers). The light is K times the mean
photo-electrons of a pixel, and a signal is K times its electrons, both in DN without black level. Smear is charge that
a pixel collects during readout. A band [row, code] holds probabilities of consecutive codes; the code of its first
column differs from row to row. Brackets give the shape of an array, with one item per mean, signal, code, ….
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import pdtrc
from scipy.stats import poisson

from spotcheck.sensor.codes import (
    LARGEST_READING,
    MOST_ELECTRONS,
    NOISE_SD,
    CodeProbabilities,
    Cumulants,
    fill_noisy_moments,
    find_possible_counts,
    integrate_read_noise,
    sum_over_electrons,
)
from spotcheck.sensor.response import apply_curvature, remove_curvature
from spotcheck.sensor.sampling import NAN_LIGHT, sample_from_tables
from spotcheck.sensor.table import ReadingMoments, ReadingTable, tabulate_readings

if TYPE_CHECKING:
    from spotcheck.sensor.model import SensorModel

# A function signal [DN] → signal [DN] that never decreases. Results are cached for functions that compare equal.
Transfer = Callable[[np.ndarray], np.ndarray]

# Steps of the bisection that inverts a response. Each halves the interval, so that 80 reach the floating-point limit.
BISECTIONS = 80
# Number of pixels from which on `sample` is faster with tables.
FEWEST_FOR_TABLES = 4096
# Step of the finite difference by the mean electrons for negative light, in standard deviations of the read noise.
NEGATIVE_LIGHT_STEP = 1e-4
# Mean numbers of electrons that are summed at a time; they share the probabilities of codes given the electrons.
BLOCK = 64
# Standard deviations of the electrons that one such block may span.
BLOCK_SPAN = 20.0


@dataclass(frozen=True)
class ReadingDistribution:
    """Distribution of one reading y [DN] given the light L [DN of signal without black level].

    L is K times the mean number of photo-electrons. N electrons of light and dark current are Poisson distributed, the
    read noise is Gaussian, and everything else is a function that never decreases:

    y = clip(round(digital(response(charge(K (N + smear)) + K σ_d z) + black level)), 0, full scale)

    The full well is part of `charge`, and the curvature part of `response`. For negative mean electrons, as in fits
    with a black level stated too high, N is that mean without shot noise; `sample` takes it for 0. Tails beyond 8.5
    standard deviations, of probability 1e-17, are left out.

    Parameters
    ----------
    sensor : SensorModel
        Gain, read noise, dark current, full well, response curvature, black level and full scale.
    exposure_s : float
        Exposure [s], which counts for the dark current alone.
    smear_e : float
        Electrons that are added behind the Poisson draw, without noise of their own [e-].
    charge : tuple of Transfer
        Functions of the signal [DN] before read noise, in this order, behind the full well.
    charge_levels : tuple of (share, level)
        Share [1] of the pixels whose charge stops at a level [DN]; shares sum to 1. Empty: all pixels are alike.
    response : tuple of Transfer
        Functions of the signal with read noise [DN without black level], in this order, behind the curvature.
    digital : tuple of Transfer
        Functions of the signal [DN with black level] in front of the rounding.

    References
    ----------
    EMVA 1288 Release 4.0 Linear, Sections 2 and 3; Eqs. 15, 16 and 23–25 of the paper.

    Examples
    --------
    >>> from spotcheck.sensor import ReadingDistribution, SensorModel
    >>> reading = ReadingDistribution(SensorModel(gain_dn_per_e=0.5, read_noise_e=4.0, full_scale_dn=255))
    >>> print(f"{reading.mean(100.0):.3f} DN, {reading.variance(100.0):.3f} DN²")
    100.000 DN, 54.083 DN²
    >>> print(f"{reading.pmf(255, 250.0):.4f}")
    0.3438
    """

    sensor: SensorModel
    exposure_s: float = 0.0
    smear_e: float = 0.0
    charge: tuple[Transfer, ...] = ()
    charge_levels: tuple[tuple[float, float], ...] = ()
    response: tuple[Transfer, ...] = ()
    digital: tuple[Transfer, ...] = ()

    # Probabilities.

    def pmf(self, reading: ArrayLike, light: ArrayLike) -> np.ndarray:
        """Return P(y | L) of whole readings [DN] at light [DN]; both broadcast."""
        return self._at_readings(reading, light, lambda codes: codes.probability, (0.0, 0.0))

    def cdf(self, reading: ArrayLike, light: ArrayLike) -> np.ndarray:
        """Return P(at most y | L) of readings [DN] at light [DN]; both broadcast."""
        return self._at_readings(reading, light, lambda codes: np.cumsum(codes.probability, axis=1), (0.0, 1.0))

    # Moments.

    def mean(self, light: ArrayLike) -> np.ndarray:
        """Return the mean reading [DN] at light [DN]."""
        return self.cumulants(light).mean

    def variance(self, light: ArrayLike) -> np.ndarray:
        """Return the variance [DN²] of the reading at light [DN]."""
        return self.cumulants(light).variance

    def fisher_information(self, light: ArrayLike) -> np.ndarray:
        """Return the Fisher information [1/DN²] of a reading on the light, at light [DN]."""
        return self.cumulants(light).information

    def cumulants(self, light: ArrayLike) -> Cumulants:
        """Return mean, variance, their slopes and the Fisher information at light [DN] in one pass, in its shape."""
        light = np.asarray(light, float)
        mean_e, index = np.unique(self.mean_electrons(light), return_inverse=True)
        cumulants = np.empty((len(Cumulants._fields), mean_e.size))
        for block in _split_into_blocks(mean_e):
            cumulants[:, block] = self.probabilities(mean_e[block]).cumulants(self.sensor.gain_dn_per_e)
        return Cumulants(*cumulants[:, index.reshape(light.shape)])

    def moments(self, light: np.ndarray) -> ReadingMoments:
        """Return mean and variance of readings and their slopes by the light.

        The moments of a reading given the number of electrons are averaged over the Poisson distribution. This is many
        times faster than computing the probability of each code (`cumulants`).
        `light` [light] in DN is at least 0 and ascends.
        """
        mean_e = self.mean_electrons(light)
        signal = self.charge_signal(np.arange(find_possible_counts(mean_e[-1])[1] + 1.0))
        # Mean and variance of a reading given each number of electrons, from 0 on [2, count].
        given_counts = self._moments_given_signal(signal)
        # The same for a pixel whose charge stops at each charge level [2, charge level].
        given_level = self._moments_given_signal(np.minimum([level for _, level in self.charge_levels], signal[-1]))
        # Mean, variance, and their slopes by the mean electrons.
        moments = np.empty((4, mean_e.size))
        for block in _split_into_blocks(mean_e):
            low, high = find_possible_counts(mean_e[block][0])[0], find_possible_counts(mean_e[block][-1])[1]
            # Readings are taken less that in the middle of the block: a small variance, as the difference of large
            # squares, would lose digits.
            middle = given_counts[0, (low + high) // 2]
            # Means of the powers 0, 1 and 2 of reading − middle, as columns [count or charge level, power].
            powers, level_powers = (
                np.stack([np.ones(mean.size), mean - middle, variance + (mean - middle) ** 2], axis=1)
                for mean, variance in (given_counts[:, low : high + 1], given_level)
            )
            # Sums over the Poisson distribution of each mean number of electrons. All rows begin at column 0.
            sums = self._sum_over_counts(mean_e[block], low, np.zeros(len(powers), np.int64), powers, level_powers)
            # Sums of the powers 0, 1 and 2, and their derivatives by the mean electrons.
            (total, shift, square), (total_slope, shift_slope, square_slope) = np.moveaxis(sums, 2, 1)
            # The weights sum to `total`, which is 1 up to rounding.
            shift, square = shift / total, square / total
            shift_slope = (shift_slope - shift * total_slope) / total
            square_slope = (square_slope - square * total_slope) / total
            moments[:, block] = middle + shift, square - shift**2, shift_slope, square_slope - 2 * shift * shift_slope
        return ReadingMoments(moments[0], moments[1], *(moments[2:] / self.sensor.gain_dn_per_e))

    def expected_maximum(self, light: ArrayLike) -> float:
        """Return the mean of the largest reading [DN] of independent pixels at light [DN]: Σ_k [1 − Π P(at most k)].

        The sum runs over codes k, the product over pixels; `light` is an array of any shape.
        """
        light, count = np.unique(light, return_counts=True)
        codes = self.probabilities(self.mean_electrons(light[-1:])).codes
        # Pixels that always read less than the brightest one do not change the maximum.
        moments = self.tabulate(float(light[-1])).moments(light)
        is_near = moments.mean + NOISE_SD * np.sqrt(np.maximum(moments.variance, 0.0)) + 1 >= codes[0]
        with np.errstate(divide="ignore"):
            log_at_most = np.log(self.cdf(codes[:-1, None], light[is_near])) @ count[is_near]
        return float(codes[0] - np.expm1(log_at_most).sum())

    # Other forms.

    def tabulate(self, light_max: float) -> ReadingTable:
        """Return mean, variance, slopes and information as a table over the light up to `light_max` [DN].

        It serves to evaluate millions of pixels. The table goes at least that far: `light_max` is rounded up to a power
        of two, so that images share tables.
        """
        return tabulate_readings(self, 2.0 ** np.ceil(np.log2(max(light_max, 1.0))))

    def sample(
        self,
        light: ArrayLike,
        rng: np.random.Generator,
        *,
        smear_e: ArrayLike = 0.0,
        charge_level: ArrayLike = np.inf,
        offset_dn: ArrayLike = 0.0,
    ) -> np.ndarray:
        """Return random readings [DN, uint16] of the shape of `light` [DN].

        Parameters
        ----------
        light : array
            Light of each pixel [DN]; below 0 it counts as none.
        rng : numpy.random.Generator
            Source of the random numbers.
        smear_e, charge_level, offset_dn : arrays that broadcast to `light`
            Values of each pixel: electrons added behind the Poisson draw [e-] on top of `self.smear_e`; level at which
            its charge stops [DN]; and what is added behind the response [DN], such as row noise.

        Notes
        -----
        One uniform number and a look-up in a table gives a reading (`spotcheck.sensor.sampling`). The chain is drawn
        step by step if `smear_e`, `charge_level` or `offset_dn` is given, with charge levels, or for few pixels.
        """
        light = np.asarray(light, float)
        pixel_values = (smear_e, charge_level, offset_dn)
        are_pixels_alike = all(np.isscalar(value) for value in pixel_values) and pixel_values == (0.0, np.inf, 0.0)
        if are_pixels_alike and not self.charge_levels and light.size >= FEWEST_FOR_TABLES:
            return sample_from_tables(self, light, rng)
        if np.isnan(np.min(light, initial=0.0)):
            raise ValueError(NAN_LIGHT)
        return self.sample_steps(light, rng, *pixel_values)

    def sample_steps(
        self, light: np.ndarray, rng: np.random.Generator, smear_e=0.0, charge_level=np.inf, offset_dn=0.0
    ) -> np.ndarray:
        """Return random readings [DN, uint16] by drawing the chain step by step; arguments as for `sample`."""
        electrons = rng.poisson(np.minimum(self.mean_electrons(np.maximum(light, 0.0)), MOST_ELECTRONS))
        if self.charge_levels:
            shares, charge_levels = np.transpose(self.charge_levels)
            charge_level = np.minimum(charge_level, rng.choice(charge_levels, light.shape, p=shares / shares.sum()))
        signal = np.minimum(self.charge_signal(electrons + smear_e), charge_level)
        signal = signal + self.noise_dn * rng.standard_normal(light.shape)
        highest = np.rint(min(self.sensor.full_scale_dn, LARGEST_READING))
        return np.clip(np.rint(self.converter_signal(signal, offset_dn)), 0, highest).astype(np.uint16)

    # Steps of the chain.

    @property
    def noise_dn(self) -> float:
        """Standard deviation of the read noise [DN]."""
        return self.sensor.gain_dn_per_e * self.sensor.read_noise_e

    def mean_electrons(self, light):
        """Return the mean electrons [e-] of light [DN] and dark current, in the shape of the light."""
        return light / self.sensor.gain_dn_per_e + self.sensor.dark_current_e_per_s * self.exposure_s

    def charge_signal(self, electrons):
        """Return the signal [DN] before read noise of a number of electrons [e-], to which `self.smear_e` is added."""
        signal = self.sensor.gain_dn_per_e * np.minimum(electrons + self.smear_e, self.sensor.full_well_e)
        for transfer in self.charge:
            signal = transfer(signal)
        return signal

    def converter_signal(self, signal, offset_dn=0.0):
        """Return the value [DN with black level] that is rounded to the reading, from a signal [DN] with read noise.

        `offset_dn` is added behind the response.
        """
        signal = apply_curvature(signal, self.sensor.curvature)
        for transfer in self.response:
            signal = transfer(signal)
        signal = signal + self.sensor.black_level_dn + offset_dn
        for transfer in self.digital:
            signal = transfer(signal)
        return signal

    # Sums.

    def probabilities(self, mean_e: np.ndarray) -> CodeProbabilities:
        """Return the probability of all codes at mean electrons [mean] in e-.

        The means must be sorted, and either all below 0 or none.
        """
        if mean_e[0] < 0:
            return self._probabilities_below_zero(mean_e)
        # Numbers of electrons that occur, and the band of codes of each.
        low, high = find_possible_counts(mean_e[0])[0], find_possible_counts(mean_e[-1])[1]
        first, band = self._pmf_given_signal(self.charge_signal(np.arange(low, high + 1.0)))
        # Lowest code, and the one after the highest.
        lowest, end = int(first.min()), int(first.max()) + band.shape[1]
        # Probabilities of the codes of pixels whose charge stops at each level [charge level, code].
        stopped = np.zeros((0, end - lowest))
        if self.charge_levels:
            # Levels above all signals stop no pixel; they are lowered, as an infinite one has no code.
            levels = np.minimum([level for _, level in self.charge_levels], self.charge_signal(np.array([high]))[0])
            stopped_first, stopped = self._pmf_given_signal(levels)
            lowest, end = min(lowest, int(stopped_first.min())), max(end, int(stopped_first.max()) + stopped.shape[1])
            stopped = _fill_columns(stopped_first - lowest, stopped, end - lowest)
        probability, slope = self._sum_over_counts(mean_e, low, first - lowest, band, stopped)
        # Poisson weights share a relative error of 1e-9: the first is exp(n ln µ − …), with terms of many thousands.
        total = probability.sum(axis=1, keepdims=True)
        return CodeProbabilities(lowest, probability / total, slope / total)

    def _sum_over_counts(
        self, mean_e: np.ndarray, low: int, first: np.ndarray, band: np.ndarray, stopped: np.ndarray
    ) -> np.ndarray:
        """Return sums of values over the Poisson distribution of electrons, and their slopes [2, mean, column].

        The sums are weighted with the probability of each number of electrons. These weights sum to 1 up to rounding.
        Slopes are derivatives by the mean of the distribution, in 1/e-.

        Parameters
        ----------
        mean_e : means of the distribution [mean] in e-, increasing.
        low : number of electrons of the first row of `band`.
        first : column of the result at which each row of `band` begins [count].
        band : values for each number of electrons of a pixel whose charge does not stop [count, …].
        stopped : values of a pixel whose charge stops at each charge level [charge level, column].
        """
        shares, levels = np.array(self.charge_levels).reshape(-1, 2).T
        # Smallest number of electrons whose charge exceeds each level [charge level].
        stop = np.searchsorted(self.charge_signal(np.arange(low + len(band) + 0.0)), levels, side="right")
        band = band * (1 - shares @ (low + np.arange(len(band)) >= stop[:, None]))[:, None]
        sums, slopes = result = np.zeros((2, mean_e.size, stopped.shape[1]))
        # Adds to both arrays, whose columns begin at code 0.
        sum_over_electrons(np.ascontiguousarray(mean_e), low, first, band, 0, sums, slopes)
        # The probability of `stop` electrons or more, and its derivative P(stop − 1).
        sums += np.where(stop > 0, pdtrc(stop - 1.0, mean_e[:, None]), 1.0) @ (shares[:, None] * stopped)
        slopes += np.where(stop > 0, poisson.pmf(stop - 1.0, mean_e[:, None]), 0.0) @ (shares[:, None] * stopped)
        return result

    def _moments_given_signal(self, signal: np.ndarray) -> np.ndarray:
        """Return mean [DN] and variance [DN²] of a reading given its signal before read noise [2, signal]."""
        moments = np.zeros((2, signal.size))
        if signal.size == 0:
            return moments
        lowest, edges = self._find_code_edges(signal)
        if self.noise_dn == 0:
            moments[0] = self._code_without_noise(signal, lowest, edges)
            return moments
        fill_noisy_moments(signal, self.noise_dn, edges, np.searchsorted(edges, signal), moments)
        moments[0] += lowest
        return moments

    def _probabilities_below_zero(self, mean_e: np.ndarray) -> CodeProbabilities:
        """Return the probabilities for means [mean] below 0 in e-, whose readings have read noise but no shot noise.

        Slopes are central differences. Without read noise they are 0.
        """
        step = NEGATIVE_LIGHT_STEP * self.sensor.read_noise_e
        first, band = self._pmf_given_signal(self.charge_signal(np.concatenate([mean_e, mean_e - step, mean_e + step])))
        lowest = int(first.min())
        columns = _fill_columns(first - lowest, band, int(first.max()) + band.shape[1] - lowest)
        probability, before, after = np.split(columns, 3)
        return CodeProbabilities(lowest, probability, (after - before) / (2 * step) if step else 0 * probability)

    def _pmf_given_signal(self, signal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first code [signal] and the band of code probabilities [signal, code] of signals [signal] in DN.

        The signals are those before read noise. Column j of the band is for the code `first` + j.
        """
        lowest, edges = self._find_code_edges(signal)
        if self.noise_dn == 0:
            return self._code_without_noise(signal, lowest, edges).astype(np.int64), np.ones((signal.size, 1))
        first, band = integrate_read_noise(signal, self.noise_dn, edges)
        return first + lowest, band

    def _code_without_noise(self, signal: np.ndarray, lowest: int, edges: np.ndarray) -> np.ndarray:
        """Return the code [signal] of signals [signal] in DN without read noise, from those of `_find_code_edges`."""
        return np.clip(np.rint(self.converter_signal(signal)), lowest, lowest + edges.size)

    def _find_code_edges(self, signal: np.ndarray) -> tuple[int, np.ndarray]:
        """Return the lowest code that signals [signal] in DN can give, and the upper ends of the codes from it on.

        `signal` is before read noise. The ends [edge] in DN are the signals, read noise included, from which on the
        reading is the next code. The highest code has no end.
        """
        half_width = NOISE_SD * self.noise_dn
        low, high = float(np.min(signal)) - half_width, float(np.max(signal)) + half_width
        # Full scale may be infinite: 2⁵³ is the largest integer to which floating-point numbers are exact.
        highest = int(np.rint(min(self.sensor.full_scale_dn, 2.0**53)))
        codes = np.clip(np.rint(self.converter_signal(np.array([low, high]))), 0, highest).astype(np.int64)
        ends = np.arange(codes[0], codes[1]) + 0.5
        if self.response or self.digital:
            return int(codes[0]), invert_transfer(self.converter_signal, ends, low, high)
        curvature, ends_above_black = self.sensor.curvature, ends - self.sensor.black_level_dn
        edges = remove_curvature(ends_above_black, curvature)
        # The response has the extremum 1/(4 curvature): no signal exceeds a maximum, every signal exceeds a minimum.
        return int(codes[0]), np.where(ends_above_black * curvature >= 0.25, np.copysign(np.inf, curvature), edges)

    def _at_readings(
        self, reading: ArrayLike, light: ArrayLike, values_of: Callable, outside: tuple[float, float]
    ) -> np.ndarray:
        """Return a function of the code, such as its probability, at readings [DN] and light [DN], which broadcast.

        `values_of` computes the function [mean, code] from `CodeProbabilities`. `outside` are its values for readings
        below the lowest code and above the highest one. Readings that are no whole number are rounded down.
        """
        reading, light = np.broadcast_arrays(np.asarray(reading), np.asarray(light, float))
        mean_e, index = np.unique(self.mean_electrons(light), return_inverse=True)
        index = index.reshape(light.shape)
        result = np.zeros(light.shape)
        for block in _split_into_blocks(mean_e):
            codes = self.probabilities(mean_e[block])
            is_in_block = (index >= block.start) & (index < block.stop)
            values = np.pad(values_of(codes), ((0, 0), (1, 1)), constant_values=((0, 0), outside))
            column = np.clip(np.floor(reading[is_in_block]) - codes.first_code + 1, 0, values.shape[1] - 1)
            result[is_in_block] = values[index[is_in_block] - block.start, column.astype(np.int64)]
        return result[()]


def invert_transfer(transfer: Transfer, targets: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return the signal [target] in DN from which on a transfer reaches each of `targets` [target] in DN.

    Signals are sought from `low` to `high` [DN]. The result is -inf where the transfer reaches the target at `low`
    already, and inf where it does not reach it at `high`.
    """
    below, above = np.full(targets.shape, low), np.full(targets.shape, high)
    is_certain, is_possible = transfer(below) >= targets, transfer(above) >= targets
    for _ in range(BISECTIONS):
        middle = 0.5 * (below + above)
        has_reached = transfer(middle) >= targets
        above, below = np.where(has_reached, middle, above), np.where(has_reached, below, middle)
    return np.select([is_certain, ~is_possible], [-np.inf, np.inf], above)


def _split_into_blocks(mean_e: np.ndarray) -> Iterator[slice]:
    """Yield consecutive slices of increasing means [mean] in e-; the means of a slice are processed together.

    A block has at most `BLOCK` means within `BLOCK_SPAN` standard deviations, and either all are below 0 or none.
    """
    start = 0
    while start < mean_e.size:
        low = mean_e[start]
        limit = low + BLOCK_SPAN * np.sqrt(max(low, 1.0)) if low >= 0 else 0.0
        end = min(start + BLOCK, max(int(np.searchsorted(mean_e, limit)), start + 1))
        yield slice(start, end)
        start = end


def _fill_columns(first: np.ndarray, band: np.ndarray, size: int) -> np.ndarray:
    """Return an array [row, `size`] of 0 into which each row of a band [row, …] is copied from column `first` [row]."""
    columns = np.zeros((first.size, size))
    np.put_along_axis(columns, first[:, None] + np.arange(band.shape[1]), band, axis=1)
    return columns
