"""The baseline: the paper's model before any effect is added, as the dataset contract states it.

One definition serves simulation, likelihood and Fisher information; it accepts complex parameters, so that every
derivative is a complex step through it.
"""

from typing import NamedTuple

import numpy as np

from spotcheck import optics
from spotcheck.instrument import Instrument
from spotcheck.old_engine.model import propagation, spot
from spotcheck.old_engine.model.light_file import read_light
from spotcheck.old_engine.model.light_shape import LightShape

# A step of the derivative by complex step: its square vanishes beside 1 in double precision, so the result is exact.
STEP = 1e-30


class Baseline(NamedTuple):
    """What the instrument fixes: M σ_la/s_px [px], the law of the peak, the top hat, the longest exposure [s], what is
    known of the light's shape beyond the declared one (None: nothing), and whether a pixel reads the mean of the light
    over it, not the light at its centre."""

    laser_px: float
    photon_budget: str
    top_hat: bool
    longest_s: float
    learned: LightShape | None = None
    pixel_integration: bool = False

    def propagation(self, exposure_s, p1, p2):
        """p_b [px] (Eq. 8)."""
        return propagation.beam_propagation(exposure_s, p1, p2)

    def sigma(self, exposure_s, p1, p2):
        """σ_g [px] (Eqs. 7–8)."""
        return propagation.spot_sigma(self.propagation(exposure_s, p1, p2), self.laser_px)

    def relative_peak(self, exposure_s, p1, p2):
        """Peak of the Gaussian as a fraction of that at the longest exposure.

        `spot_area`: (p_b/σ_g)², what Eq. 28 with the ϱ_s of Eq. 13 leaves of the exposure. `linear`: t/σ_g².
        """
        return self._law(exposure_s, p1, p2) / self._law(self.longest_s, p1, p2)

    def _law(self, exposure_s, p1, p2):
        return self.peak_law(exposure_s, self.propagation(exposure_s, p1, p2))

    def peak_law(self, exposure_s, propagation_px):
        """What the peak is proportional to, from p_b [px]: (p_b/σ_g)² or t/σ_g²."""
        sigma = propagation.spot_sigma(propagation_px, self.laser_px)
        if self.photon_budget == "spot_area":
            return (propagation_px / sigma) ** 2
        return exposure_s / sigma**2

    def light(self, x, y, exposure_s, p1, p2, peak, x0, y0):
        """Light [DN] at pixels (x, y): `peak` is the Gaussian's peak [DN] at the longest exposure, before the top
        hat."""
        amplitude = peak * self.relative_peak(exposure_s, p1, p2)
        return self.shape(x, y, amplitude, x0, y0, self.sigma(exposure_s, p1, p2))

    def shape(self, x, y, amplitude, x0, y0, sigma):
        """Light [DN] of one spot of a given peak [DN] and σ_g [px], top hat included: all that `free` needs. It is the
        paper's model, without what is known of the light's shape beyond it, which `chain.light` has."""

        def light(dx, dy):
            own = spot.circular_gaussian(x - dx, y - dy, amplitude, x0, y0, sigma)
            return spot.top_hat(own, amplitude) if self.top_hat else own

        return spot.over_pixel(light) if self.pixel_integration else light(0.0, 0.0)

    def sampled(self, amplitude, sigma):
        """Peak and σ_g [px] of the Gaussian that, at pixel centres, is what pixels read of a spot of these: the same
        where light is sampled; else wider by a pixel's own variance and lower by as much, which misses 2e-3/σ⁴ of the
        peak. Without a top hat."""
        if not self.pixel_integration:
            return amplitude, sigma
        variance = sigma * sigma + spot.PIXEL_VARIANCE
        return amplitude * sigma * sigma / variance, variance**0.5

    def plateau(self, amplitude):
        """Highest light [DN] of a spot whose Gaussian peaks at `amplitude`."""
        return spot.top_hat_level(amplitude) if self.top_hat else amplitude


def of_instrument(instrument: Instrument, exposures_s) -> Baseline:
    """Baseline of an instrument; without optics, laser or pixel pitch the laser's own width counts as 0 px. Raises
    `InputError` where the light's profile cannot be read."""
    lens, sigma = instrument.optics, instrument.laser_sigma_m
    laser_px = 0.0
    if lens.focal_length_m and lens.working_distance_m and sigma and instrument.sensor.pixel_pitch_m:
        scale = optics.magnification(lens.focal_length_m, lens.working_distance_m)
        laser_px = propagation.laser_sigma_px(scale, sigma, instrument.sensor.pixel_pitch_m)
    # Without exposures no law links the frames, whatever the instrument file says.
    budget = instrument.model.photon_budget if len(exposures_s) else "free"
    profile = instrument.light.profile
    learned = None if profile is None else read_light(profile)
    longest = max(exposures_s, default=1.0)
    return Baseline(laser_px, budget, instrument.model.top_hat, longest, learned, lens.pixel_integration)


def jacobian(function, parameters) -> np.ndarray:
    """Derivatives [parameter, ...] of `function(*parameters)` by complex step, exact to rounding."""
    parameters = np.asarray(parameters, dtype=complex)
    columns = []
    for k in range(len(parameters)):
        shifted = parameters.copy()
        shifted[k] += 1j * STEP
        columns.append(np.imag(function(*shifted)) / STEP)
    return np.array(columns)
