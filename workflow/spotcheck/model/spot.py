"""The spot's shape on the sensor, with the meaning of coordinates and widths for the whole package.

x is the column, to the right; y is the row, downwards. Pixel centres lie at integers. Light is sampled at the centres
of pixels unless the instrument file asks for its mean over each pixel, which widens the spot by about 1/(24 σ) px. An
amplitude is the peak of the light itself. The orientation is the angle of the long axis from +x towards +y. All
functions accept complex arguments, since derivatives are taken by complex step. x and y are arrays that broadcast, such
as [1, column] and [row, 1]. The top hat cuts the spot at a level, which leaves a plateau.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

# Top hat (Eq. 40): light above exp(−2 r_TH²) of the peak is cut, with r_TH = √(1/8) in units of the beam radius.
TOP_HAT_RADIUS = math.sqrt(1 / 8)
TOP_HAT_LEVEL = math.exp(-2 * TOP_HAT_RADIUS**2)

# Gauss–Legendre quadrature across a pixel: three points [px] and their weights, exact to the fifth power. The mean of a
# Gaussian of σ [px] over a pixel has an error of 1.5e-5/σ⁶ of the peak. At an edge, such as that of a top hat, the mean
# changes in steps of the weights.
ACROSS = ((-math.sqrt(0.15), 5 / 18), (0.0, 8 / 18), (math.sqrt(0.15), 5 / 18))
# The same over the area of a pixel: dx, dy [px], weight.
PIXEL = tuple((dx, dy, along * across) for dx, along in ACROSS for dy, across in ACROSS)
# Variance that a pixel's own width adds to a spot's along each axis [px²].
PIXEL_VARIANCE = 1 / 12


def average_over_pixel(light: Callable[[Any, Any], Any]):
    """Return the mean of light(dx, dy) over the area of a pixel; dx and dy are offsets from its centre [px]."""
    return sum(weight * light(dx, dy) for dx, dy, weight in PIXEL)


def circular_gaussian(x, y, amplitude, x0, y0, sigma):
    """Return the light at (x, y) of a circular Gaussian, in the unit of its peak `amplitude`.

    `x0`, `y0` is its centre and `sigma` its standard deviation; all lengths are in px.
    """
    # The exponentials along x and y are separate: with a row and a column vector, each pixel costs one product.
    two_var = 2 * sigma * sigma
    return amplitude * np.exp(-(x - x0) * (x - x0) / two_var) * np.exp(-(y - y0) * (y - y0) / two_var)


def elliptical_gaussian(x, y, amplitude, x0, y0, sigma_major, sigma_minor, orientation, offset=0.0):
    """Return the light at (x, y) of an elliptical Gaussian plus `offset`, in the unit of its peak `amplitude`.

    The centre is (x0, y0) [px]. `sigma_major` and `sigma_minor` are the standard deviations along the long and the
    short axis [px], and `orientation` is the angle of the long axis [rad].
    """
    cos, sin = np.cos(orientation), np.sin(orientation)
    along = ((x - x0) * cos + (y - y0) * sin) / sigma_major
    across = (-(x - x0) * sin + (y - y0) * cos) / sigma_minor
    return amplitude * np.exp(-(along * along + across * across) / 2) + offset


def point_spread(x, y, sigma_x, sigma_y, correlation):
    """Return q(x, y), the normalized point-spread function of Eq. 20, in 1/(unit of the widths)².

    x and y are relative to the centre. The widths are standard deviations along x and y, in the unit of x and y.
    `correlation` is ρ [1], 0 for axes along x and y.
    """
    uncorrelated = 1 - correlation**2
    u, v = x / sigma_x, y / sigma_y
    norm = 2 * np.pi * sigma_x * sigma_y * np.sqrt(uncorrelated)
    return np.exp(-(u * u + v * v - 2 * correlation * u * v) / (2 * uncorrelated)) / norm


def photon_distribution(x, y, sigma_x, sigma_y, correlation, magnification: float):
    """Return f_θ = q(x, y)/M³ of the centred spot as Eq. 22 prints it, in 1/(unit of the widths)².

    q is the point-spread function `point_spread`, whose arguments these are, and M the magnification [1]. The change of
    variables gives q(x/M, y/M)/M² instead. With the paper's third power the absolute level has no meaning. It cancels
    in every ratio, and the level is calibrated as one constant.
    """
    return point_spread(x, y, sigma_x, sigma_y, correlation) / magnification**3


def pixel_mean_photons(x, y, peak_photons, sigma_x, sigma_y, correlation, magnification: float):
    """Return µ_θ,k [photons], the mean on a pixel k at (x, y), as Eq. 27 prints it.

    It is µ_p,max f_θ: `peak_photons` times `photon_distribution` at the centre of the pixel, not the integral over it
    of Eq. 26.
    """
    # ASSUME: the light is constant during the exposure, which turns the time integral of Eq. 26 into a factor.
    return peak_photons * photon_distribution(x, y, sigma_x, sigma_y, correlation, magnification)


def circular_mean_photons(x, y, peak_photons, sigma, magnification: float):
    """Return µ_θ,k [photons] of a circular spot (Eq. 28): Eq. 27 with σ_g,x = σ_g,y = `sigma` and ρ = 0."""
    return circular_gaussian(x, y, peak_photons / (2 * np.pi * magnification**3 * sigma**2), 0.0, 0.0, sigma)


def top_hat(light, amplitude):
    """Return `light` limited to the level of the top hat (Eq. 39); `amplitude` is the Gaussian's peak in its unit."""
    # Complex light is compared by its real part, so that complex steps follow the branch.
    level = top_hat_level(amplitude)
    return np.where(np.real(light) > np.real(level), level, light)


def top_hat_level(amplitude):
    """Return µ_y,max,TH = exp(−1/4) `amplitude`, the plateau of a Gaussian with this peak, in its unit (Eq. 40)."""
    return TOP_HAT_LEVEL * amplitude
