"""From light to readings: photons → electrons → DN, with mean *and* variance (EMVA 1288 linear model; Eqs. 15, 16,
23–25).

Order of the chain: Poisson electrons (light and dark current) → full well → read noise → gain K → bend of the response
→ black level → one rounding to nearest → 0 … full scale. `light_dn` is always K times the photo-electrons: the signal
that a linear sensor without noise would add to its black level.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from spotcheck.old_engine.model.response import bent, straightened

# Variance of rounding to whole DN (Section 4.1.1): σ_q² = 1/12 DN².
ROUNDING_VARIANCE = 1 / 12

# A light [DN] that no sensor's end or rounding reaches: there the noise is a straight line in the mean.
FAR_DN = 1e3


class SensorModel(NamedTuple):
    """A camera by the linear model of EMVA 1288: mean and variance of a reading, and random readings.

    Light is given as the mean number of photons that fall on each pixel during the exposure. They become electrons with
    the quantum efficiency, dark current adds its own, both are Poisson; then come full well, read noise, gain, black
    level, one rounding to whole DN, and a converter that ends at 0 and at full scale. Beyond the linear model, the
    response may bend.

    Parameters
    ----------
    gain_dn_per_e : overall gain K [DN/e-].
    read_noise_e : noise in the dark, rms [e-].
    dark_current_e_per_s : dark current µ_I [e-/s].
    full_well_e : electrons at which a pixel is full.
    black_level_dn : reading without light and without electrons [DN].
    full_scale_dn : largest reading [DN], 1023 for 10 bit.
    quantum_efficiency : electrons per photon; with the default 1, photons are electrons.
    response_bend : how much the response bends [1]: a signal y above black is read as y − q y²/full scale.

    Examples
    --------
    >>> import spotcheck
    >>> sensor = spotcheck.SensorModel(0.11, 13.0, black_level_dn=40, full_scale_dn=1023, quantum_efficiency=0.38)
    >>> sensor.mean(10_000)
    np.float64(458.0)
    >>> sensor.variance(10_000)
    np.float64(48.10823333333333)
    >>> sensor.draw([[0, 10_000], [100_000, 0]], rng=1)
    array([[  40,  449],
           [1023,   42]], dtype=uint16)
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
        """Curvature of the response [1/DN]."""
        return self.response_bend / self.full_scale_dn

    def straight(self) -> SensorModel:
        """The sensor that would read `straightened` readings: the same, but with a response that does not bend."""
        if not self.curvature:
            return self
        return self._replace(response_bend=0.0, full_scale_dn=float(self.straightened(self.full_scale_dn)))

    def straightened(self, readings: ArrayLike) -> np.ndarray:
        """Readings [DN] with the bend of the response turned round; NaN stays NaN.

        Noise of the signal is bent with it, so what is left is the law of a straight sensor, but for the rounding: it
        happens behind the bend, and counts as if it did not.
        """
        if not self.curvature:
            return np.asarray(readings)
        signal = np.asarray(readings, dtype=float) - self.black_level_dn
        return self.black_level_dn + straightened(signal, self.curvature)

    def mean(self, photons: ArrayLike, *, exposure_s: float = 0.0) -> np.ndarray:
        """Mean reading [DN] of each pixel, both clips included, in the shape of `photons`.

        `photons` is the mean number of photons on each pixel during the exposure; the exposure itself, `exposure_s`,
        counts for dark current alone. Raises ValueError for photons below 0, and for a gain or noise that no sensor
        has.
        """
        return self._moments(photons, exposure_s)[0]

    def variance(self, photons: ArrayLike, *, exposure_s: float = 0.0) -> np.ndarray:
        """Variance [DN²] of the reading of each pixel, rounding and both clips included; otherwise as `mean`."""
        return self._moments(photons, exposure_s)[1]

    def draw(self, photons: ArrayLike, rng: np.random.Generator | int, *, exposure_s: float = 0.0) -> np.ndarray:
        """Random readings [DN, uint16] of each pixel, from the exact law; light as for `mean`.

        `rng` is a generator, or a seed: equal seeds give equal readings.
        """
        from spotcheck.old_engine.model.draws import draw_readings

        light = np.asarray(self._light(photons), order="C")
        out = np.empty(light.shape, np.uint16)
        dark_e = self.dark_current_e_per_s * exposure_s
        draw_readings(light.reshape(-1), dark_e, self, np.random.default_rng(rng), out.reshape(-1))
        return out[()]

    def _light(self, photons: ArrayLike) -> np.ndarray:
        """K η µ_p [DN], the light of a mean number of photons."""
        checked(self)
        photons = np.asarray(photons, dtype=float)
        if not np.all(photons >= 0):
            raise ValueError("photons: holds a number that is not 0 or above; give the mean number on each pixel")
        return self.gain_dn_per_e * photo_electrons(photons, self.quantum_efficiency)

    def _moments(self, photons: ArrayLike, exposure_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance: from the table of the law where light is faint, else those of normal readings."""
        from spotcheck.old_engine.model.law import faint_law

        light, table = self._light(photons), faint_law(self)
        bright = reading(light, exposure_s, self)
        electrons = light / self.gain_dn_per_e + self.dark_current_e_per_s * exposure_s
        faint = electrons < table.highest_e
        mean, variance = (np.interp(electrons, table.levels, own) for own in (table.mean, table.variance))
        return np.where(faint, mean, bright.mean)[()], np.where(faint, variance, bright.variance)[()]


class NoiseLine(NamedTuple):
    """The sensor's noise: variance [DN²] of a reading of 0 DN, and its rise for each DN of mean [DN]. Where readings
    stop their scatter vanishes, and a residual over that would say nothing: both ends are left out."""

    at_zero: float
    slope: float

    def variance(self, mean: np.ndarray) -> np.ndarray:
        """Variance [DN²] of readings of a mean [DN]; never less than rounding brings."""
        return np.maximum(self.at_zero + self.slope * mean, ROUNDING_VARIANCE)


def noise_line(sensor: SensorModel | None) -> NoiseLine:
    """The noise of a sensor; NaN without one."""
    if sensor is None:
        return NoiseLine(np.nan, np.nan)
    # The bend goes with full scale: the line is that of a straight response.
    endless = sensor._replace(full_scale_dn=np.inf, full_well_e=np.inf, dark_current_e_per_s=0.0)
    one, two = (float(reading(np.float64(light), 0.0, endless).variance) for light in (FAR_DN, 2 * FAR_DN))
    slope = (two - one) / FAR_DN
    return NoiseLine(one - slope * (FAR_DN + sensor.black_level_dn), slope)


def checked(sensor: SensorModel) -> SensorModel:
    """The sensor itself. Raises ValueError for numbers that no sensor has."""
    for name, low in (("gain_dn_per_e", "above 0"), ("read_noise_e", "0 or above")):
        value = getattr(sensor, name)
        if not (np.isfinite(value) and value >= 0) or (value == 0 and low == "above 0"):
            raise ValueError(f"sensor: {name} is {value!r}; it must be a number {low}")
    return sensor


class Reading(NamedTuple):
    """Moments of a pixel's reading: mean [DN], variance [DN²], and d mean / d light_dn [1]."""

    mean: np.ndarray
    variance: np.ndarray
    response: np.ndarray


def photo_electrons(photons, quantum_efficiency: float):
    """µ_e [e-], mean electrons of a mean number of photons (Eq. 15)."""
    return quantum_efficiency * photons


def dark_signal(dark_e, gain_dn_per_e: float):
    """β = µ_y,dark = K µ_d [DN], for a mean number of dark electrons (Eqs. 16 and 25)."""
    return gain_dn_per_e * dark_e


def mean_signal(photons, dark_e, gain_dn_per_e: float, quantum_efficiency: float):
    """µ_y [DN] of the linear sensor (Eqs. 16, 24 and 29): K (η_qe µ_p + µ_d)."""
    return gain_dn_per_e * photo_electrons(photons, quantum_efficiency) + dark_signal(dark_e, gain_dn_per_e)


def reading(light_dn, exposure_s: float, sensor: SensorModel) -> Reading:
    """Moments of the reading of each pixel under `light_dn`, both clips and the rounding included.

    Electrons and read noise enter as one normal distribution, which the well and the converter clip; at fewer than
    about ten electrons and no read noise the true distribution is skewed and this is an approximation.
    """
    gain = sensor.gain_dn_per_e
    electrons = light_dn / gain + sensor.dark_current_e_per_s * exposure_s
    well = clipped_normal(electrons, electrons, 1.0, -np.inf, sensor.full_well_e, rounding=0.0)
    signal, noise = gain * well.mean, gain**2 * (well.variance + sensor.read_noise_e**2)
    slope: np.ndarray | float = 1.0
    if sensor.curvature:
        slope = np.maximum(1 - 2 * sensor.curvature * signal, 0.0)
        signal, noise = bent(signal, noise, sensor.curvature)
    mean = signal + sensor.black_level_dn
    # Below the well a DN of mean brings K DN² of variance. Near it the variance falls again, which is left out: there
    # the converter's own clip is far away.
    out = clipped_normal(mean, noise, gain, 0.0, sensor.full_scale_dn, rounding=ROUNDING_VARIANCE)
    return Reading(out.mean, out.variance, out.response * slope * well.response)


def clipped_normal(mean, variance, variance_slope, low: float, high: float, rounding: float) -> Reading:
    """Moments of clip(z, low, high) for normal z; response is d/d mean, with d variance / d mean = variance_slope.

    With `rounding` = 1/12, z is rounded to whole numbers before the clip. A sum over whole numbers is the midpoint
    rule of the integral without rounding, so that Euler–Maclaurin gives what is added: inside/12 to the second
    moment, and half of density/12 off the mean's distance to an edge.
    """
    if np.isneginf(low) and np.isposinf(high):
        return Reading(mean, variance + rounding, np.ones_like(mean))
    # Where the noise is much below a DN there is nothing to integrate over: rounding then counts as noise of its own.
    fine = np.less(np.real(variance), 0.3**2)
    variance = variance + np.where(fine, rounding, 0.0)
    whole = np.where(fine, 0.0, rounding)
    sd = np.sqrt(np.maximum(variance, 1e-300))
    # Edges in units of sd; one that is 40 sd away never acts, and kept finite it makes no 0 · ∞.
    a, b = np.maximum((low - mean) / sd, -40.0), np.minimum((high - mean) / sd, 40.0)
    below, above = ndtr(a), ndtr(-b)
    inside = 1 - below - above
    pdf_a, pdf_b = _normal_pdf(a), _normal_pdf(b)
    first = a * below + b * above + pdf_a - pdf_b
    second = a * a * below + b * b * above + inside + a * pdf_a - b * pdf_b
    at_low, at_high = whole * pdf_a / (2 * sd), whole * pdf_b / (2 * sd)
    spread = sd**2 * np.maximum(second - first**2, 0.0) + whole * inside
    spread = spread + 2 * sd * ((first - a) * at_low + (b - first) * at_high)
    response = inside + (pdf_a - pdf_b) * variance_slope / (2 * sd)
    response = response - whole * (a * pdf_a - b * pdf_b) / (2 * sd**2)
    return Reading(mean + sd * first - at_low + at_high, spread, response)


def _normal_pdf(z):
    return np.exp(-z * z / 2) / np.sqrt(2 * np.pi)
