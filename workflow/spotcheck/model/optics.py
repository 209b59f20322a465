"""Geometry and diffraction of the set-up: Eqs. 1, 3–6 and 10 of the paper. Pure functions of numbers in SI units."""

import math


def magnification(focal_length_m: float, working_distance_m: float) -> float:
    """Return the magnification M [1], image size over object size (Eq. 1)."""
    # ASSUME: thin lens and a working distance w far beyond the focal length f, so that f/(w − f) ≈ f/w.
    return focal_length_m / working_distance_m


def speckle_grain(magnification: float, wavelength_m: float, f_number: float) -> float:
    """Return the mean diameter d̄_s of a speckle grain on the sensor [m] (Eq. 3)."""
    return 1.2 * (1 + magnification) * wavelength_m * f_number


def depth_of_focus(blur_m: float, f_number: float, magnification: float) -> float:
    """Return the depth of focus [m] for a largest blur `blur_m` on the sensor [m] (Eq. 4)."""
    return blur_m * f_number * (1 + magnification) / magnification**2


def f_number_for_depth(depth_m: float, blur_m: float, magnification: float) -> float:
    """Return the f-number f_a [1] that gives a depth of focus [m] for a blur [m]: Eq. 4 solved for f_a."""
    return depth_m * magnification**2 / (blur_m * (1 + magnification))


def contrast_of_regions(regions: float) -> float:
    """Return the speckle contrast C_s [1] of the sum of a number of independent speckle regions (Eq. 5)."""
    return 1 / math.sqrt(regions)


def fraunhofer_number(slit_m: float, distance_m: float, wavelength_m: float) -> float:
    """Return the Fraunhofer number d_f²/(d_w λ) [1] of a slit d_f at a distance d_w (Eq. 6).

    Far below 1 the slit diffracts as in the far field (Fraunhofer diffraction).
    """
    return slit_m**2 / (distance_m * wavelength_m)


def field_of_view(side_m: float, focal_length_m: float, working_distance_m: float) -> float:
    """Return the field of view in the object plane [m] along a side of the sensor, `side_m` (Section 3.1.1)."""
    return side_m / magnification(focal_length_m, working_distance_m)


def viewing_angle(field_m: float, working_distance_m: float) -> float:
    """Return the full viewing angle δ [rad] of a field of view [m] at a working distance [m] (Section 3.1.1)."""
    return 2 * math.atan(field_m / (2 * working_distance_m))


def sigma_of_fwhm(fwhm: float) -> float:
    """Return the standard deviation of a Gaussian, in the unit of its full width at half maximum (Eq. 10)."""
    return fwhm / (2 * math.sqrt(2 * math.log(2)))
