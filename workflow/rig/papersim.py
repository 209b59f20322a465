"""The paper's simulated spot, as far as the comparison numbers need it (Section 5, Eqs. 7, 8, 13, 39, 40).

A second, independent writing of the published model: the search scores the rig's frames against it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rig.material import FWHM_PER_SIGMA
from rig.measure import crop_at_maximum
from rig.settings import Settings

TOP_HAT = math.exp(-0.25)
_CANVAS_PX = 340  # room for a crop centred on a maximum anywhere on the plateau


@dataclass(frozen=True)
class Law:
    """p1, p2 [px] of the width p1 ln(t / 1 s) + p2, the laser's own width on the chip [px], the peak's scale [DN]."""

    p1: float
    p2: float
    laser_sigma_px: float
    scale_dn: float

    def sigma_px(self, exposure_s: float) -> float:
        """σ_g of the Gaussian under the top hat [px]."""
        return self.p1 * math.log(exposure_s) + self.p2 + self.laser_sigma_px

    def peak_dn(self, exposure_s: float) -> float:
        """Peak of the Gaussian under the top hat [DN], ∝ (p_b/σ_g)²."""
        sigma = self.sigma_px(exposure_s)
        return self.scale_dn * ((sigma - self.laser_sigma_px) / sigma) ** 2


def laser_sigma_px(settings: Settings) -> float:
    """M σ_la / s_px with σ_la from the mean of both FWHM [px]."""
    laser, optics = settings.laser, settings.optics
    sigma_m = 0.5 * (laser.fwhm_x_m + laser.fwhm_y_m) / FWHM_PER_SIGMA
    return optics.focal_length_m / optics.working_distance_m * sigma_m / settings.sensor.pixel_pitch_m


def simulate(settings: Settings, law: Law, exposure_s: float, rng: np.random.Generator) -> np.ndarray:
    """One simulated crop [DN] with the data sheet's noise, cut at its own maximum."""
    sensor = settings.sensor
    axis = np.arange(_CANVAS_PX) - (_CANVAS_PX - 1) // 2
    radius2 = axis**2 + axis[:, None] ** 2
    peak = law.peak_dn(exposure_s)
    signal = np.minimum(peak * np.exp(-0.5 * radius2 / law.sigma_px(exposure_s) ** 2), TOP_HAT * peak)
    mean_e = signal / sensor.gain_dn_per_e + sensor.dark_current_e_per_s * exposure_s
    electrons = rng.poisson(mean_e) + sensor.read_noise_e * rng.standard_normal(mean_e.shape)
    frame = np.clip(np.rint(sensor.gain_dn_per_e * electrons), 0, 2**sensor.bit_depth - 1)
    return crop_at_maximum(frame)


def calibrated_scale(
    settings: Settings, law: Law, exposures_s: list[float], maximum_dn: float, rng: np.random.Generator
) -> Law:
    """The law with the scale at which the crops' maxima at `exposures_s` have the mean `maximum_dn`."""
    for _ in range(3):  # the noise adds to the maximum almost independently of the scale
        draws = [simulate(settings, law, t, rng).max() for t in exposures_s for _ in range(4)]
        noise_free = np.mean([TOP_HAT * law.peak_dn(t) for t in exposures_s])
        excess = np.mean(draws) - noise_free
        scale = law.scale_dn * (maximum_dn - excess) / noise_free
        law = Law(law.p1, law.p2, law.laser_sigma_px, scale)
    return law
