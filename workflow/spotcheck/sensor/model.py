"""The linear camera model of EMVA 1288 with a curved response: its parameters, and how readings are linearized.

A reading is a whole number of DN (digital numbers). The light of a pixel is the gain K [DN/e-] times its mean number of
photo-electrons: the mean signal [DN] without black level and dark current. Equations are those of the paper unless
EMVA 1288 is named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from spotcheck.sensor.distribution import ReadingDistribution
from spotcheck.sensor.response import remove_curvature
from spotcheck.sensor.table import ReadingMoments

# Variance [DN²] of the error of rounding to whole DN, where noise spreads readings over several DN (EMVA 1288).
ROUNDING_VARIANCE = 1 / 12


@dataclass(frozen=True)
class SensorModel:
    """A camera after EMVA 1288: mean and variance of a reading, and random readings.

    The input is the mean number of photons that fall on a pixel during the exposure. Photons become electrons with the
    quantum efficiency, and dark current adds electrons; both are Poisson distributed. Then follow full well, read
    noise, gain, response curvature, black level, one rounding to whole DN, and the converter's ends at 0 and at full
    scale. `spotcheck.sensor.ReadingDistribution` is the whole distribution.

    Parameters
    ----------
    gain_dn_per_e : float
        Overall gain K [DN/e-].
    read_noise_e : float
        Standard deviation of the noise in the dark [e-].
    dark_current_e_per_s : float
        Dark current µ_I [e-/s].
    full_well_e : float
        Number of electrons at which a pixel is full.
    black_level_dn : float
        Reading without light and without electrons [DN].
    full_scale_dn : float
        Largest reading [DN], 1023 for 10 bit.
    quantum_efficiency : float
        Electrons per photon; with the default 1, photons are electrons.
    response_bend : float
        Curvature of the response times full scale [1]: a signal y above black is read as y − q y²/full scale.

    Examples
    --------
    >>> import spotcheck
    >>> sensor = spotcheck.SensorModel(0.11, 13.0, black_level_dn=40, full_scale_dn=1023, quantum_efficiency=0.38)
    >>> print(f"{sensor.mean(10_000):.2f} DN, {sensor.variance(10_000):.2f} DN²")
    458.00 DN, 48.11 DN²
    >>> sensor.draw([[0, 10_000], [100_000, 0]], rng=1).dtype
    dtype('uint16')
    """

    gain_dn_per_e: float
    read_noise_e: float
    dark_current_e_per_s: float = 0.0
    full_well_e: float = np.inf
    black_level_dn: float = 0.0
    full_scale_dn: float = np.inf
    quantum_efficiency: float = 1.0
    response_bend: float = 0.0

    @property
    def curvature(self) -> float:
        """Curvature of the response [1/DN]: a signal y [DN] above black is read as y − curvature · y²."""
        return self.response_bend / self.full_scale_dn

    def without_curvature(self) -> SensorModel:
        """Return the sensor to which readings belong after `linearize`: the same, with a linear response."""
        if not self.curvature:
            return self
        return replace(self, response_bend=0.0, full_scale_dn=float(self.linearize(self.full_scale_dn)))

    def linearize(self, readings: ArrayLike) -> np.ndarray:
        """Return readings [DN] of any shape with the curvature of the response removed; NaN stays NaN.

        The noise is transformed with the signal, so that the result follows the distribution of a linear sensor. Only
        the rounding differs: it happens behind the response and is treated as if it happened before.
        """
        if not self.curvature:
            return np.asarray(readings)
        signal = np.asarray(readings, dtype=float) - self.black_level_dn
        return self.black_level_dn + remove_curvature(signal, self.curvature)

    def mean(self, photons: ArrayLike, *, exposure_s: float = 0.0) -> np.ndarray:
        """Return the mean reading [DN] of each pixel, in the shape of `photons`.

        Parameters
        ----------
        photons : array of any shape
            Mean number of photons on each pixel during the exposure.
        exposure_s : float
            Exposure [s]; it counts for the dark current alone.

        Raises
        ------
        ValueError
            If a number of photons is below 0, or if no sensor has this gain or read noise.
        """
        return self._moments(photons, exposure_s).mean[()]

    def variance(self, photons: ArrayLike, *, exposure_s: float = 0.0) -> np.ndarray:
        """Return the variance [DN²] of the reading of each pixel in the shape of `photons`; arguments as for `mean`."""
        return self._moments(photons, exposure_s).variance[()]

    def draw(self, photons: ArrayLike, rng: np.random.Generator | int, *, exposure_s: float = 0.0) -> np.ndarray:
        """Return a random reading [DN, uint16] of each pixel, in the shape of `photons`; arguments as for `mean`.

        `rng` is a generator or a seed; equal seeds give equal readings.
        """
        return ReadingDistribution(self, exposure_s).sample(self.light_of_photons(photons), np.random.default_rng(rng))

    def light_of_photons(self, photons: ArrayLike) -> np.ndarray:
        """Return the light K η µ_p [DN] of a mean number of photons µ_p, in its shape; raises ValueError as `mean`.

        K is the gain [DN/e-] and η the quantum efficiency.
        """
        check_sensor(self)
        photons = np.asarray(photons, dtype=float)
        if not np.all(photons >= 0):
            raise ValueError("photons: holds a number that is not 0 or above; give the mean number on each pixel")
        return self.gain_dn_per_e * photo_electrons(photons, self.quantum_efficiency)

    def _moments(self, photons: ArrayLike, exposure_s: float) -> ReadingMoments:
        """Return the moments of readings in the shape of `photons`; arguments as for `mean`."""
        light = self.light_of_photons(photons)
        return ReadingDistribution(self, exposure_s).tabulate(float(np.max(light, initial=0.0))).moments(light)


def check_sensor(sensor: SensorModel) -> SensorModel:
    """Return the sensor itself; raises ValueError if no sensor has its gain or read noise."""
    for name, requirement in (("gain_dn_per_e", "above 0"), ("read_noise_e", "0 or above")):
        value = getattr(sensor, name)
        if not (np.isfinite(value) and value >= 0) or (value == 0 and requirement == "above 0"):
            raise ValueError(f"sensor: {name} is {value!r}; it must be a number {requirement}")
    return sensor


class NoiseLine(NamedTuple):
    """Variance of a reading as a straight line in its mean: photon transfer of a sensor without clips."""

    at_zero: float  # variance [DN²] of a mean reading of 0 DN
    slope: float  # rise of the variance [DN²] for each DN of the mean: the gain K

    def variance(self, mean: np.ndarray) -> np.ndarray:
        """Return the variance [DN²] of readings with a mean [DN] of any shape; it is at least that of rounding."""
        return np.maximum(self.at_zero + self.slope * mean, ROUNDING_VARIANCE)


def noise_line(sensor: SensorModel | None) -> NoiseLine:
    """Return the noise line σ_y² = K² σ_d² + 1/12 + K (µ_y − black level) of a linear sensor (EMVA 1288, Eq. 14).

    σ_y² is the variance of a reading [DN²], K the gain [DN/e-], σ_d the read noise [e-], and µ_y the mean reading [DN].
    The term 1/12 is the variance of rounding. Without a sensor both numbers are NaN.
    """
    if sensor is None:
        return NoiseLine(np.nan, np.nan)
    gain = sensor.gain_dn_per_e
    dark_variance = (gain * sensor.read_noise_e) ** 2 + ROUNDING_VARIANCE
    return NoiseLine(dark_variance - gain * sensor.black_level_dn, gain)


def photo_electrons(photons, quantum_efficiency: float):
    """Return the mean photo-electrons µ_e = η µ_p [e-] of a mean number of photons, in its shape (Eq. 15)."""
    return quantum_efficiency * photons


def dark_signal(dark_e, gain_dn_per_e: float):
    """Return the dark signal µ_y,dark = K µ_d [DN] of mean dark electrons, in their shape (Eqs. 16 and 25)."""
    return gain_dn_per_e * dark_e


def mean_signal(photons, dark_e, gain_dn_per_e: float, quantum_efficiency: float):
    """Return the mean signal µ_y = K (η µ_p + µ_d) [DN] of a linear sensor, without black level (Eqs. 16, 24 and 29).

    `photons` are the mean photons µ_p and `dark_e` the mean dark electrons µ_d [e-] of pixels; they broadcast.
    """
    return gain_dn_per_e * photo_electrons(photons, quantum_efficiency) + dark_signal(dark_e, gain_dn_per_e)
