"""The paper's numbers that follow from the inputs alone.

`check_numbers` calls each public function by its name, which is the `id` of an entry in published.yaml. Keys are those
of instrument.yaml in SI units. frames.nc has the number of rows and columns of a frame.
"""

import math

from spotcheck.model import optics, spot
from spotcheck.paper.results import Results
from spotcheck.sensor import ROUNDING_VARIANCE

# Magnification M [1] to the one digit that the paper prints and computes with in Section 3.1.2.
PRINTED_MAGNIFICATION = 0.2
# Gap d_f between neighbouring filaments of the sample [m] (Section 3.1.1).
FILAMENT_GAP_M = 5.2e-6
# Width of the sensor as printed [mm] (Section 3.1.1).
PRINTED_SENSOR_WIDTH_MM = 22.528


def magnification(results: Results) -> float:
    """Return the magnification M [1], image size over object size (Eq. 1)."""
    return optics.magnification(
        results.require_key("optics.focal_length_m"), results.require_key("optics.working_distance_m")
    )


def _sensor_side_mm(results: Results, axis: str) -> float:
    """Return the length of a side of the sensor [mm], its pixels times their pitch; `axis` is "columns" or "rows"."""
    return 1e3 * float(results.open_file("frames")[axis]) * results.require_key("sensor.pixel_pitch_m")


def sensor_width(results: Results) -> float:
    """Return the width of the sensor [mm]."""
    return _sensor_side_mm(results, "columns")


def sensor_height(results: Results) -> float:
    """Return the height of the sensor [mm]."""
    return _sensor_side_mm(results, "rows")


def field_height(results: Results) -> float:
    """Return the field of view on the sample along the height of the sensor [mm]."""
    return sensor_height(results) / magnification(results)


def field_width(results: Results) -> float:
    """Return the field of view on the sample along the width of the sensor [mm]."""
    return sensor_width(results) / magnification(results)


def _viewing_angle(results: Results, field_mm: float) -> float:
    """Return the full viewing angle [degree] of a field of view [mm] at the working distance."""
    distance_mm = 1e3 * results.require_key("optics.working_distance_m")
    # Both lengths in mm: only their ratio counts.
    return math.degrees(optics.viewing_angle(field_mm, distance_mm))


def viewing_angle_height(results: Results) -> float:
    """Return the full viewing angle along the height of the sensor [degree]."""
    return _viewing_angle(results, field_height(results))


def viewing_angle_width(results: Results) -> float:
    """Return the full viewing angle along the width of the sensor [degree]."""
    return _viewing_angle(results, field_width(results))


def _grain_um(results: Results, f_number: float) -> float:
    """Return the mean speckle grain on the sensor [µm] at an f-number [1], with M = 0.2 as printed."""
    return 1e6 * optics.speckle_grain(PRINTED_MAGNIFICATION, results.require_key("laser.wavelength_m"), f_number)


def grain_per_f_number(results: Results) -> float:
    """Return the mean speckle grain on the sensor divided by the f-number [µm] (Eq. 3)."""
    return _grain_um(results, 1.0)


def f_number_for_grain_of_one_pixel(results: Results) -> float:
    """Return the f-number [1] at which the mean speckle grain is as large as one pixel."""
    return 1e6 * results.require_key("sensor.pixel_pitch_m") / grain_per_f_number(results)


def _f_number_for_depth(results: Results, depth_m: float) -> float:
    """Return the f-number [1] that gives a depth of focus [m] for a blur of one pixel, with M = 0.2 as printed."""
    return optics.f_number_for_depth(depth_m, results.require_key("sensor.pixel_pitch_m"), PRINTED_MAGNIFICATION)


def f_number_for_shallow_depth(results: Results) -> float:
    """Return the f-number [1] that gives a depth of focus of 1.5 mm for a blur of one pixel (Eq. 4)."""
    return _f_number_for_depth(results, 1.5e-3)


def f_number_for_deep_depth(results: Results) -> float:
    """Return the f-number [1] that gives a depth of focus of 2 mm for a blur of one pixel (Eq. 4)."""
    return _f_number_for_depth(results, 2e-3)


def grain(results: Results) -> float:
    """Return the mean speckle grain on the sensor [µm] at the f-number of the set-up (Eq. 3)."""
    return _grain_um(results, results.require_key("optics.f_number"))


def grain_in_pixels(results: Results) -> float:
    """Return the mean speckle grain on the sensor at the f-number of the set-up [px]."""
    return 1e-6 * grain(results) / results.require_key("sensor.pixel_pitch_m")


def contrast_increase(results: Results) -> float:
    """Return by how much the speckle contrast exceeds that of a grain of one pixel [%] (Eq. 5)."""
    # The paper counts speckle regions along one axis only: a pixel is 1/`grain_in_pixels` of a region wide.
    return 100 * (optics.contrast_of_regions(1 / grain_in_pixels(results)) - 1)


def fraunhofer(results: Results) -> float:
    """Return the Fraunhofer number d_f²/(d_w λ) [1] (Eq. 6).

    d_f is the gap between filaments of the sample, d_w the working distance, and λ the wavelength of the laser.
    """
    return optics.fraunhofer_number(
        FILAMENT_GAP_M, results.require_key("optics.working_distance_m"), results.require_key("laser.wavelength_m")
    )


def rounding_variance(results: Results) -> float:
    """Return the variance of the error of rounding to whole DN [DN²]; it does not depend on the results."""
    return ROUNDING_VARIANCE


def top_hat_level(results: Results) -> float:
    """Return the level to which the top hat cuts the spot, divided by the peak of its Gaussian [1] (Eq. 40)."""
    return float(spot.top_hat_level(1.0))


def fill_factor(results: Results) -> float:
    """Return the fill factor along a row [%]: the pixel pitch over the printed width of the sensor per column."""
    pitch_mm = 1e3 * results.require_key("sensor.pixel_pitch_m")
    return 100 * pitch_mm / (PRINTED_SENSOR_WIDTH_MM / float(results.open_file("frames")["columns"]))


def exposure_step(results: Results) -> float:
    """Return the mean step from one exposure of the dataset to the next longer one [µs]."""
    return 1e6 * float(results.metrics["exposure"].diff("exposure").mean())


def crop_side(results: Results) -> float:
    """Return the side of the square crops of crops.nc [px]."""
    return float(results.open_file("crops").sizes["x"])


def read_noise_table(results: Results) -> float:
    """Return the read noise that the simulation uses, from sensor.nc [e-]."""
    return float(results.open_file("sensor")["read_noise_e"])


def images_per_exposure(results: Results) -> float:
    """Return the number of measured frames at each exposure, angles times repeats [1]."""
    return float(results.measured.sizes["angle"] * results.measured.sizes["repeat"])
