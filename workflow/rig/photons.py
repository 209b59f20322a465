"""The photon budget: from the laser's power to the photons that reach the chip in one exposure."""

from __future__ import annotations

from rig.settings import Settings

PLANCK_J_S = 6.626_070_15e-34
LIGHT_SPEED_M_PER_S = 299_792_458.0


def photon_energy_j(wavelength_m: float) -> float:
    """Energy of one photon, hc/λ [J]."""
    return PLANCK_J_S * LIGHT_SPEED_M_PER_S / wavelength_m


def reflected_photons(settings: Settings, exposure_s: float) -> float:
    """Mean photons [1] of the whole spot on the chip at an average site: linear in the exposure.

    P_L t λ/(hc) · ϱ_m · ϱ_f as in Table 3, times the part of the reflected light that the lens collects and the lens's
    own transmission.
    """
    optics, laser, material = settings.optics, settings.laser, settings.material
    emitted = laser.power_w * exposure_s / photon_energy_j(laser.wavelength_m)
    # ASSUME: fibres reflect like mirrors across themselves, so that the lens gets `specular_gain` times the light of a
    # Lambertian surface. The paper's factor 1/f_a² is a gain of (2 d_w/f)² = 99.
    collected = material.specular_gain * lambertian_collection(settings)
    through_glass = optics.filter_transmission * optics.lens_transmission
    return emitted * material.reflectance * collected * through_glass


def lambertian_collection(settings: Settings) -> float:
    """Part [1] of the light of a Lambertian surface that the lens collects, (f/(2 f_a d_w))².

    A pupil of radius r = f/(2 f_a) at a distance d_w ≫ r takes the part r²/d_w² of cos-distributed light.
    """
    optics = settings.optics
    return (optics.focal_length_m / (2.0 * optics.f_number * optics.working_distance_m)) ** 2
