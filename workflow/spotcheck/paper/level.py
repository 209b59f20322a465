"""The absolute level of the simulated plateau: readings of Eqs. 12–14, 22 and 27–29 that were tried.

None gives the measured level, and their units do not agree; the level is one calibrated constant instead (`peak`).
What they share is the dependence on exposure, (p_b/σ_g)².
"""

import math

from spotcheck.dataset.instrument import Instrument
from spotcheck.model import optics, photons, propagation, spot
from spotcheck.model.baseline import of_instrument
from spotcheck.paper.results import known


def readings(instrument: Instrument, exposure_s: float, p1: float, p2: float, gain: float) -> list[tuple[str, float]]:
    """What was read, and the peak [DN] of the Gaussian that follows at an exposure [s], before the top hat."""
    lens, laser, pitch = instrument.optics, instrument.laser, known(instrument.sensor.pixel_pitch_m)
    scale = optics.magnification(known(lens.focal_length_m), known(lens.working_distance_m))
    fwhm = (known(laser.fwhm_x_m) + known(laser.fwhm_y_m)) / 2
    sigma = float(of_instrument(instrument, [exposure_s]).sigma(exposure_s, p1, p2))
    spread = float(propagation.beam_propagation(exposure_s, p1, p2))
    losses = (known(instrument.material.reflectance), known(lens.f_number), known(lens.filter_transmission))
    area, wavelength = pitch**2, known(laser.wavelength_m)
    to_dn = gain * instrument.sensor.quantum_efficiency
    reflectance, f_number, transmission = losses

    def on_a_pixel(scattering: float) -> float:
        """Eq. 12 under the irradiance at the laser's centre (Eq. 11)."""
        centre = photons.peak_irradiance(known(laser.power_w), photons.beam_radius_of_fwhm(fwhm))
        light = photons.sensor_irradiance(centre, reflectance, scattering, f_number, transmission)
        return to_dn * float(photons.pixel_photons(light, exposure_s, area, wavelength))

    def in_all(scattering: float) -> float:
        """Eq. 14: all photons on the sensor."""
        return to_dn * float(
            photons.total_photons(
                exposure_s, known(laser.power_w), wavelength, reflectance, scattering, f_number, transmission
            )
        )

    in_pixels = float(photons.scattering_factor(exposure_s, spread))
    in_metres = float(photons.scattering_factor(exposure_s, spread * pitch))
    density = 1 / (2 * math.pi * sigma**2)
    printed = float(spot.photon_distribution(0.0, 0.0, sigma, sigma, 0.0, scale))
    return [
        ("Eq. 12 at the laser's centre, without ϱ_s", on_a_pixel(1.0)),
        ("Eq. 12 at the laser's centre, ϱ_s with p_b in pixels", on_a_pixel(in_pixels)),
        ("Eq. 14 spread over the Gaussian of σ_g, without ϱ_s", in_all(1.0) * density),
        ("Eq. 14 spread over the Gaussian of σ_g, ϱ_s with p_b in pixels", in_all(in_pixels) * density),
        ("Eq. 14 spread over the Gaussian of σ_g, ϱ_s with p_b in metres on the sensor", in_all(in_metres) * density),
        ("Eqs. 27–28 as printed (1/M³), ϱ_s with p_b in pixels", on_a_pixel(in_pixels) * printed),
        (
            "Eqs. 27–28 with 1/M² as the change of variables gives, ϱ_s with p_b in pixels",
            on_a_pixel(in_pixels) * printed * scale,
        ),
        ("Eqs. 27–28 as printed (1/M³), without ϱ_s", on_a_pixel(1.0) * printed),
    ]
