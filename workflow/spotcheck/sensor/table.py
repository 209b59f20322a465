"""Mean and variance of a reading as a table over the light, for everything that evaluates many pixels.

The light L is the gain K [DN/e-] times the mean photo-electrons of a pixel: the signal in DN (digital numbers) without
black level. A slope is a derivative by L. Brackets give the shape of an array: [node] has one item per node, and
[moment, node] has the rows mean, variance, slope of the mean, and slope of the variance.

A node is a light at which the moments of a reading are exact. Between nodes each moment is the cubic with the exact
values and slopes at both nodes. Nodes are a sixth of a standard deviation apart. Noise smooths every kink over a whole
standard deviation, so the error of the mean is below 1e-4 standard deviations.

Granular light (speckle) is light that a random factor g of mean 1 multiplies in each pixel; its contrast C is the
standard deviation of g.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from threading import Lock
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.special import gammainc

from spotcheck.sensor.codes import MOST_ELECTRONS, compiled

if TYPE_CHECKING:
    from spotcheck.sensor.distribution import ReadingDistribution

# Distance of nodes [e-^½]: six for each standard deviation of the light.
NODE_STEP = 1 / 12
# Standard deviations beyond the upper end of the converter at which a reading no longer changes.
SATURATED_SD = 10.0
# Largest light of a table, as a multiple of the light at which readings saturate.
MOST_SATURATION = 64.0
# Smallest noise [e-] in the distance of nodes, here and for random readings: the Poisson distribution changes on the
# scale of one electron.
LEAST_NOISE_E = 0.25
# Smallest exponent of the variance under negative light (`ReadingTable`), which therefore stays above e^-3 of the
# variance without light.
LOWEST_EXPONENT = -3.0
# Step for second derivatives by the light with smear, in standard deviations, and the least part of the variance that
# remains after the shot noise of the smear is subtracted.
SMEAR_STEP, LEAST_SHARE = 0.25, 0.2
# Step in ln g of the average over the factors g of granular light, as a multiple of the contrast.
GRAIN_STEP = 0.05
# Upper limit of that step.
LARGEST_GRAIN_STEP = 0.01
# Lower limit of that step: tables with finer ones grow long. The rule is accurate up to steps of one standard
# deviation.
FINEST_GRAIN_STEP = 0.002
# Probability of the smallest factors g, which are left out of the average.
LEFT_OUT = 1e-9
# Number of Gauss–Hermite points of the average over g for a contrast below `FINEST_GRAIN_STEP`.
LOW_CONTRAST_POINTS = 5
# Light [DN] from which on averages over g are computed as convolutions over ln L, which would be long for less light.
LEAST_CONVOLVED_LIGHT = 0.05
# Signals that are searched for saturation: first and last as multiples of full scale, and their number.
SATURATION_GRID = (1e-2, 64.0, 400)


class ReadingMoments(NamedTuple):
    """Mean and variance of readings and their slopes by the light, each in the shape of the light."""

    mean: np.ndarray  # mean [DN]
    variance: np.ndarray  # variance [DN²]
    mean_slope: np.ndarray  # d mean/dL [1]
    variance_slope: np.ndarray  # d variance/dL [DN]


# Threads that need the same table wait for it instead of making it twice.
_LOCK = Lock()


@dataclass(frozen=True, eq=False)
class ReadingTable:
    """Mean and variance of a reading over the light L [DN], interpolated.

    Nodes are `NODE_STEP` apart in u = √(L/K + µ_d + s²), with the dark electrons µ_d and a noise s, both in e-. For
    negative light the mean continues as a straight line and the variance as an exponential: both stay smooth, so that
    fits converge there. Beyond the last node both stay constant.
    """

    gain: float  # K [DN/e-]
    first_root: float  # u of the first node [e-^½], that of no light: √(µ_d + s²)
    nodes: np.ndarray  # mean [DN], variance [DN²], d mean/dL [1] and d variance/dL [DN] at the nodes [moment, node]

    @cached_property
    def light(self) -> np.ndarray:
        """Light at the nodes [node] in DN."""
        root = self.first_root + NODE_STEP * np.arange(self.nodes.shape[1])
        return self.gain * (root**2 - self.first_root**2)

    def mean(self, light: np.ndarray) -> np.ndarray:
        """Return the mean reading [DN] at light [DN], in its shape."""
        return self.moments(light).mean

    def variance(self, light: np.ndarray) -> np.ndarray:
        """Return the variance [DN²] of readings at light [DN], in its shape."""
        return self.moments(light).variance

    def moments(self, light: np.ndarray, smear_e: np.ndarray | float = 0.0) -> ReadingMoments:
        """Return mean and variance of readings and their slopes at light [DN], in its shape; NaN for NaN light.

        `smear_e` are electrons [e-] that are added without shot noise, which broadcast with the light. Mean and
        variance are corrected for this to first order in the smear; slopes are not corrected. The correction starts
        from a reading whose smear has shot noise: the charge then has a larger variance by that of the smear. Such an
        excess adds half of it, times the second derivative by the light, to each moment of a reading.
        """
        if np.ndim(smear_e) == 0 and smear_e == 0.0:
            light = np.asarray(light, float)
            moments = np.empty((4, light.size))
            interpolate(light.reshape(-1), self.gain, self.first_root, self.nodes, moments)
            return ReadingMoments(*moments.reshape(4, *light.shape))
        light = light + self.gain * smear_e
        step = SMEAR_STEP * self.gain * np.sqrt(np.maximum(light / self.gain, 0.0) + self.first_root**2)
        shot, low, high = (self.moments(light + shift) for shift in (0.0, -step, step))
        # Variance [DN²] of the shot noise of the smear.
        excess = self.gain * (self.gain * smear_e)
        mean_curvature = (high.mean_slope - low.mean_slope) / (2 * step)
        variance_curvature = (high.variance_slope - low.variance_slope) / (2 * step)
        # The second moment of a reading has the second derivative of variance + mean², hence the squared slope.
        variance = shot.variance - excess * (shot.mean_slope**2 + variance_curvature / 2)
        mean, variance = shot.mean - excess * mean_curvature / 2, np.maximum(variance, LEAST_SHARE * shot.variance)
        return ReadingMoments(mean, variance, shot.mean_slope, shot.variance_slope)

    def with_random_factor(
        self, factor: np.ndarray, weight: np.ndarray, pedestal_dn: float = 0.0, light_max: float = np.inf
    ) -> ReadingTable:
        """Return the table of readings whose light L is multiplied by a random factor; it is over L.

        The factor changes the mean of readings that clip, and not only their variance. This table is constant
        beyond its last node. It must therefore reach the brightest light, the largest factor times L plus
        `pedestal_dn`, or saturation.

        Parameters
        ----------
        factor, weight : values of the factor [value], increasing, and their probabilities [value], which sum to 1.
        pedestal_dn : light beside it that the factor does not multiply [DN].
        light_max : the new table goes up to this light [DN], or to the end of this table.
        """
        mixed = np.empty_like(self.nodes[:, : int(np.searchsorted(self.light, light_max)) + 2])
        light = self.light[: mixed.shape[1]]
        log_steps = np.diff(np.log(factor))
        is_faint = np.ones(light.size, bool)
        # Factors that are uniform in their logarithm allow a convolution.
        if factor.size > 1 and np.ptp(log_steps) < 1e-9:
            is_faint = light < LEAST_CONVOLVED_LIGHT
            mixed[:, ~is_faint] = self._convolve(factor, weight, float(log_steps[0]), pedestal_dn, light[~is_faint])
        for k in np.flatnonzero(is_faint):
            mixed[:, k] = _mix(self.moments(factor * light[k] + pedestal_dn), factor, weight)
        return replace(self, nodes=mixed)

    def _convolve(
        self, factor: np.ndarray, weight: np.ndarray, step: float, pedestal_dn: float, light: np.ndarray
    ) -> np.ndarray:
        """Return the moments of `with_random_factor` [moment, light] at light [light] in DN.

        The factors g (`factor` [value], with probabilities `weight` [value]) are uniform in ln g, `step` apart. A
        reading depends on the product of factor and light, so that averages are convolutions over ln L.
        """
        # Light at which averages are taken, uniform in ln L, and the products g L that occur there.
        ln_light = np.arange(np.log(LEAST_CONVOLVED_LIGHT) - step, np.log(light[-1]) + 2 * step, step)
        product = np.exp(ln_light[0] + np.log(factor[0]) + step * np.arange(ln_light.size + factor.size - 1))
        moments = self.moments(product + pedestal_dn)
        # First and second moment about 0, and their derivatives by ln L.
        powers = (moments.mean, moments.variance + moments.mean**2, product * moments.mean_slope,
                  product * (moments.variance_slope + 2 * moments.mean * moments.mean_slope))  # fmt: skip
        mean, square, mean_slope, square_slope = (np.correlate(values, weight, "valid") for values in powers)
        variance, variance_slope = square - mean**2, square_slope - 2 * mean * mean_slope
        # Interpolated from the uniform values of ln L to those of `light`.
        wanted = np.log(light)
        return np.stack([
            CubicHermiteSpline(ln_light, mean, mean_slope)(wanted),
            CubicHermiteSpline(ln_light, variance, variance_slope)(wanted),
            np.interp(wanted, ln_light, mean_slope) / light,
            np.interp(wanted, ln_light, variance_slope) / light,
        ])  # fmt: skip


def _mix(moments: ReadingMoments, factor: np.ndarray, weight: np.ndarray) -> tuple[float, float, float, float]:
    """Return mean, variance and their slopes for light with a random factor, from the moments at each factor [value].

    `weight` [value] are the probabilities of the factors. Slopes are by the light that the factor multiplies.
    """
    mean, slope = weight @ moments.mean, weight @ (factor * moments.mean_slope)
    deviation, slope_deviation = moments.mean - mean, factor * moments.mean_slope - slope
    variance = weight @ (moments.variance + deviation**2)
    variance_slope = weight @ (factor * moments.variance_slope + 2 * deviation * slope_deviation)
    return mean, variance, slope, variance_slope


def grain_quadrature(*, contrast: float) -> tuple[np.ndarray, np.ndarray]:
    """Return factors g of granular light and their weights, both [value]: a gamma distribution of mean 1, variance C².

    Sums of independent speckle patterns have this distribution (Goodman, Speckle Phenomena in Optics, 2nd ed., Section
    3.3). `contrast` is C [1]. Weights sum to 1. Values are uniform in ln g, where the trapezoidal rule of a smooth
    density converges faster than any power of the step.
    """
    if contrast < FINEST_GRAIN_STEP:
        return _low_contrast_quadrature(contrast)
    shape = contrast**-2
    # For small g the density of ln g falls as g^shape; for large g as exp(−shape (g − 1 − ln g)).
    ln_g = _space_log_factors(contrast, np.log(LEFT_OUT) / shape - 6 * contrast)
    weight = np.exp(shape * (ln_g - np.expm1(ln_g)))
    return np.exp(ln_g), weight / weight.sum()


def partial_grain_quadrature(*, contrast: float, floor: float) -> tuple[np.ndarray, np.ndarray]:
    """As `grain_quadrature`, for light of which a share `floor` is the same in every pixel.

    g is floor + (1 − floor) times a gamma distributed number; it has mean 1 and variance C². `floor` [1] is from 0 to
    below 1; it is ignored for a contrast below `FINEST_GRAIN_STEP`. The weight of a value is the probability of the
    interval around it, not the density there, which ends abruptly at the floor.
    """
    if contrast < FINEST_GRAIN_STEP or floor == 0:
        return grain_quadrature(contrast=contrast)
    shape = ((1 - floor) / contrast) ** 2
    ln_g = _space_log_factors(contrast, np.log(floor))
    step = ln_g[1] - ln_g[0]
    edges = np.exp(np.append(ln_g, ln_g[-1] + step) - step / 2)
    weight = np.diff(gammainc(shape, shape * np.maximum(edges - floor, 0.0) / (1 - floor)))
    return np.exp(ln_g), weight / weight.sum()


def _low_contrast_quadrature(contrast: float) -> tuple[np.ndarray, np.ndarray]:
    """Return factors g [value] and weights [value] of a normal distribution of mean 1 and deviation `contrast`.

    A gamma distribution of so low a contrast is nearly normal. A contrast of 0 gives the single factor 1.
    """
    if contrast == 0:
        return np.ones(1), np.ones(1)
    deviations, weights = np.polynomial.hermite_e.hermegauss(LOW_CONTRAST_POINTS)
    return 1 + contrast * deviations, weights / weights.sum()


def _space_log_factors(contrast: float, lowest: float) -> np.ndarray:
    """Return uniform values of ln g [value] from about `lowest` to ln(1 + 8 C + 25 C²), C the contrast.

    Larger factors have a negligible probability.
    """
    step = float(np.clip(GRAIN_STEP * contrast, FINEST_GRAIN_STEP, LARGEST_GRAIN_STEP))
    highest = np.log1p(8 * contrast + 25 * contrast**2)
    return step * np.arange(np.floor(lowest / step), np.ceil(highest / step) + 1)


def tabulate_readings(distribution: ReadingDistribution, light_max: float) -> ReadingTable:
    """Return the table of a reading from no light to `light_max` [DN], cached; threads wait for each other.

    It ends earlier, at `MOST_SATURATION` times the light at which readings saturate, if that is less.
    """
    with _LOCK:
        return _tabulate(distribution, light_max)


@lru_cache(maxsize=32)
def _tabulate(distribution: ReadingDistribution, light_max: float) -> ReadingTable:
    """Return the table for `tabulate_readings`, which holds the lock."""
    gain, dark_e = distribution.sensor.gain_dn_per_e, float(distribution.mean_electrons(0.0))
    last_changing_e = min(light_max / gain + dark_e, saturating_electrons(distribution))
    first_root, nodes = _tabulate_unsaturated(distribution, last_changing_e)
    # Saturated light has nodes too: with a random factor it includes darker light that is not saturated
    # (`with_random_factor`), so that the mixed table still changes there.
    last_e = max(min(light_max / gain + dark_e, MOST_SATURATION * last_changing_e), last_changing_e)
    last_root = first_root + NODE_STEP * (nodes.shape[1] - 1)
    saturated_count = max(math.ceil((np.sqrt(last_e - dark_e + first_root**2) - last_root) / NODE_STEP), 0)
    # Moments stay those of the last node, with slopes of 0.
    saturated_node = nodes[:, -1:] * [[1.0], [1.0], [0.0], [0.0]]
    nodes = np.concatenate([nodes, np.repeat(saturated_node, saturated_count, axis=1)], axis=1)
    return ReadingTable(gain, first_root, nodes)


@lru_cache(maxsize=32)
def _tabulate_unsaturated(distribution: ReadingDistribution, highest_e: float) -> tuple[float, np.ndarray]:
    """Return u of the first node [e-^½] and the nodes [moment, node], as in `ReadingTable`.

    The nodes go up to the mean electrons `highest_e`, dark electrons included.
    """
    sensor, dark_e = distribution.sensor, float(distribution.mean_electrons(0.0))
    # The noise s of `ReadingTable` sets the distance of nodes. It is at most the shot noise: a clip of the charge comes
    # before the read noise, and bends the mean over the width of the shot noise only.
    noise_e = max(min(sensor.read_noise_e, np.sqrt(max(min(highest_e, sensor.full_well_e), 1.0))), LEAST_NOISE_E)
    first_root, last_root = np.sqrt(dark_e + noise_e**2), np.sqrt(max(highest_e, dark_e + 1.0) + noise_e**2)
    root = first_root + NODE_STEP * np.arange(np.ceil((last_root - first_root) / NODE_STEP) + 1)
    # Squares of arrays and of numbers round differently, so that the first light could be below 0.
    light = sensor.gain_dn_per_e * np.maximum(root**2 - first_root**2, 0.0)
    return first_root, np.stack(distribution.moments(light))


@lru_cache(maxsize=32)
def saturating_electrons(distribution: ReadingDistribution) -> float:
    """Return the mean electrons [e-] from which on readings no longer change; infinite if there are none."""
    sensor = distribution.sensor
    # Number of electrons at which a reading without shot noise is saturated.
    end = sensor.full_well_e
    if np.isfinite(sensor.full_scale_dn):
        electrons = np.geomspace(*SATURATION_GRID) * (sensor.full_scale_dn + 1.0) / sensor.gain_dn_per_e
        charge = distribution.charge_signal(np.append(electrons, MOST_ELECTRONS))
        if distribution.charge_levels:
            charge = np.minimum(charge, max(level for _, level in distribution.charge_levels))
        noise = SATURATED_SD * distribution.noise_dn
        # Full scale, a stage behind the read noise or a clip of the charge sets the highest reading.
        highest = min(sensor.full_scale_dn, float(distribution.converter_signal(charge[-1:] + noise)[0]))
        is_saturated = (distribution.converter_signal(charge - noise) >= highest) | (charge >= charge[-1])
        end = np.min(electrons[is_saturated[:-1]], initial=end)
    # Shot noise is added.
    return end + SATURATED_SD * math.sqrt(end) + SATURATED_SD**2 if np.isfinite(end) else np.inf


@compiled
def interpolate(light, gain, first_root, nodes, moments):
    """Fill `moments` [4, pixel] with mean, variance and their slopes at light [pixel] in DN; NaN for NaN light.

    `gain`, `first_root` and `nodes` are those of a `ReadingTable`.
    """
    last = nodes.shape[1] - 1
    offset = first_root * first_root
    for k in range(light.size):
        pixel_light = light[k]
        if pixel_light != pixel_light:  # NaN
            moments[:, k] = pixel_light
            continue
        if pixel_light < 0.0:
            rate = nodes[3, 0] / nodes[1, 0] if nodes[1, 0] > 0.0 else 0.0
            moments[0, k], moments[2, k] = nodes[0, 0] + pixel_light * nodes[2, 0], nodes[2, 0]
            moments[1, k] = nodes[1, 0] * math.exp(max(rate * pixel_light, LOWEST_EXPONENT))
            moments[3, k] = rate * moments[1, k] if rate * pixel_light > LOWEST_EXPONENT else 0.0
            continue
        position = (math.sqrt(pixel_light / gain + offset) - first_root) / NODE_STEP
        if position >= last:
            moments[0, k], moments[1, k], moments[2, k], moments[3, k] = nodes[0, last], nodes[1, last], 0.0, 0.0
            continue
        # Node below the light, the light of that node and its distance from the next one, and the fraction between.
        node = int(position)
        low_root, high_root = first_root + node * NODE_STEP, first_root + (node + 1) * NODE_STEP
        start, width = gain * (low_root * low_root - offset), gain * (high_root * high_root - low_root * low_root)
        f = (pixel_light - start) / width
        # Cubic through values and slopes of mean (0) and variance (1); slopes are per distance of the nodes.
        for moment in range(2):
            value, next_value = nodes[moment, node], nodes[moment, node + 1]
            slope, next_slope = nodes[moment + 2, node] * width, nodes[moment + 2, node + 1] * width
            rise = next_value - value
            square, cube = 3 * rise - 2 * slope - next_slope, slope + next_slope - 2 * rise
            moments[moment, k] = value + f * (slope + f * (square + f * cube))
            moments[moment + 2, k] = (slope + f * (2 * square + 3 * f * cube)) / width
