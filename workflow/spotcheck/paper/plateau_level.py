"""Absolute level of the simulated plateau by several interpretations of Eqs. 12–14, 22 and 27–29.

None of them gives the measured level, and their units do not agree. The simulation therefore uses a peak that is
calibrated on the frames. All interpretations depend on the exposure by the same factor (p_b/σ_g)².

p_b = p1 ln(t/1 s) + p2 is the beam propagation at an exposure t (Eq. 8), σ_g the width of the spot (Eq. 7), ϱ_s the
scattering factor p_b²/t (Eq. 13), and M the magnification. f_θ is the distribution of the photons over the sensor, a
Gaussian (Eq. 22). The top hat cuts the Gaussian spot to a plateau.
"""

import math

from spotcheck.dataset.instrument import Instrument
from spotcheck.model import optics, photons, propagation, spot
from spotcheck.model.baseline import build_baseline
from spotcheck.paper.results import require_key


def estimate_plateau_levels(
    instrument: Instrument, exposure_s: float, p1: float, p2: float, gain: float
) -> list[tuple[str, float]]:
    """Return for each interpretation its description and the peak [DN] of the Gaussian, before the top hat.

    Parameters
    ----------
    instrument : instrument file; raises `InputError` unless it has all keys of Table 3 of the paper.
    exposure_s : exposure time [s].
    p1, p2 : parameters of the beam propagation p_b [px]: its slope over ln t, and its value at 1 s.
    gain : gain [DN/e-].
    """
    pitch, wavelength = require_key(instrument, "sensor.pixel_pitch_m"), require_key(instrument, "laser.wavelength_m")
    power, f_number = require_key(instrument, "laser.power_w"), require_key(instrument, "optics.f_number")
    reflectance = require_key(instrument, "material.reflectance")
    transmission = require_key(instrument, "optics.filter_transmission")
    focal_length = require_key(instrument, "optics.focal_length_m")
    magnification = optics.magnification(focal_length, require_key(instrument, "optics.working_distance_m"))
    # ASSUME: a round laser spot, as wide as both axes on average.
    fwhm_m = (require_key(instrument, "laser.fwhm_x_m") + require_key(instrument, "laser.fwhm_y_m")) / 2
    sigma_px = float(build_baseline(instrument, [exposure_s]).sigma(exposure_s, p1, p2))
    propagation_px = float(propagation.beam_propagation(exposure_s, p1, p2))
    dn_per_photon = gain * instrument.sensor.quantum_efficiency

    def level_at_centre(scattering: float) -> float:
        """Return the level [DN] of a pixel (Eq. 12) at the centre of the laser (Eq. 11); `scattering` is ϱ_s or 1."""
        centre = photons.peak_irradiance(power, photons.beam_radius_of_fwhm(fwhm_m))
        light = photons.sensor_irradiance(centre, reflectance, scattering, f_number, transmission)
        return dn_per_photon * float(photons.pixel_photons(light, exposure_s, pitch**2, wavelength))

    def sum_on_sensor(scattering: float) -> float:
        """Return the sum of all readings [DN] due to the photons on the sensor (Eq. 14); `scattering` as above."""
        light_path = (reflectance, scattering, f_number, transmission)
        return dn_per_photon * float(photons.total_photons(exposure_s, power, wavelength, *light_path))

    # ϱ_s in px²/s and in m²/s on the sensor.
    scattering_px = float(photons.scattering_factor(exposure_s, propagation_px))
    scattering_m = float(photons.scattering_factor(exposure_s, propagation_px * pitch))
    # Share of the light per area at the centre of the Gaussian [1/px²], from its normalization.
    centre_density = 1 / (2 * math.pi * sigma_px**2)
    # f_θ at the centre [1/px²] as Eq. 22 prints it, with the factor 1/M³; M times this has 1/M².
    printed_density = float(
        spot.photon_distribution(0.0, 0.0, sigma_px, sigma_px, correlation=0.0, magnification=magnification)
    )
    total_label, centre_label = "Eq. 14 spread over the Gaussian of σ_g", "Eq. 12 at the laser's centre"
    return [
        (f"{centre_label}, without ϱ_s", level_at_centre(1.0)),
        (f"{centre_label}, ϱ_s with p_b in pixels", level_at_centre(scattering_px)),
        (f"{total_label}, without ϱ_s", sum_on_sensor(1.0) * centre_density),
        (f"{total_label}, ϱ_s with p_b in pixels", sum_on_sensor(scattering_px) * centre_density),
        (f"{total_label}, ϱ_s with p_b in metres on the sensor", sum_on_sensor(scattering_m) * centre_density),
        ("Eqs. 27–28 as printed (1/M³), ϱ_s with p_b in pixels", level_at_centre(scattering_px) * printed_density),
        (
            "Eqs. 27–28 with 1/M² as the change of variables gives, ϱ_s with p_b in pixels",
            level_at_centre(scattering_px) * printed_density * magnification,
        ),
        ("Eqs. 27–28 as printed (1/M³), without ϱ_s", level_at_centre(1.0) * printed_density),
    ]
