"""The baseline: the paper's model before any effect is added, as the dataset contract states it.

The width of the spot is σ_g = p_b + M σ_la/s_px with the beam propagation p_b = p1 ln(t/1 s) + p2 (Eqs. 7 and 8). Its
light is the declared shape, a circular Gaussian that a top hat may cut, plus a learned shape if there is one. Without a
learned shape all functions accept complex parameters, so that derivatives can be taken by complex step.
"""

from dataclasses import dataclass, replace

import numpy as np

from spotcheck.dataset.instrument import Instrument
from spotcheck.model import optics, propagation, spot
from spotcheck.model.light_shape import LightShape, read_light

# Step of derivatives by complex step. Its square vanishes beside 1 in double precision, so the result is exact.
STEP = 1e-30


@dataclass(frozen=True)
class Baseline:
    """The part of the model that the instrument file fixes. Methods take numbers, or arrays that broadcast."""

    laser_px: float  # M σ_la/s_px, the laser's own width on the sensor [px]
    photon_budget: str  # law of the peak: "spot_area" or "linear" (`peak_law`), "free" for none
    top_hat: bool  # whether the declared shape is cut at exp(−1/4) of its peak
    longest_s: float  # longest exposure of the dataset [s]
    learned: LightShape | None = None  # learned shape, which is added to the declared one; None for none
    pixel_integration: bool = False  # whether a pixel reads the mean of the light over its area, not that at its centre

    def propagation(self, exposure_s, p1, p2):
        """Return the beam propagation p_b [px] at an exposure [s], with p1 and p2 in px (Eq. 8)."""
        return propagation.beam_propagation(exposure_s, p1, p2)

    def sigma(self, exposure_s, p1, p2):
        """Return the width σ_g of the spot [px] at an exposure [s], with p1 and p2 in px (Eqs. 7–8)."""
        return propagation.spot_sigma(self.propagation(exposure_s, p1, p2), self.laser_px)

    def peak_law(self, exposure_s, propagation_px):
        """Return a factor to which the peak is proportional, from the exposure t [s] and p_b [px].

        It is (p_b/σ_g)² [1] for the photon budget "spot_area": the scattering factor p_b²/t (Eq. 13) cancels t in Eq.
        28. For "linear" it is t/σ_g² [s/px²]: light proportional to the exposure, spread over the area of the spot. A
        baseline with the budget "free" has no such law.
        """
        sigma = propagation.spot_sigma(propagation_px, self.laser_px)
        if self.photon_budget == "spot_area":
            return (propagation_px / sigma) ** 2
        return exposure_s / sigma**2

    def relative_peak(self, exposure_s, p1, p2):
        """Return the peak of the Gaussian at an exposure [s] divided by that at the longest exposure [1]."""
        # The unit of the factor cancels.
        factor, longest_factor = (self.peak_law(t, self.propagation(t, p1, p2)) for t in (exposure_s, self.longest_s))
        return factor / longest_factor

    def spot(self, dx, dy, peak_dn, sigma_px):
        """Return the light [DN] of a spot at displacements dx, dy from its centre [px].

        `peak_dn` is the peak of the Gaussian before the top hat [DN], `sigma_px` its width σ_g [px].
        """
        light = spot.circular_gaussian(dx, dy, peak_dn, 0.0, 0.0, sigma_px)
        return self.add_top_hat_and_shape(light, dx, dy, peak_dn, sigma_px)

    def add_top_hat_and_shape(self, light, dx, dy, peak_dn, sigma_px):
        """Return the light [DN] of a profile after the top hat, if any, has cut it and a learned shape is added.

        `light` is the profile before both [DN] at displacements dx, dy [px] from the centre of the spot. `peak_dn` [DN]
        is its peak, to which the learned shape is relative, and `sigma_px` the width σ_g [px].
        """
        if self.top_hat:
            light = spot.top_hat(light, peak_dn)
        if self.learned is None:
            return light
        return light + peak_dn * self.learned(dx / sigma_px, dy / sigma_px)

    def declared_light(self, x, y, peak_dn, x0, y0, sigma_px):
        """Return the light [DN] that pixels at x, y [px] receive of a spot of the declared shape at x0, y0 [px].

        It is the light at the centre of a pixel, or its mean over the pixel if pixels integrate. `peak_dn` is the peak
        of the Gaussian before the top hat [DN], `sigma_px` its width σ_g [px].
        """
        declared = replace(self, learned=None)
        if not self.pixel_integration:
            return declared.spot(x - x0, y - y0, peak_dn, sigma_px)
        return spot.average_over_pixel(
            lambda offset_x, offset_y: declared.spot(x - offset_x - x0, y - offset_y - y0, peak_dn, sigma_px)
        )

    def effective_gaussian(self, peak_dn, sigma_px):
        """Return peak [DN] and width [px] of the Gaussian whose values at pixel centres are the light of the pixels.

        `peak_dn` and `sigma_px` are those of the spot's own Gaussian, and are returned if light is sampled at pixel
        centres. If pixels average over their area, the variance of a pixel is added to σ_g² and the sum of the light is
        kept. This approximation has an error of 2e-3/σ_g⁴ of the peak, with σ_g in px. The top hat is ignored.
        """
        if not self.pixel_integration:
            return peak_dn, sigma_px
        variance = sigma_px * sigma_px + spot.PIXEL_VARIANCE
        return peak_dn * sigma_px * sigma_px / variance, variance**0.5

    def plateau(self, peak_dn):
        """Return the highest light [DN] of a spot whose Gaussian has the peak `peak_dn` [DN].

        It is the level to which the top hat cuts the Gaussian, or the peak without a top hat.
        """
        return spot.top_hat_level(peak_dn) if self.top_hat else peak_dn


def build_baseline(instrument: Instrument, exposures_s) -> Baseline:
    """Return the baseline of an instrument file, for a dataset with these exposures [s], in any order.

    Without optics, laser or pixel pitch the laser's own width is 0 px. Raises `InputError` if the file of the learned
    shape, `light.profile`, cannot be read.
    """
    lens, laser_sigma_m = instrument.optics, instrument.laser_sigma_m
    laser_px = 0.0
    if lens.focal_length_m and lens.working_distance_m and laser_sigma_m and instrument.sensor.pixel_pitch_m:
        magnification = optics.magnification(lens.focal_length_m, lens.working_distance_m)
        laser_px = propagation.laser_sigma_px(magnification, laser_sigma_m, instrument.sensor.pixel_pitch_m)
    # Without exposures no law of the exposure links the frames, whatever the instrument file says.
    budget = instrument.model.photon_budget if len(exposures_s) else "free"
    profile = instrument.light.profile
    learned = None if profile is None else read_light(profile)
    longest_s = max(exposures_s, default=1.0)
    return Baseline(laser_px, budget, instrument.model.top_hat, longest_s, learned, lens.pixel_integration)


def jacobian(function, parameters) -> np.ndarray:
    """Return the derivatives [parameter, ...] of `function(*parameters)` by complex step, exact to rounding.

    The function must accept complex numbers; `...` is the shape of its result. `parameters` is a sequence of numbers.
    """
    # Row k has a step in parameter k.
    stepped = np.asarray(parameters, dtype=complex) + 1j * STEP * np.eye(len(parameters))
    return np.array([np.imag(function(*row)) / STEP for row in stepped])
