"""Width of the spot as a function of the exposure (Eqs. 7, 8 and 21). Lengths are in pixels of the sensor.

Exposures, p_b and p1, p2 are numbers, or arrays that broadcast; p1 and p2 may be complex.
"""

import numpy as np


def beam_propagation(exposure_s, p1, p2):
    """Return the beam propagation p_b = p1 ln(t/1 s) + p2 [px] at an exposure t [s], with p1 and p2 in px (Eq. 8).

    The paper labels p1 and p2 as metres; only pixels give its widths, contrasts and bounds.
    """
    # ASSUME: the irradiance E_la,σ of the laser is constant, so that its logarithm is part of p2 (Section 3.3).
    return p1 * np.log(exposure_s) + p2


def spot_sigma(propagation_px, laser_px):
    """Return σ_g [px], the standard deviation of the spot on the sensor (Eqs. 7 and 21).

    It is the beam propagation p_b plus the laser's own width M σ_la/s_px (`laser_px`), along either axis or on average
    over both. Eq. 7 is multiplied by the magnification M, as lengths are in the image plane.
    """
    return propagation_px + laser_px


def laser_sigma_px(magnification: float, laser_sigma_m: float, pixel_pitch_m: float) -> float:
    """Return M σ_la/s_px [px], the laser's own width on the sensor: the second term of Eq. 7 in the image plane.

    M is the magnification [1], σ_la the standard deviation of the laser beam [m], and s_px the pixel pitch [m].
    """
    return magnification * laser_sigma_m / pixel_pitch_m
