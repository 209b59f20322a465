"""The paper's numbers that follow from the inputs alone; M is rounded to 0.2 where the paper does so."""

import math

from spotcheck.model import optics, spot
from spotcheck.paper.results import Results
from spotcheck.sensor import ROUNDING_VARIANCE

PRINTED_MAGNIFICATION = 0.2
FILAMENT_GAP_M = 5.2e-6  # Section 3.1.1
PRINTED_SENSOR_WIDTH_MM = 22.528  # Section 3.1.1


def magnification(results: Results) -> float:
    """Return M [1] (Eq. 1)."""
    return optics.magnification(
        results.require_key("optics.focal_length_m"), results.require_key("optics.working_distance_m")
    )


def sensor_width(results: Results) -> float:
    """Return the width of the sensor [mm]."""
    return 1e3 * float(results.open_file("frames")["columns"]) * results.require_key("sensor.pixel_pitch_m")


def sensor_height(results: Results) -> float:
    """Return the height of the sensor [mm]."""
    return 1e3 * float(results.open_file("frames")["rows"]) * results.require_key("sensor.pixel_pitch_m")


def _field_mm(results: Results, side_mm: float) -> float:
    """Return the field of view along a side of the sensor [mm]."""
    return optics.field_of_view(
        side_mm, results.require_key("optics.focal_length_m"), results.require_key("optics.working_distance_m")
    )


def field_height(results: Results) -> float:
    """Return the field of view along the height [mm]."""
    return _field_mm(results, sensor_height(results))


def field_width(results: Results) -> float:
    """Return the field of view along the width [mm]."""
    return _field_mm(results, sensor_width(results))


def _viewing_angle(results: Results, field_mm: float) -> float:
    """Return the viewing angle of a field of view [degree]."""
    distance_mm = 1e3 * results.require_key("optics.working_distance_m")
    return math.degrees(optics.viewing_angle(field_mm, distance_mm))


def viewing_angle_height(results: Results) -> float:
    """Return the viewing angle along the height [degree]."""
    return _viewing_angle(results, field_height(results))


def viewing_angle_width(results: Results) -> float:
    """Return the viewing angle along the width [degree]."""
    return _viewing_angle(results, field_width(results))


def _grain_um(results: Results, f_number: float) -> float:
    """Return the speckle grain at an f-number [µm]."""
    return 1e6 * optics.speckle_grain(PRINTED_MAGNIFICATION, results.require_key("laser.wavelength_m"), f_number)


def grain_per_f_number(results: Results) -> float:
    """Return the speckle grain over the f-number [µm] (Eq. 3)."""
    return _grain_um(results, 1.0)


def f_number_for_grain_of_one_pixel(results: Results) -> float:
    """Return the f-number at which the grain is one pixel [1]."""
    return 1e6 * results.require_key("sensor.pixel_pitch_m") / grain_per_f_number(results)


def _f_number_for_depth(results: Results, depth_m: float) -> float:
    """Return the f-number of a depth of focus with a blur of one pixel [1]."""
    return optics.f_number_for_depth(depth_m, results.require_key("sensor.pixel_pitch_m"), PRINTED_MAGNIFICATION)


def f_number_for_shallow_depth(results: Results) -> float:
    """Return the f-number of a depth of focus of 1.5 mm [1] (Eq. 4)."""
    return _f_number_for_depth(results, 1.5e-3)


def f_number_for_deep_depth(results: Results) -> float:
    """Return the f-number of a depth of focus of 2 mm [1] (Eq. 4)."""
    return _f_number_for_depth(results, 2e-3)


def grain(results: Results) -> float:
    """Return the speckle grain at the f-number of the set-up [µm] (Eq. 3)."""
    return _grain_um(results, results.require_key("optics.f_number"))


def grain_in_pixels(results: Results) -> float:
    """Return the speckle grain [px]."""
    return 1e-6 * grain(results) / results.require_key("sensor.pixel_pitch_m")


def contrast_increase(results: Results) -> float:
    """Return the increase of the speckle contrast against a grain of one pixel [%] (Eq. 5, grains along one axis)."""
    return 100 * (optics.contrast_of_regions(1 / grain_in_pixels(results)) - 1)


def fraunhofer(results: Results) -> float:
    """Return d_f²/(d_w λ) [1] (Eq. 6)."""
    return optics.fraunhofer_number(
        FILAMENT_GAP_M, results.require_key("optics.working_distance_m"), results.require_key("laser.wavelength_m")
    )


def rounding_variance(results: Results) -> float:
    """Return the variance of the rounding [DN²]."""
    return ROUNDING_VARIANCE


def top_hat_level(results: Results) -> float:
    """Return the level of the plateau over that of the peak [1] (Eq. 40)."""
    return float(spot.top_hat_level(1.0))


def fill_factor(results: Results) -> float:
    """Return the width of a pixel over the width of the sensor per pixel [%]."""
    pitch_mm = 1e3 * results.require_key("sensor.pixel_pitch_m")
    return 100 * pitch_mm / (PRINTED_SENSOR_WIDTH_MM / float(results.open_file("frames")["columns"]))


def exposure_step(results: Results) -> float:
    """Return the mean difference of neighbouring exposures [µs]."""
    return 1e6 * float(results.metrics["exposure"].diff("exposure").mean())


def crop_side(results: Results) -> float:
    """Return the side of the crops [px]."""
    return float(results.open_file("crops").sizes["x"])


def read_noise_table(results: Results) -> float:
    """Return the read noise that the simulation uses [e-]."""
    return float(results.open_file("sensor")["read_noise_e"])


def images_per_exposure(results: Results) -> float:
    """Return the number of frames at each exposure [1]."""
    return float(results.measured.sizes["angle"] * results.measured.sizes["repeat"])
