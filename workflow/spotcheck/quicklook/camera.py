"""Gain, read noise, black level and clip level of a camera, estimated from images of spots alone.

The clip level is the reading at which all brighter pixels are cut off. A plateau is a group of pixels at exactly the
highest reading. The rounding step is the unit in which the noise of an image is analysed: 1 DN for single readings of a
camera, a small power of ten for other numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spotcheck.characterization.contradictions import SourceValue
from spotcheck.characterization.sensor_choice import convert_to_electrons
from spotcheck.characterization.spot_estimates import estimate_from_spots, measure_rim
from spotcheck.crops.full_scale import MIN_PLATEAU_PX, measure_extremes
from spotcheck.crops.spotfinding import MEDIAN_DIFFERENCE
from spotcheck.io import progress
from spotcheck.quicklook.images import Image
from spotcheck.sensor import SensorModel

UNKNOWN_GAIN = "in no image does the noise grow with the signal"
# Least noise in rounding steps of readings that are not integers. Rounding then adds at most 2 % to the variance.
NOISE_STEPS = 2.0
# Integers with more noise than this [DN] are sums of readings, not single readings.
MOST_NOISE_DN = 1000.0
# Least noise of an image, as a fraction of its range of readings.
LEAST_NOISE = 1e-5


@dataclass(frozen=True)
class Camera:
    """Properties of one camera."""

    images: tuple[str, ...]  # names of the images that were taken with it
    gain: SourceValue | None  # gain [DN/e-] with its standard error; None if unknown
    read_noise: SourceValue | None  # read noise [e-] with its standard error; None if the gain is unknown
    method: str  # how gain and read noise were estimated, or why they are unknown
    black_level_dn: float  # lowest reading at the border of an image [DN], an upper limit because of stray light
    clip_level_dn: float  # reading at which images clip [DN]; infinite if none clips
    step_dn: float = 1.0  # rounding step of the readings [DN]

    def sensor_model(self, pixels: np.ndarray) -> SensorModel | None:
        """Return the sensor model of an image [rows, columns] in DN, for readings in units of `step_dn`.

        Returns None if gain or noise is unknown. The black level is the reading at the border of this image, so the
        read noise includes the shot noise of stray light.
        """
        if self.gain is None or self.read_noise is None:
            return None
        return SensorModel(
            self.gain.value / self.step_dn,
            self.read_noise.value,
            black_level_dn=measure_rim(pixels) / self.step_dn,
            full_scale_dn=self.clip_level_dn / self.step_dn,
        )


def estimate_camera(images: Sequence[Image]) -> Camera:
    """Return the properties of a camera, estimated from its images.

    Parameters
    ----------
    images : images of spots, all of one size and bit depth.

    Returns
    -------
    Camera
        Gain and read noise are None if no image shows noise that grows with the signal.

    Raises
    ------
    InputError
        If an image has no finite reading.
    """
    names = tuple(image.name for image in images)
    images, clip_levels = zip(*_measure_clip_levels(images), strict=True)
    # A camera clips at one level; a lower plateau is part of the light.
    clip_level = max((level for level in clip_levels if np.isfinite(level)), default=np.inf)
    step_dn = _estimate_step(images)
    scaled_images = (image.read() / step_dn for image in progress.track(images, "estimating noise"))
    estimate = estimate_from_spots(scaled_images, pairs={}, black_dn=None, full_scale_dn=clip_level / step_dn)
    quantities, gain = convert_to_electrons(estimate), None
    if quantities:
        scaled_gain = quantities["gain_dn_per_e"]
        gain = scaled_gain._replace(value=step_dn * scaled_gain.value, stderr=step_dn * scaled_gain.stderr)
    return Camera(
        images=names, gain=gain, read_noise=quantities.get("read_noise_e"),
        method=estimate.method or UNKNOWN_GAIN, black_level_dn=step_dn * estimate.lowest_zero_level_dn,
        clip_level_dn=clip_level, step_dn=step_dn,
    )  # fmt: skip


def _measure_clip_levels(images: Sequence[Image]) -> list[tuple[Image, float]]:
    """Return the images whose pixels differ, each with its clip level [DN]; all images if none has such pixels.

    An image of one reading, such as an empty page of a stack, holds no measurement.
    """
    uniform, measured = list[tuple[Image, float]](), list[tuple[Image, float]]()
    for image in images:
        pixels = image.read()
        images_alike = measured if np.nanmin(pixels) < np.nanmax(pixels) else uniform
        images_alike.append((image, find_clip_level(pixels, image.bits)))
    return measured or uniform


def find_clip_level(pixels: np.ndarray, bits: int | None) -> float:
    """Return the reading [DN] at which an image clips; infinite if it does not.

    An image clips at its highest reading if that is the largest number of `bits`, or if pixels accumulate at it.

    Parameters
    ----------
    pixels : readings [rows, columns] in DN, NaN where unknown.
    bits : bits of a stored pixel; None if pixels are not unsigned integers.

    Returns
    -------
    float
        Clip level [DN].
    """
    readings = pixels[np.isfinite(pixels)]
    if not readings.size:
        return np.inf
    highest = float(readings.max())
    if bits is not None and highest >= 2**bits - 1:
        return highest
    # `measure_extremes` needs whole numbers from 0 on. In others, pixels that repeat the highest one are a plateau.
    if not np.array_equal(readings, np.rint(readings)) or readings.min() < 0:
        return highest if np.count_nonzero(readings == highest) >= MIN_PLATEAU_PX else np.inf
    return highest if measure_extremes(readings.astype(np.int64)).has_plateau() else np.inf


def _estimate_step(images: Sequence[Image]) -> float:
    """Return the rounding step [DN] of the images of a camera.

    It is 1 for unsigned integers, for other integers whose noise is that of a camera, and for images that are uniform.
    For other numbers, such as a mean of frames or a normalized image, it is the largest power of ten that is at most
    1/`NOISE_STEPS` of their median noise.
    """
    if any(image.bits is not None for image in images):
        return 1.0
    noise, are_integers = zip(*(_measure_noise(image.read()) for image in images), strict=True)
    median_noise = float(np.median(noise))
    if not median_noise or (all(are_integers) and median_noise < MOST_NOISE_DN):
        return 1.0
    return float(10.0 ** np.floor(np.log10(median_noise / NOISE_STEPS)))


def _measure_noise(pixels: np.ndarray) -> tuple[float, bool]:
    """Return the noise [DN] of an image [rows, columns], and whether all its readings are integers.

    The noise is that of differences between neighbouring pixels of a row; at least `LEAST_NOISE` of the range.
    """
    readings, differences = pixels[np.isfinite(pixels)], np.abs(np.diff(pixels, axis=1))
    noise = float(np.nanmedian(differences)) / MEDIAN_DIFFERENCE if np.isfinite(differences).any() else 0.0
    return max(noise, LEAST_NOISE * float(np.ptp(readings))), bool(np.all(readings == np.rint(readings)))
