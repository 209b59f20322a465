"""Numbers that follow from the inputs alone. Where the paper rounds M to 0.2, so do these."""

import math

from spotcheck.metrics import crop_metrics as metrics
from spotcheck.model import optics, spot
from spotcheck.paper.results import Results, known
from spotcheck.sensor import ROUNDING_VARIANCE

PRINTED_MAGNIFICATION = 0.2
FILAMENT_GAP_M = 5.2e-6  # Section 3.1.1


def magnification(results: Results) -> float:
    """M [1] (Eq. 1)."""
    lens = results.dataset.instrument.optics
    return optics.magnification(known(lens.focal_length_m), known(lens.working_distance_m))


def _side_mm(results: Results, name: str) -> float:
    return 1e3 * float(results.file("frames")[name]) * known(results.dataset.instrument.sensor.pixel_pitch_m)


def sensor_width(results: Results) -> float:
    """Width of the sensor [mm]."""
    return _side_mm(results, "columns")


def sensor_height(results: Results) -> float:
    """Height of the sensor [mm]."""
    return _side_mm(results, "rows")


def _field_mm(results: Results, side_mm: float) -> float:
    lens = results.dataset.instrument.optics
    return optics.field_of_view(side_mm, known(lens.focal_length_m), known(lens.working_distance_m))


def field_height(results: Results) -> float:
    """Field of view along the height [mm]."""
    return _field_mm(results, sensor_height(results))


def field_width(results: Results) -> float:
    """Field of view along the width [mm]."""
    return _field_mm(results, sensor_width(results))


def viewing_angle_height(results: Results) -> float:
    """Viewing angle along the height [degree]."""
    distance = 1e3 * known(results.dataset.instrument.optics.working_distance_m)
    return math.degrees(optics.viewing_angle(field_height(results), distance))


def viewing_angle_width(results: Results) -> float:
    """Viewing angle along the width [degree]."""
    distance = 1e3 * known(results.dataset.instrument.optics.working_distance_m)
    return math.degrees(optics.viewing_angle(field_width(results), distance))


def _grain_um(results: Results, f_number: float) -> float:
    return 1e6 * optics.speckle_grain(
        PRINTED_MAGNIFICATION, known(results.dataset.instrument.laser.wavelength_m), f_number
    )


def grain_per_f_number(results: Results) -> float:
    """Speckle grain over f-number [µm] (Eq. 3)."""
    return _grain_um(results, 1.0)


def f_number_for_grain_of_one_pixel(results: Results) -> float:
    """f-number at which the grain is one pixel [1]."""
    return 1e6 * known(results.dataset.instrument.sensor.pixel_pitch_m) / grain_per_f_number(results)


def _f_number_for_depth(results: Results, depth_m: float) -> float:
    blur = known(results.dataset.instrument.sensor.pixel_pitch_m)
    return optics.f_number_for_depth(depth_m, blur, PRINTED_MAGNIFICATION)


def f_number_for_shallow_depth(results: Results) -> float:
    """f-number of a depth of focus of 1.5 mm [1] (Eq. 4)."""
    return _f_number_for_depth(results, 1.5e-3)


def f_number_for_deep_depth(results: Results) -> float:
    """f-number of a depth of focus of 2 mm [1] (Eq. 4)."""
    return _f_number_for_depth(results, 2e-3)


def grain(results: Results) -> float:
    """Speckle grain at the f-number of the set-up [µm] (Eq. 3)."""
    return _grain_um(results, known(results.dataset.instrument.optics.f_number))


def grain_in_pixels(results: Results) -> float:
    """Speckle grain [px]."""
    return 1e-6 * grain(results) / known(results.dataset.instrument.sensor.pixel_pitch_m)


def contrast_increase(results: Results) -> float:
    """Increase of the speckle contrast against a grain of one pixel [%] (Eq. 5, grains counted along one direction)."""
    return 100 * (optics.contrast_of_regions(1 / grain_in_pixels(results)) - 1)


def fraunhofer(results: Results) -> float:
    """d_f²/(d_w λ) [1] (Eq. 6)."""
    instrument = results.dataset.instrument
    distance, wavelength = known(instrument.optics.working_distance_m), known(instrument.laser.wavelength_m)
    return optics.fraunhofer_number(FILAMENT_GAP_M, distance, wavelength)


def rounding_variance(results: Results) -> float:
    """Variance of the rounding [DN²]."""
    return ROUNDING_VARIANCE


def top_hat_level(results: Results) -> float:
    """Plateau over peak [1] (Eq. 40)."""
    return float(spot.top_hat_level(1.0))


def psnr_container_gain(results: Results) -> float:
    """What a data range of 65535 adds to PSNR against the sensor's own [dB]."""
    return 20 * math.log10(metrics.CONTAINER_RANGE / float(results.file("frames")["full_scale"]))


def read_noise_table(results: Results) -> float:
    """Read noise that the simulation uses [e-]."""
    return float(results.file("sensor")["read_noise_e"])


def images_per_exposure(results: Results) -> float:
    """Frames at each exposure [1]."""
    return float(results.measured.sizes["angle"] * results.measured.sizes["repeat"])
