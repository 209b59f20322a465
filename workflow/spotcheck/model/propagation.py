"""How the spot widens with exposure (Eqs. 7, 8 and 21). Lengths in pixels of the sensor."""

import numpy as np


def beam_propagation(exposure_s, p1, p2):
    """Beam propagation parameter p_b [px] at an exposure [s] (Eq. 8): p1 ln(t / 1 s) + p2, both in px.

    The paper labels p1 and p2 as metres; only pixels give its widths, contrasts and bounds.
    """
    # ASSUME: the irradiance of the laser is constant, so that ln E_la,σ is part of p2 (Section 3.3).
    return p1 * np.log(exposure_s) + p2


def spot_sigma(propagation_px, laser_px):
    """σ_g [px], the spot's standard deviation on the sensor (Eqs. 7 and 21).

    `laser_px` is M σ_la/s_px. Read in the image plane: Eq. 7 times M. Holds for either direction, or their mean.
    """
    return propagation_px + laser_px


def laser_sigma_px(magnification: float, laser_sigma_m: float, pixel_pitch_m: float) -> float:
    """M σ_la/s_px [px], the laser's own width as the sensor sees it (second term of Eq. 7 in the image plane)."""
    return magnification * laser_sigma_m / pixel_pitch_m
