"""From laser power to photons on the sensor: Eqs. 9–14 in SI units.

The absolute level of the paper's chain does not close (see `spot.photon_distribution`); what follows the exposure does.
"""

import math

import numpy as np
from scipy.constants import c, h


def laser_irradiance(radius_m, power_w: float, beam_radius_m: float):
    """E_la,Gaus [W/m²] at a distance from the axis, for a beam of 1/e² radius w (Eq. 9)."""
    return peak_irradiance(power_w, beam_radius_m) * np.exp(-2 * np.square(radius_m) / beam_radius_m**2)


def peak_irradiance(power_w: float, beam_radius_m: float) -> float:
    """E_la,max [W/m²] on the axis (Eq. 11)."""
    return 2 * power_w / (math.pi * beam_radius_m**2)


def beam_radius_of_fwhm(fwhm_m: float) -> float:
    """w_FWHM [m], the 1/e² radius of a beam with a full width at half maximum (Eq. 11): √(2/ln 2)/2 · FWHM."""
    return 0.5 * math.sqrt(2 / math.log(2)) * fwhm_m


def sensor_irradiance(irradiance, reflectance: float, scattering, f_number: float, transmission: float):
    """E_px [W/m²] behind material, aperture and filter: E_la ϱ_m ϱ_s ϱ_a ϱ_f with ϱ_a = 1/f_a² (second line of Eq.
    12)."""
    return irradiance * reflectance * scattering * transmission / f_number**2


def pixel_photons(irradiance, exposure_s, pixel_area_m2: float, wavelength_m: float):
    """µ_p [1], mean photons on a pixel under an irradiance E_px [W/m²] (Eq. 12)."""
    return pixel_area_m2 * irradiance * exposure_s * wavelength_m / (h * c)


def scattering_factor(exposure_s, propagation):
    """ϱ_s = p_b²/t (Eq. 13), in the square of p_b's unit per second: an auxiliary factor, not a physical one.

    It divides the exposure out of the photon budget, which leaves the peak to follow (p_b/σ_g)².
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
    """µ_p,total [1 with ϱ_s = 1], mean photons on the whole sensor (Eq. 14)."""
    reduced = sensor_irradiance(power_w, reflectance, scattering, f_number, transmission)
    return reduced * exposure_s * wavelength_m / (h * c)
