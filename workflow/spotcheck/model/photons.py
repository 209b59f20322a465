"""Photon budget from the laser power to photons on the sensor: Eqs. 9–14 in SI units.

The absolute level of the paper's chain is inconsistent (see `spot.photon_distribution`), but its dependence on the
exposure is not. p_b is the beam propagation, the width of the spot without the laser's own. Arguments are numbers;
those without a type may be arrays that broadcast.
"""

import math

import numpy as np
from scipy.constants import c, h


def laser_irradiance(radius_m, power_w: float, beam_radius_m: float):
    """Return the irradiance E_la,Gaus [W/m²] of a Gaussian beam at a distance `radius_m` from its axis (Eq. 9).

    `beam_radius_m` is the 1/e² radius w.
    """
    return peak_irradiance(power_w, beam_radius_m) * np.exp(-2 * np.square(radius_m) / beam_radius_m**2)


def peak_irradiance(power_w: float, beam_radius_m: float) -> float:
    """Return the irradiance E_la,max [W/m²] on the axis of a Gaussian beam of 1/e² radius `beam_radius_m` (Eq. 11)."""
    return 2 * power_w / (math.pi * beam_radius_m**2)


def beam_radius_of_fwhm(fwhm_m: float) -> float:
    """Return w_FWHM [m], the 1/e² radius of a beam with a full width at half maximum `fwhm_m` [m] (Eq. 11)."""
    return 0.5 * math.sqrt(2 / math.log(2)) * fwhm_m


def sensor_irradiance(irradiance, reflectance: float, scattering, f_number: float, transmission: float):
    """Return E_px = E_la ϱ_m ϱ_s ϱ_a ϱ_f, the irradiance behind material, aperture and filter (Eq. 12, second line).

    The factors are the reflectance ϱ_m [1] of the material, the scattering ϱ_s, ϱ_a = 1/f_a² of the aperture, and the
    transmission ϱ_f [1] of the filter. The unit of the result is that of `irradiance` times that of ϱ_s, which is 1, or
    px²/s or m²/s from `scattering_factor`.
    """
    return irradiance * reflectance * scattering * transmission / f_number**2


def pixel_photons(irradiance, exposure_s, pixel_area_m2: float, wavelength_m: float):
    """Return µ_p [1], the mean number of photons on a pixel during an exposure (Eq. 12).

    `irradiance` is E_px [W/m²], `exposure_s` the exposure [s], `pixel_area_m2` the area of the pixel [m²] and
    `wavelength_m` the wavelength [m].
    """
    return pixel_area_m2 * irradiance * exposure_s * wavelength_m / (h * c)


def scattering_factor(exposure_s, propagation):
    """Return the scattering factor ϱ_s = p_b²/t (Eq. 13), in px²/s or m²/s for `propagation` p_b in px or m.

    This factor has no physical meaning. It cancels the exposure t in the photon budget, so that the peak is
    proportional to (p_b/σ_g)², with the width σ_g of the spot.
    """
    return np.square(propagation) / exposure_s


def total_photons(
    exposure_s,
    power_w: float,
    wavelength_m: float,
    reflectance: float,
    scattering,
    f_number: float,
    transmission: float,
):
    """Return µ_p,total, the mean number of photons on the whole sensor, in the unit of ϱ_s (Eq. 14).

    Arguments are those of `sensor_irradiance`, the power of the laser [W], the exposure and the wavelength of the
    light.
    """
    # Power is lost by the same factors as irradiance.
    power_on_sensor = sensor_irradiance(power_w, reflectance, scattering, f_number, transmission)
    return power_on_sensor * exposure_s * wavelength_m / (h * c)
