"""The baseline: the paper's model before any effect is added, as the dataset contract states it.

Without a learned shape its functions accept complex parameters, so that derivatives are complex steps through them.
"""

from dataclasses import dataclass, replace

import numpy as np

from spotcheck.dataset.instrument import Instrument
from spotcheck.model import optics, propagation, spot
from spotcheck.model.light_shape import LightShape, read_light

# A step of the derivative by complex step: its square vanishes beside 1 in double precision, so the result is exact.
STEP = 1e-30


@dataclass(frozen=True)
class Baseline:
    """What the instrument fixes."""

    laser_px: float  # M σ_la/s_px, the laser's own width on the sensor [px]
    photon_budget: str  # law of the peak: "spot_area", "linear", or "free" for none
    top_hat: bool  # whether the light is cut at exp(−1/4) of its peak
    longest_s: float  # longest exposure of the dataset [s]
    learned: LightShape | None = None  # learned shape of the light beside the declared one
    pixel_integration: bool = False  # whether a pixel reads the mean of the light over it, not the light at its centre

    def propagation(self, exposure_s, p1, p2):
        """Return p_b [px] (Eq. 8)."""
        return propagation.beam_propagation(exposure_s, p1, p2)

    def sigma(self, exposure_s, p1, p2):
        """Return σ_g [px] (Eqs. 7–8)."""
        return propagation.spot_sigma(self.propagation(exposure_s, p1, p2), self.laser_px)

    def peak_law(self, exposure_s, propagation_px):
        """Return what the peak is proportional to, from p_b [px].

        `spot_area`: (p_b/σ_g)², what Eq. 28 with the ϱ_s of Eq. 13 leaves of the exposure. `linear`: t/σ_g².
        """
        sigma = propagation.spot_sigma(propagation_px, self.laser_px)
        if self.photon_budget == "spot_area":
            return (propagation_px / sigma) ** 2
        return exposure_s / sigma**2

    def relative_peak(self, exposure_s, p1, p2):
        """Return the peak of the Gaussian as a fraction of that at the longest exposure."""
        here, longest = (self.peak_law(t, self.propagation(t, p1, p2)) for t in (exposure_s, self.longest_s))
        return here / longest

    def spot(self, dx, dy, peak_dn, sigma_px):
        """Return the light [DN] of a spot at displacements from its centre [px], sampled there."""
        light = spot.circular_gaussian(dx, dy, peak_dn, 0.0, 0.0, sigma_px)
        return self.finish(light, dx, dy, peak_dn, sigma_px)

    def finish(self, light, dx, dy, peak_dn, sigma_px):
        """Return light [DN] of a profile with top hat and learned shape."""
        if self.top_hat:
            light = spot.top_hat(light, peak_dn)
        if self.learned is None:
            return light
        return light + peak_dn * self.learned(dx / sigma_px, dy / sigma_px)

    def declared_light(self, x, y, peak_dn, x0, y0, sigma_px):
        """Return what pixels at x, y [px] receive [DN] of a spot of the declared shape."""
        declared = replace(self, learned=None)
        if not self.pixel_integration:
            return declared.spot(x - x0, y - y0, peak_dn, sigma_px)
        return spot.over_pixel(lambda dx, dy: declared.spot(x - dx - x0, y - dy - y0, peak_dn, sigma_px))

    def sampled(self, peak_dn, sigma_px):
        """Return peak and σ_g [px] of the Gaussian that, at pixel centres, is what pixels read of a spot of these.

        The same where light is sampled. Else it is wider by the variance of a pixel and lower by as much, which misses
        2e-3/σ⁴ of the peak. Without a top hat.
        """
        if not self.pixel_integration:
            return peak_dn, sigma_px
        variance = sigma_px * sigma_px + spot.PIXEL_VARIANCE
        return peak_dn * sigma_px * sigma_px / variance, variance**0.5

    def plateau(self, peak_dn):
        """Return the highest light [DN] of a spot whose Gaussian has a peak [DN]."""
        return spot.top_hat_level(peak_dn) if self.top_hat else peak_dn


def of_instrument(instrument: Instrument, exposures_s) -> Baseline:
    """Return the baseline of an instrument; without optics, laser or pixel pitch the laser's own width is 0 px.

    Raises `InputError` if the file of the light's profile cannot be read.
    """
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
    """Return the derivatives [parameter, ...] of `function(*parameters)` by complex step, exact to rounding."""
    parameters = np.asarray(parameters, dtype=complex)
    columns = []
    for k in range(len(parameters)):
        shifted = parameters.copy()
        shifted[k] += 1j * STEP
        columns.append(np.imag(function(*shifted)) / STEP)
    return np.array(columns)
