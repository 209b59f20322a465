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

    P_L t λ/(hc) · ϱ_m · 1/f_a² · ϱ_f as in Table 3, times two factors that Table 3 leaves out.
    """
    optics, laser, material = settings.optics, settings.laser, settings.material
    emitted = laser.power_w * exposure_s / photon_energy_j(laser.wavelength_m)
    # ASSUME: the aperture passes 1/f_a² of the light that the material sends back, as the paper has it; that the
    # fibres send more or less of it into the lens than an even spread is `directional_factor`.
    through_pupil = 1.0 / optics.f_number**2
    through_glass = optics.filter_transmission * optics.lens_transmission
    return emitted * material.reflectance * material.directional_factor * through_pupil * through_glass
