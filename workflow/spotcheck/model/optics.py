"""Geometry and diffraction of the set-up: Eqs. 1, 3–6 and 10 of the paper. Pure functions in SI units."""

import math


def magnification(focal_length_m: float, working_distance_m: float) -> float:
    """M [1], image size over object size (Eq. 1).

    # ASSUME: thin lens and a working distance far beyond the focal length, so that f/(w − f) ≈ f/w.
    """
    return focal_length_m / working_distance_m


def speckle_grain(magnification: float, wavelength_m: float, f_number: float) -> float:
    """Mean speckle grain d̄_s on the sensor [m] (Eq. 3)."""
    return 1.2 * (1 + magnification) * wavelength_m * f_number


def depth_of_focus(blur_m: float, f_number: float, magnification: float) -> float:
    """Depth of focus [m] for a blur `u` on the sensor [m] (Eq. 4)."""
    return blur_m * f_number * (1 + magnification) / magnification**2


def f_number_for_depth(depth_m: float, blur_m: float, magnification: float) -> float:
    """Aperture f-number that gives a depth of focus [m]: Eq. 4 solved for f_a."""
    return depth_m * magnification**2 / (blur_m * (1 + magnification))


def contrast_of_regions(regions: float) -> float:
    """Speckle contrast C_s [1] of the sum over a number of independent speckle regions (Eq. 5)."""
    return 1 / math.sqrt(regions)


def fraunhofer_number(slit_m: float, distance_m: float, wavelength_m: float) -> float:
    """d_f²/(d_w λ) [1]; far below 1 means Fraunhofer diffraction (Eq. 6)."""
    return slit_m**2 / (distance_m * wavelength_m)


def field_of_view(side_m: float, focal_length_m: float, working_distance_m: float) -> float:
    """Field of view [m] along a side of the sensor [m] (Section 3.1.1)."""
    return side_m / magnification(focal_length_m, working_distance_m)


def viewing_angle(field_m: float, working_distance_m: float) -> float:
    """Full viewing angle δ [rad] of a field of view [m] (Section 3.1.1)."""
    return 2 * math.atan(field_m / (2 * working_distance_m))


def sigma_of_fwhm(fwhm: float) -> float:
    """Standard deviation of a Gaussian, in the unit of its full width at half maximum (Eq. 10)."""
    return fwhm / (2 * math.sqrt(2 * math.log(2)))
