"""The spot's shape on the sensor. The one place where coordinates and widths get their meaning:

x is the column, to the right; y the row, downwards; pixel centres lie at integers; light is sampled at pixel centres,
or is the mean over each pixel where the instrument says so (the difference is a widening of 1/(24 σ) px). An amplitude
is the peak of the light itself. The orientation is the angle of the long axis from +x towards
+y. All functions accept complex arguments: derivatives come by complex step.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

# Top hat (Eq. 40): light above exp(−2 r_TH²) of the peak is cut, with r_TH = √(1/8) in units of the beam radius.
TOP_HAT_RADIUS = math.sqrt(1 / 8)
TOP_HAT_LEVEL = math.exp(-2 * TOP_HAT_RADIUS**2)

# Three points of Gauss and Legendre across a pixel [px] and their weights, exact to the fifth power. Of the mean of a
# Gaussian of σ [px] over a pixel, 1.5e-5/σ⁶ of the peak is missed; shapes with edges, such as a top hat, are stepped.
ACROSS = ((-math.sqrt(0.15), 5 / 18), (0.0, 8 / 18), (math.sqrt(0.15), 5 / 18))
PIXEL = tuple((dx, dy, along * across) for dx, along in ACROSS for dy, across in ACROSS)
# Variance that a pixel's own width adds to a spot's along each axis [px²].
PIXEL_VARIANCE = 1 / 12


def over_pixel(light: Callable[[Any, Any], Any]):
    """Mean over a pixel of light that is a function of how far it is displaced to the right and down [px]."""
    return sum(weight * light(dx, dy) for dx, dy, weight in PIXEL)


def circular_gaussian(x, y, amplitude, x0, y0, sigma):
    """Light at (x, y) of a circular Gaussian, in the unit of its peak `amplitude`; lengths in px.

    The exponential is taken along x and y apart: with x a row and y a column vector it costs one product a pixel.
    """
    two_var = 2 * sigma * sigma
    return amplitude * np.exp(-(x - x0) * (x - x0) / two_var) * np.exp(-(y - y0) * (y - y0) / two_var)


def elliptical_gaussian(x, y, amplitude, x0, y0, sigma_major, sigma_minor, orientation, offset=0.0):
    """Light at (x, y) of an elliptical Gaussian plus offset; widths in px, orientation in rad."""
    cos, sin = np.cos(orientation), np.sin(orientation)
    along = ((x - x0) * cos + (y - y0) * sin) / sigma_major
    across = (-(x - x0) * sin + (y - y0) * cos) / sigma_minor
    return amplitude * np.exp(-(along * along + across * across) / 2) + offset


def point_spread(x, y, sigma_x, sigma_y, correlation):
    """q(x, y) [1/unit²], the normalised PSF of Eq. 20 with widths along x and y and their correlation ρ [1]."""
    rest = 1 - correlation**2
    u, v = x / sigma_x, y / sigma_y
    norm = 2 * np.pi * sigma_x * sigma_y * np.sqrt(rest)
    return np.exp(-(u * u + v * v - 2 * correlation * u * v) / (2 * rest)) / norm


def photon_distribution(x, y, sigma_x, sigma_y, correlation, magnification: float):
    """f_θ of the centred spot as Eq. 22 prints it: q(x, y)/M³.

    The change of variables gives q(x/M, y/M)/M² instead; the third power is the paper's and makes the absolute level
    meaningless. It cancels in every ratio, and the level is calibrated as one constant.
    """
    return point_spread(x, y, sigma_x, sigma_y, correlation) / magnification**3


def pixel_mean_photons(x, y, peak_photons, sigma_x, sigma_y, correlation, magnification: float):
    """µ_θ,k [photons] as Eq. 27 prints it: µ_p,max f_θ at the pixel's centre, not integrated (Eq. 26)."""
    # ASSUME: the light is constant during the exposure, which turns the time integral of Eq. 26 into a factor.
    return peak_photons * photon_distribution(x, y, sigma_x, sigma_y, correlation, magnification)


def circular_mean_photons(x, y, peak_photons, sigma, magnification: float):
    """µ_θ,k [photons] of the circular spot (Eq. 28): Eq. 27 with σ_g,x = σ_g,y and ρ = 0."""
    return circular_gaussian(x, y, peak_photons / (2 * np.pi * magnification**3 * sigma**2), 0.0, 0.0, sigma)


def top_hat(light, amplitude):
    """Light cut to `top_hat_level` (Eq. 39)."""
    level = top_hat_level(amplitude)
    return np.where(np.real(light) > np.real(level), level, light)


def top_hat_level(amplitude):
    """µ_y,max,TH, the plateau under a peak `amplitude` (Eq. 40): exp(−1/4) of it."""
    return TOP_HAT_LEVEL * amplitude
