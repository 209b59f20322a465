"""Absolute level of the simulated plateau by several interpretations of Eqs. 12–14, 22 and 27–29.

None of them gives the measured level, and their units do not agree. The simulation therefore uses one calibrated
constant (`peak`). All interpretations depend on the exposure by the same factor (p_b/σ_g)².
"""

import math
from typing import NamedTuple

from spotcheck.dataset.instrument import Instrument
from spotcheck.model import optics, photons, propagation, spot
from spotcheck.model.baseline import of_instrument
from spotcheck.paper.results import require_key


class LevelEstimate(NamedTuple):
    """Level of the plateau by one interpretation of the equations."""

    interpretation: str  # equations and assumptions, in words
    peak_dn: float  # peak of the Gaussian before the top hat [DN]


def estimate_plateau_levels(
    instrument: Instrument, exposure_s: float, p1: float, p2: float, gain: float
) -> list[LevelEstimate]:
    """Return the level of the plateau by each interpretation that was tried.

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
    pitch, wavelength, power, reflectance, f_number, transmission = (
        require_key(instrument, key)
        for key in (
            "sensor.pixel_pitch_m",
            "laser.wavelength_m",
            "laser.power_w",
            "material.reflectance",
            "optics.f_number",
            "optics.filter_transmission",
        )
    )
    scale = optics.magnification(
        require_key(instrument, "optics.focal_length_m"), require_key(instrument, "optics.working_distance_m")
    )
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
        count = photons.total_photons(exposure_s, power, wavelength, reflectance, scattering, f_number, transmission)
        return dn_per_photon * float(count)

    in_pixels = float(photons.scattering_factor(exposure_s, spread))
    in_metres = float(photons.scattering_factor(exposure_s, spread * pitch))
    density = 1 / (2 * math.pi * sigma**2)
    printed = float(spot.photon_distribution(0.0, 0.0, sigma, sigma, 0.0, scale))
    return [
        LevelEstimate(interpretation, peak_dn)
        for interpretation, peak_dn in (
            ("Eq. 12 at the laser's centre, without ϱ_s", level_at_centre(1.0)),
            ("Eq. 12 at the laser's centre, ϱ_s with p_b in pixels", level_at_centre(in_pixels)),
            ("Eq. 14 spread over the Gaussian of σ_g, without ϱ_s", sum_on_sensor(1.0) * density),
            ("Eq. 14 spread over the Gaussian of σ_g, ϱ_s with p_b in pixels", sum_on_sensor(in_pixels) * density),
            (
                "Eq. 14 spread over the Gaussian of σ_g, ϱ_s with p_b in metres on the sensor",
                sum_on_sensor(in_metres) * density,
            ),
            ("Eqs. 27–28 as printed (1/M³), ϱ_s with p_b in pixels", level_at_centre(in_pixels) * printed),
            (
                "Eqs. 27–28 with 1/M² as the change of variables gives, ϱ_s with p_b in pixels",
                level_at_centre(in_pixels) * printed * scale,
            ),
            ("Eqs. 27–28 as printed (1/M³), without ϱ_s", level_at_centre(1.0) * printed),
        )
    ]
