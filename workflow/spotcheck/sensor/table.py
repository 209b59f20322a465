"""Mean, variance and information of a reading as a table over the light, for everything that evaluates many pixels.

Between nodes each quantity is the cubic with the exact values and slopes at both nodes. Nodes lie a sixth of a standard
deviation apart, which is the scale on which noise smooths every kink: the error of the mean is below 1e-4 standard
deviations.
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
# Light of the last node at most, in terms of the light that saturates.
MOST_SATURATION = 64.0
# Smallest noise [e-] in the distance of nodes, here and for random readings: the Poisson distribution changes on the
# scale of one electron.
LEAST_NOISE_E = 0.25
# Smallest exponent of the variance below no light; see `ReadingTable`.
LOWEST_EXPONENT = -3.0
# Step of the second derivative in smeared light, in standard deviations, and the least share of the variance that is
# left where the shot noise of smear is taken off.
SMEAR_STEP, LEAST_SHARE = 0.25, 0.2
# Step in ln g of the average over grains, in units of the contrast.
GRAIN_STEP = 0.05
# Upper limit of that step.
LARGEST_GRAIN_STEP = 0.01
# Probability of darker grains, which are left out.
LEFT_OUT = 1e-9
# Finest step in ln g: the tables of finer ones grow long. The rule is exact for steps of one standard deviation.
FINEST_GRAIN_STEP = 0.002
# Light [DN] from which on averages over grains are convolutions.
FAINT_LIGHT = 0.05


class ReadingMoments(NamedTuple):
    """Mean and variance of readings and their slopes by the light, each in the shape of the light."""

    mean: np.ndarray  # [DN]
    variance: np.ndarray  # [DN²]
    mean_slope: np.ndarray  # d mean/dL [1]
    variance_slope: np.ndarray  # d variance/dL [DN]


# Threads that need the same table wait for it instead of making it twice.
_LOCK = Lock()


@dataclass(frozen=True, eq=False)
class ReadingTable:
    """Mean and variance of a reading over the light L [DN], interpolated.

    Nodes are uniform in u = √(L/K + µ_d + s²), with the dark electrons µ_d and a noise s. Below no light the mean
    continues as a straight line and the variance as an exponential: both stay smooth, so that fits converge there.
    Beyond the last node both stay constant.
    """

    gain: float  # K [DN/e-]
    first_root: float  # u of the first node [e-^½], that of no light: √(µ_d + s²)
    step: float  # distance of the nodes in u [e-^½]
    nodes: np.ndarray  # mean [DN], variance [DN²], d mean/dL [1], d variance/dL [DN]; [quantity, node]
    distribution: ReadingDistribution | None = None  # of the readings; None if the light has a random factor

    @cached_property
    def light(self) -> np.ndarray:
        """Light at the nodes [DN]."""
        root = self.first_root + self.step * np.arange(self.nodes.shape[1])
        return self.gain * (root**2 - self.first_root**2)

    def mean(self, light: np.ndarray) -> np.ndarray:
        """Return the mean reading [DN] at light [DN]."""
        return self.moments(light).mean

    def variance(self, light: np.ndarray) -> np.ndarray:
        """Return the variance [DN²] of readings at light [DN]."""
        return self.moments(light).variance

    def moments(self, light: np.ndarray, smear_e: np.ndarray | float = 0.0) -> ReadingMoments:
        """Return mean and variance of readings and their slopes at light [DN], an array of any shape.

        `smear_e` are electrons [e-] that are added without shot noise. Mean and variance are corrected to first order
        in them, slopes are not: a charge of the same mean has the variance s more with shot noise, which adds s/2 times
        the second derivative to each moment of a reading.
        """
        if np.ndim(smear_e) == 0 and smear_e == 0.0:
            light = np.asarray(light, float)
            out = np.empty((4, light.size))
            interpolate(light.reshape(-1), self.gain, self.first_root, self.step, self.nodes, out)
            return ReadingMoments(*out.reshape(4, *light.shape))
        light = light + self.gain * smear_e
        step = SMEAR_STEP * self.gain * np.sqrt(np.maximum(light / self.gain, 0.0) + self.first_root**2)
        at, low, high = (self.moments(light + shift) for shift in (0.0, -step, step))
        excess = self.gain * (self.gain * smear_e)
        mean_curvature = (high.mean_slope - low.mean_slope) / (2 * step)
        variance_curvature = (high.variance_slope - low.variance_slope) / (2 * step)
        variance = at.variance - excess * (at.mean_slope**2 + variance_curvature / 2)
        mean, variance = at.mean - excess * mean_curvature / 2, np.maximum(variance, LEAST_SHARE * at.variance)
        return ReadingMoments(mean, variance, at.mean_slope, at.variance_slope)

    def information(self, light: np.ndarray) -> np.ndarray:
        """Return the Fisher information [1/DN²] of a reading on the light, at light [DN].

        Its reciprocal is interpolated: without clips it is a straight line in the light. The error is below 2 % for
        more than half an electron.
        """
        return 1 / np.interp(light, self.light, 1 / np.maximum(self._node_information, 1e-300))

    @cached_property
    def _node_information(self) -> np.ndarray:
        """Fisher information on the light at the nodes [1/DN²]; 0 from where readings no longer change."""
        _, variance, slope, variance_slope = self.nodes
        if self.distribution is None:
            return slope**2 / np.maximum(variance, 1e-12)
        changes = (slope != 0) | (variance_slope != 0)
        information = np.zeros(slope.size)
        information[changes] = self.distribution.fisher_information(self.light[changes])
        return information

    def with_granular_light(self, contrast: float, pedestal_dn: float = 0.0) -> ReadingTable:
        """Return the table of readings under light that a granular field multiplies.

        The light of a pixel is g L + `pedestal_dn`, where g follows a gamma distribution of mean 1 and variance C², as
        sums of independent speckle patterns do. The argument of the new table is L, the light on average. Behind a
        clip, grains change the mean as well. This table must hold the light of the brightest grains, g L with g up to
        1 + 8 C + 25 C² (`grain_quadrature`), or end in saturation: it is constant beyond its last node.

        Parameters
        ----------
        contrast : float
            Speckle contrast C in a pixel [1], above 0.
        pedestal_dn : float
            Light beside the granular light [DN].

        References
        ----------
        Goodman, Speckle Phenomena in Optics, 2nd ed., Section 3.3.
        """
        return self.with_random_factor(*grain_quadrature(contrast=contrast), pedestal_dn)

    def with_random_factor(
        self, factor: np.ndarray, weight: np.ndarray, pedestal_dn: float = 0.0, light_max: float = np.inf
    ) -> ReadingTable:
        """Return the table of readings whose light is multiplied by a random factor, given at nodes with weights.

        It goes up to `light_max` [DN] or to the end of this table. Its information is a lower bound, that of a fit to
        the mean alone.
        """
        mixed = np.empty_like(self.nodes[:, : int(np.searchsorted(self.light, light_max)) + 2])
        light = self.light[: mixed.shape[1]]
        steps = np.diff(np.log(factor))
        if factor.size > 1 and np.ptp(steps) < 1e-9:
            faint = light < FAINT_LIGHT
            mixed[:, ~faint] = self._convolve(factor, weight, float(steps[0]), pedestal_dn, light[~faint])
        else:
            faint = np.ones(light.size, bool)
        for k in np.flatnonzero(faint):
            mixed[:, k] = _mix(self.moments(factor * light[k] + pedestal_dn), factor, weight)
        return replace(self, nodes=mixed, distribution=None)

    def _convolve(
        self, factor: np.ndarray, weight: np.ndarray, step: float, pedestal_dn: float, light: np.ndarray
    ) -> np.ndarray:
        """Return the moments of `with_random_factor` at light [4, light] for factors `step` apart in ln g.

        A reading depends on the product of factor and light, so that averages are convolutions over ln L.
        """
        ln_light = np.arange(np.log(FAINT_LIGHT) - step, np.log(light[-1]) + 2 * step, step)
        product = np.exp(ln_light[0] + np.log(factor[0]) + step * np.arange(ln_light.size + factor.size - 1))
        at = self.moments(product + pedestal_dn)
        powers = (at.mean, at.variance + at.mean**2, product * at.mean_slope,
                  product * (at.variance_slope + 2 * at.mean * at.mean_slope))  # fmt: skip
        mean, square, mean_slope, square_slope = (np.correlate(values, weight, "valid") for values in powers)
        variance, variance_slope = square - mean**2, square_slope - 2 * mean * mean_slope
        x = np.log(light)
        return np.stack([
            CubicHermiteSpline(ln_light, mean, mean_slope)(x),
            CubicHermiteSpline(ln_light, variance, variance_slope)(x),
            np.interp(x, ln_light, mean_slope) / light,
            np.interp(x, ln_light, variance_slope) / light,
        ])  # fmt: skip


def _mix(at: ReadingMoments, factor: np.ndarray, weight: np.ndarray) -> tuple[float, float, float, float]:
    """Return the moments of readings whose light is multiplied by a factor, from those at each factor."""
    mean, slope = weight @ at.mean, weight @ (factor * at.mean_slope)
    deviation, slope_deviation = at.mean - mean, factor * at.mean_slope - slope
    variance = weight @ (at.variance + deviation**2)
    variance_slope = weight @ (factor * at.variance_slope + 2 * deviation * slope_deviation)
    return mean, variance, slope, variance_slope


def grain_quadrature(*, contrast: float) -> tuple[np.ndarray, np.ndarray]:
    """Return factors g of granular light and their weights [node], a gamma distribution of mean 1 and variance C².

    Nodes are uniform in ln g, where the trapezoidal rule of a smooth density converges faster than any power of the
    step.
    """
    if contrast < FINEST_GRAIN_STEP:
        return _faint_grains(contrast)
    shape = contrast**-2
    # For small g the density of ln g falls as g^shape; for large g as exp(−shape (g − 1 − ln g)).
    ln_g = _grain_nodes(contrast, np.log(LEFT_OUT) / shape - 6 * contrast)
    weight = np.exp(shape * (ln_g - np.expm1(ln_g)))
    return np.exp(ln_g), weight / weight.sum()


def partial_grain_quadrature(*, contrast: float, floor: float) -> tuple[np.ndarray, np.ndarray]:
    """Return factors g of granular light and their weights [node] if a part of the light, the floor, is in every pixel.

    The rest follows a gamma distribution; g has mean 1 and variance C². Nodes have the probability of their cells,
    since the density ends at the floor.
    """
    if contrast < FINEST_GRAIN_STEP or floor == 0:
        return grain_quadrature(contrast=contrast)
    shape = ((1 - floor) / contrast) ** 2
    ln_g = _grain_nodes(contrast, np.log(floor))
    step = ln_g[1] - ln_g[0]
    edges = np.exp(np.append(ln_g, ln_g[-1] + step) - step / 2)
    weight = np.diff(gammainc(shape, shape * np.maximum(edges - floor, 0.0) / (1 - floor)))
    return np.exp(ln_g), weight / weight.sum()


def _faint_grains(contrast: float) -> tuple[np.ndarray, np.ndarray]:
    """Return factors of mean 1 and a contrast that hardly shows, and their weights: normal ones."""
    if contrast == 0:
        return np.ones(1), np.ones(1)
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)
    return 1 + contrast * nodes, weights / weights.sum()


def _grain_nodes(contrast: float, lowest: float) -> np.ndarray:
    """Return nodes of ln g from its lowest value on."""
    step = float(np.clip(GRAIN_STEP * contrast, FINEST_GRAIN_STEP, LARGEST_GRAIN_STEP))
    highest = np.log1p(8 * contrast + 25 * contrast**2)
    return step * np.arange(np.floor(lowest / step), np.ceil(highest / step) + 1)


def tabulate_readings(distribution: ReadingDistribution, light_max: float) -> ReadingTable:
    """Return the table of a reading from no light to `light_max` [DN], or to where readings are saturated."""
    with _LOCK:
        return _tabulate(distribution, light_max)


@lru_cache(maxsize=32)
def _tabulate(distribution: ReadingDistribution, light_max: float) -> ReadingTable:
    sensor = distribution.sensor
    gain, dark_e = sensor.gain_dn_per_e, float(distribution.mean_electrons(0.0))
    highest_e = min(light_max / gain + dark_e, saturating_electrons(distribution))
    first_root, nodes = _changing_nodes(distribution, highest_e)
    # Saturated nodes up to the light that was asked for: dark grains of such light are not saturated.
    farthest_e = max(min(light_max / gain + dark_e, MOST_SATURATION * highest_e), highest_e)
    last_root = first_root + NODE_STEP * (nodes.shape[1] - 1)
    saturated = max(math.ceil((np.sqrt(farthest_e - dark_e + first_root**2) - last_root) / NODE_STEP), 0)
    nodes = np.concatenate([nodes, np.repeat(nodes[:, -1:] * [[1.0], [1.0], [0.0], [0.0]], saturated, axis=1)], axis=1)
    return ReadingTable(gain, first_root, NODE_STEP, nodes, distribution)


@lru_cache(maxsize=32)
def _changing_nodes(distribution: ReadingDistribution, highest_e: float) -> tuple[float, np.ndarray]:
    """Return u of the first node, and the nodes up to a number of electrons."""
    sensor, dark_e = distribution.sensor, float(distribution.mean_electrons(0.0))
    # A clip of the charge bends the mean within the shot noise, however strong the read noise behind it.
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
    end = sensor.full_well_e
    if np.isfinite(sensor.full_scale_dn):
        electrons = np.geomspace(1e-2, 64.0, 400) * (sensor.full_scale_dn + 1.0) / sensor.gain_dn_per_e
        charge = distribution.charge_signal(np.append(electrons, MOST_ELECTRONS))
        if distribution.charge_levels:
            charge = np.minimum(charge, max(level for _, level in distribution.charge_levels))
        noise = SATURATED_SD * distribution.noise_dn
        # Full scale, a stage behind the read noise or a clip of the charge sets the highest reading.
        highest = min(sensor.full_scale_dn, float(distribution.converter_signal(charge[-1:] + noise)[0]))
        is_over = (distribution.converter_signal(charge - noise) >= highest) | (charge >= charge[-1])
        end = np.min(electrons[is_over[:-1]], initial=end)
    return end + SATURATED_SD * math.sqrt(end) + SATURATED_SD**2 if np.isfinite(end) else np.inf


@compiled
def interpolate(light, gain, first_root, step, nodes, out):
    """Fill mean, variance and their slopes [4, pixel] at light [pixel, DN]; the grid is that of `ReadingTable`."""
    last = nodes.shape[1] - 1
    offset = first_root * first_root
    for k in range(light.size):
        at = light[k]
        if at != at:
            out[:, k] = at
            continue
        if at < 0.0:
            rate = nodes[3, 0] / nodes[1, 0] if nodes[1, 0] > 0.0 else 0.0
            out[0, k], out[2, k] = nodes[0, 0] + at * nodes[2, 0], nodes[2, 0]
            out[1, k] = nodes[1, 0] * math.exp(max(rate * at, LOWEST_EXPONENT))
            out[3, k] = rate * out[1, k] if rate * at > LOWEST_EXPONENT else 0.0
            continue
        position = (math.sqrt(at / gain + offset) - first_root) / step
        if position >= last:
            out[0, k], out[1, k], out[2, k], out[3, k] = nodes[0, last], nodes[1, last], 0.0, 0.0
            continue
        node = int(position)
        low, high = first_root + node * step, first_root + (node + 1) * step
        start, width = gain * (low * low - offset), gain * (high * high - low * low)
        f = (at - start) / width
        for quantity in range(2):
            value, following = nodes[quantity, node], nodes[quantity, node + 1]
            slope, slope_after = nodes[quantity + 2, node] * width, nodes[quantity + 2, node + 1] * width
            rise = following - value
            square, cube = 3 * rise - 2 * slope - slope_after, slope + slope_after - 2 * rise
            out[quantity, k] = value + f * (slope + f * (square + f * cube))
            out[quantity + 2, k] = (slope + f * (2 * square + 3 * f * cube)) / width
