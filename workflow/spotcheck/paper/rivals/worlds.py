"""Forward models ("worlds") that could have made the paper's measured frames.

All worlds draw 32 sites. Each site has its own brightness and speckle, which its exposures share. A world states the
light of a site and what the sensor makes of its electrons. Each world has six free parameters.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.constants import c, h

from spotcheck.model import propagation, spot

# Design of the paper (Section 3.2.1): sites, exposures [s], and the side of a crop [px].
SITES, EXPOSURES_S, SIDE = 32, (1e-4, 5e-4, 9e-4), 240
LONGEST_S = EXPOSURES_S[-1]
# Sensor of Table 3; the read noise is that of the chip's 60 dB.
GAIN_DN_PER_E, READ_NOISE_E, FULL_SCALE_DN = 0.11, 13.0, 1023
# M σ_la/s_px, the laser's own width on the sensor [px].
LASER_PX = 1.188
# Highest spatial frequency of the field behind the lens, 1/(2 λ f_a (1 + M)) [cycles per px] (Section 3.1.2).
FIELD_CUTOFF = 0.3205
# Signal [DN] of the whole spot at the longest exposure if the material were Lambertian with 2 % reflectance: 1 mW of
# 650 nm for 900 µs, times (f/(2 f_a d_w))² = 8.33e-5, the filter's 0.9193, the quantum efficiency 0.38 and the gain.
LAMBERTIAN_DN = 1e-3 * LONGEST_S * 6.5e-7 / (h * c) * 0.02 * 8.33e-5 * 0.9193 * 0.38 * GAIN_DN_PER_E
# Speckle is computed on a grid this much finer than the pixels, since its intensity has twice the field's bandwidth.
OVERSAMPLING = 2

Values = Mapping[str, float]


@dataclass(frozen=True)
class Parameter:
    """A free parameter of a world."""

    name: str  # name in `World.values`
    unit: str  # unit; "1" if dimensionless
    low: float  # smallest value that is tried [unit]
    high: float  # largest value that is tried [unit]
    is_log: bool = True  # whether values are tried evenly in their logarithm


@dataclass(frozen=True)
class World:
    """A forward model of the paper's frames."""

    name: str  # key of the world
    title: str  # name for tables and legends
    parameters: tuple[Parameter, ...]  # free parameters
    # Light [y, x] in DN, from the distance to the spot's centre [y, x] in px, the exposure [s], the values of the
    # parameters, and the factor by which the spot of the site is wider than that of the parameters [1].
    light: Callable[[np.ndarray, float, Values, float], np.ndarray]
    # Electrons after the sensor's limit, from electrons [y, x], values and random generator.
    limit: Callable[[np.ndarray, Values, np.random.Generator], np.ndarray]

    def values(self, unit_point: np.ndarray) -> dict[str, float]:
        """Return the values of the parameters by name, in their units, from a point of the unit cube [parameter].

        The coordinates 0 and 1 stand for the smallest and the largest value of a parameter.
        """
        values = {}
        for parameter, fraction in zip(self.parameters, unit_point, strict=True):
            if parameter.is_log:
                values[parameter.name] = float(parameter.low * (parameter.high / parameter.low) ** fraction)
            else:
                values[parameter.name] = float(parameter.low + (parameter.high - parameter.low) * fraction)
        return values

    def draw(
        self,
        values: Values,
        rng: np.random.Generator,
        exposures_s: tuple[float, ...] = EXPOSURES_S,
        transmission: float = 1.0,
    ) -> np.ndarray:
        """Return the readings [site, exposure, y, x] in DN of one realisation of the experiment.

        Parameters
        ----------
        values : mapping of str to float
            Values of the parameters by name.
        rng : Generator
            Source of the random numbers.
        exposures_s : tuple of float
            Exposures [s].
        transmission : float
            Transmission of a filter in front of the lens [1].
        """
        readings = np.empty((SITES, len(exposures_s), SIDE, SIDE))
        for site in range(SITES):
            brightness = np.exp(values["brightness_sd"] * rng.standard_normal())
            width_factor = np.exp(values.get("width_sd", 0.0) * rng.standard_normal())
            x0, y0 = SIDE / 2 + rng.uniform(-0.5, 0.5, 2)
            pixels = np.arange(SIDE)
            radius = np.hypot(pixels[None, :] - x0, pixels[:, None] - y0)
            modulation = 1 + values["contrast"] * (draw_speckle(rng) - 1)
            for k, exposure_s in enumerate(exposures_s):
                light_dn = transmission * brightness * self.light(radius, exposure_s, values, width_factor) * modulation
                electrons = self.limit(rng.poisson(light_dn / GAIN_DN_PER_E), values, rng)
                analogue = GAIN_DN_PER_E * (electrons + READ_NOISE_E * rng.standard_normal(radius.shape))
                readings[site, k] = np.clip(np.rint(analogue), 0, FULL_SCALE_DN)
        return readings


def photon_gain(world: World, values: Values) -> float:
    """Return the light of the spot at the longest exposure over that of a Lambertian surface of 2 % reflectance [1].

    `LAMBERTIAN_DN` is the light of the whole spot by the paper's photon budget, without its scattering factor ϱ_s and
    with the solid angle of the lens in place of 1/f_a².
    """
    pixels = np.arange(SIDE) - SIDE / 2
    radius = np.hypot(pixels[None, :], pixels[:, None])
    return float(world.light(radius, LONGEST_S, values, 1.0).sum() / LAMBERTIAN_DN)


def draw_speckle(rng: np.random.Generator) -> np.ndarray:
    """Return one fully developed speckle pattern [y, x] of mean 1, averaged over each pixel."""
    fine = SIDE * OVERSAMPLING
    # Spatial frequencies of the fine grid [cycles per px].
    frequency = np.fft.fftfreq(fine) * OVERSAMPLING
    is_passed = np.hypot(frequency[None, :], frequency[:, None]) < FIELD_CUTOFF
    # Single precision suffices for a pattern, and takes half the time.
    field = np.zeros((fine, fine), np.complex64)
    real, imaginary = rng.standard_normal((2, is_passed.sum()), np.float32)
    field[is_passed] = real + 1j * imaginary
    amplitude = fft.ifft2(field)
    intensity = amplitude.real**2 + amplitude.imag**2
    pixel_means = intensity.reshape(SIDE, OVERSAMPLING, SIDE, OVERSAMPLING).mean(axis=(1, 3))
    return pixel_means / pixel_means.mean()


def _growing_light(radius, exposure_s, values, width_factor):
    """Return the light of the paper's model: a Gaussian that widens with the exposure, cut by a top hat (Eq. 39).

    With p_b = `width_factor` · (p1 ln t + p2), the width is σ_g = p_b + `LASER_PX`. The top hat cuts the Gaussian at
    plateau · (p_b/σ_g)² in DN (Eqs. 13 and 28). Arguments and result are those of `World.light`.
    """
    propagation_px = width_factor * propagation.beam_propagation(exposure_s, values["p1"], values["p2"])
    # At short exposures p_b may be negative; the Gaussian needs a positive width.
    sigma_px = propagation.spot_sigma(max(propagation_px, 1.0), LASER_PX)
    # Peak of the Gaussian before the top hat, which leaves the part `TOP_HAT_LEVEL` of it.
    peak_dn = values["plateau"] * (propagation_px / sigma_px) ** 2 / spot.TOP_HAT_LEVEL
    return spot.top_hat(peak_dn * np.exp(-(radius**2) / (2 * sigma_px**2)), peak_dn)


def _gaussian_light(radius, exposure_s, values, width_factor):
    """Return the light of a Gaussian of constant width, in proportion to the exposure; arguments as `World.light`."""
    return values["peak"] * exposure_s / LONGEST_S * np.exp(-(radius**2) / (2 * values["width"] ** 2))


def _exponential_light(radius, exposure_s, values, width_factor):
    """Return the light of an exponential profile of constant width, in proportion to the exposure.

    Arguments and result are those of `World.light`.
    """
    return values["peak"] * exposure_s / LONGEST_S * np.exp(-radius / values["width"])


def _keep(electrons, values, rng):
    """Return the electrons unchanged: only the converter limits the readings. Arguments are those of `World.limit`."""
    return electrons


def _clip(electrons, values, rng):
    """Return electrons clipped at a level that scatters from pixel to pixel; arguments as `World.limit`."""
    level_e = values["level"] / GAIN_DN_PER_E * (1 + values["level_scatter"] * rng.standard_normal(electrons.shape))
    return np.minimum(electrons, level_e)


def _bend(electrons, values, rng):
    """Return electrons of a pixel whose response bends smoothly towards a level; arguments as `World.limit`."""
    level_e, order = values["level"] / GAIN_DN_PER_E, values["order"]
    return electrons / (1 + (electrons / level_e) ** order) ** (1 / order)


def _clip_during_exposure(electrons, values, rng):
    """Return electrons of a pixel whose charge is limited to a level, except during the last part of the exposure.

    `last_slope` is this part of the exposure [1]. Arguments are those of `World.limit`.
    """
    return np.minimum(electrons, values["level"] / GAIN_DN_PER_E + values["last_slope"] * electrons)


# Standard deviation over sites of ln brightness, contrast of the speckle, peak of the light at the longest exposure,
# level at which the sensor limits a pixel, and scale of the profile: σ of a Gaussian, or 1/e radius.
_BRIGHTNESS = Parameter("brightness_sd", "1", 0.05, 2.0)
_CONTRAST = Parameter("contrast", "1", 0.05, 1.0)
_PEAK = Parameter("peak", "DN", 1e3, 1e6)
_LEVEL = Parameter("level", "DN", 600.0, 900.0)
_WIDTH = Parameter("width", "px", 4.0, 14.0)

WORLDS = (
    World(
        "growth",
        "spot grows with exposure (the paper's model)",
        (
            Parameter("p1", "px", 1.5, 4.0),
            Parameter("p2", "px", 25.0, 50.0),
            Parameter("plateau", "DN", 500.0, 2000.0),  # level of the top hat of a spot much wider than the laser
            _BRIGHTNESS,
            Parameter("width_sd", "1", 0.02, 0.5),  # standard deviation over sites of the logarithm of the width factor
            _CONTRAST,
        ),
        _growing_light,
        _keep,
    ),
    World(
        "gaussian clip",
        "Gaussian of constant width, hard clip",
        (_WIDTH, _PEAK, _LEVEL, Parameter("level_scatter", "1", 0.001, 0.1), _BRIGHTNESS, _CONTRAST),
        _gaussian_light,
        _clip,
    ),
    World(
        "exponential clip",
        "exponential profile of constant width, hard clip",
        (
            Parameter("width", "px", 1.5, 8.0),
            _PEAK,
            _LEVEL,
            Parameter("level_scatter", "1", 0.001, 0.1),
            _BRIGHTNESS,
            _CONTRAST,
        ),
        _exponential_light,
        _clip,
    ),
    World(
        "soft knee",
        "Gaussian of constant width, response with a soft knee",
        (_WIDTH, _PEAK, _LEVEL, Parameter("order", "1", 1.5, 20.0), _BRIGHTNESS, _CONTRAST),
        _gaussian_light,
        _bend,
    ),
    World(
        "multiple slope",
        "Gaussian of constant width, pixels held at a level during the exposure",
        (_WIDTH, _PEAK, _LEVEL, Parameter("last_slope", "1", 1e-5, 1e-2), _BRIGHTNESS, _CONTRAST),
        _gaussian_light,
        _clip_during_exposure,
    ),
)
