"""Absolute level of the simulated plateau by several interpretations of Eqs. 12–14, 22 and 27–29.

None of them gives the measured level, and their units do not agree. The simulation therefore uses one calibrated
constant (`peak`). All interpretations depend on the exposure by the same factor (p_b/σ_g)².
"""

import math

from spotcheck.dataset.instrument import Instrument
from spotcheck.model import optics, photons, propagation, spot
from spotcheck.model.baseline import of_instrument
from spotcheck.paper.results import require_key


def estimate_plateau_levels(
    instrument: Instrument, exposure_s: float, p1: float, p2: float, gain: float
) -> list[tuple[str, float]]:
    """Return each interpretation in words, and its peak of the Gaussian before the top hat [DN].

    Parameters
    ----------
    instrument : Instrument
        All keys of Table 3 of the paper.
    exposure_s : float
        Exposure time [s].
    p1, p2 : float
        Parameters of the beam propagation p_b [px].
    gain : float
        Gain [DN/e-].

    Raises
    ------
    InputError
        If a key of Table 3 is missing.
    """
    pitch, wavelength = require_key(instrument, "sensor.pixel_pitch_m"), require_key(instrument, "laser.wavelength_m")
    power, f_number = require_key(instrument, "laser.power_w"), require_key(instrument, "optics.f_number")
    reflectance = require_key(instrument, "material.reflectance")
    transmission = require_key(instrument, "optics.filter_transmission")
    focal_length = require_key(instrument, "optics.focal_length_m")
    scale = optics.magnification(focal_length, require_key(instrument, "optics.working_distance_m"))
    fwhm = (require_key(instrument, "laser.fwhm_x_m") + require_key(instrument, "laser.fwhm_y_m")) / 2
    sigma = float(of_instrument(instrument, [exposure_s]).sigma(exposure_s, p1, p2))
    spread = float(propagation.beam_propagation(exposure_s, p1, p2))
    dn_per_photon = gain * instrument.sensor.quantum_efficiency

    def level_at_centre(scattering: float) -> float:
        """Return the level [DN] of a pixel (Eq. 12) under the irradiance at the centre of the laser (Eq. 11)."""
        centre = photons.peak_irradiance(power, photons.beam_radius_of_fwhm(fwhm))
        light = photons.sensor_irradiance(centre, reflectance, scattering, f_number, transmission)
        return dn_per_photon * float(photons.pixel_photons(light, exposure_s, pitch**2, wavelength))

    def sum_on_sensor(scattering: float) -> float:
        """Return the sum of all readings [DN] due to the photons on the sensor (Eq. 14)."""
        losses = (reflectance, scattering, f_number, transmission)
        count = photons.total_photons(exposure_s, power, wavelength, *losses)
        return dn_per_photon * float(count)

    in_pixels = float(photons.scattering_factor(exposure_s, spread))
    in_metres = float(photons.scattering_factor(exposure_s, spread * pitch))
    density = 1 / (2 * math.pi * sigma**2)
    printed = float(spot.photon_distribution(0.0, 0.0, sigma, sigma, 0.0, scale))
    spread_out, at_centre = "Eq. 14 spread over the Gaussian of σ_g", "Eq. 12 at the laser's centre"
    return [
        (f"{at_centre}, without ϱ_s", level_at_centre(1.0)),
        (f"{at_centre}, ϱ_s with p_b in pixels", level_at_centre(in_pixels)),
        (f"{spread_out}, without ϱ_s", sum_on_sensor(1.0) * density),
        (f"{spread_out}, ϱ_s with p_b in pixels", sum_on_sensor(in_pixels) * density),
        (f"{spread_out}, ϱ_s with p_b in metres on the sensor", sum_on_sensor(in_metres) * density),
        ("Eqs. 27–28 as printed (1/M³), ϱ_s with p_b in pixels", level_at_centre(in_pixels) * printed),
        (
            "Eqs. 27–28 with 1/M² as the change of variables gives, ϱ_s with p_b in pixels",
            level_at_centre(in_pixels) * printed * scale,
        ),
        ("Eqs. 27–28 as printed (1/M³), without ϱ_s", level_at_centre(1.0) * printed),
    ]
