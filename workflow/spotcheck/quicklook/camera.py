"""Gain, read noise, black level and clip level of a camera, estimated from images of spots alone."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spotcheck.characterization.contradictions import SourceValue
from spotcheck.characterization.sensor_choice import convert_to_electrons
from spotcheck.characterization.spot_estimates import estimate_from_spots, measure_rim
from spotcheck.crops.full_scale import MIN_PLATEAU_PX, measure_extremes
from spotcheck.io import progress
from spotcheck.quicklook.images import Image
from spotcheck.sensor import SensorModel

UNKNOWN_GAIN = "in no image does the noise grow with the signal"
# Readings that are not integers are rounded to a step of at most noise / 2, which adds 2 % to the variance at most.
NOISE_STEPS = 2.0
# Integers with more noise than this [DN] are sums of readings, not single readings.
MOST_NOISE_DN = 1000.0
# Median of |difference of two neighbours| of normal noise, in units of its standard deviation: √2 · 0.6745.
MEDIAN_DIFFERENCE = 0.954
# Noise assumed for a noiseless image, as a part of its range.
LEAST_NOISE = 1e-5


@dataclass(frozen=True)
class Camera:
    """Properties of one camera."""

    images: tuple[str, ...]  # names of the images that were taken with it
    gain: SourceValue | None  # gain [DN/e-]; None if unknown
    read_noise: SourceValue | None  # read noise [e-]; None if unknown
    method: str  # how gain and read noise were estimated, or why they are unknown
    black_level_dn: float  # lowest border level of all images [DN], an upper limit because it includes stray light
    clip_level_dn: float  # reading at which images clip [DN]; infinite if none clips
    step_dn: float = 1.0  # rounding step of the readings [DN]

    def sensor_model(self, pixels: np.ndarray) -> SensorModel | None:
        """Return the sensor model of an image [rows, columns] in units of `step_dn`; None if gain or noise is unknown.

        The black level is the border level of this image, so the read noise includes the shot noise of stray light.
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
    """
    clip_levels = (find_clip_level(image.read(), image.bits) for image in images)
    # A camera clips at one level; a lower plateau is part of the light.
    clip_level = max((level for level in clip_levels if np.isfinite(level)), default=np.inf)
    step = _estimate_step(images)
    scaled = (image.read() / step for image in progress.track(images, "estimating noise"))
    estimate = estimate_from_spots(scaled, {}, None, clip_level / step)
    quantities = convert_to_electrons(estimate)
    gain, method = None, UNKNOWN_GAIN
    if quantities:
        gain = quantities["gain_dn_per_e"]
        gain = gain._replace(value=step * gain.value, stderr=step * gain.stderr)
        method = estimate.method
    names = tuple(image.name for image in images)
    return Camera(
        names, gain, quantities.get("read_noise_e"), method, step * estimate.lowest_dn, clip_level, step
    )  # fmt: skip


def find_clip_level(pixels: np.ndarray, bits: int | None) -> float:
    """Return the reading [DN] at which an image clips; infinite if it does not.

    An image clips at its highest reading if that is the largest number of `bits`, or if pixels accumulate at it.

    Parameters
    ----------
    pixels : readings [rows, columns] in DN, NaN where unknown.
    bits : bits of a stored pixel; None if pixels are not unsigned integers.
    """
    readings = pixels[np.isfinite(pixels)]
    if not readings.size:
        return np.inf
    highest = float(readings.max())
    if bits is not None and highest >= 2**bits - 1:
        return highest
    if not np.array_equal(readings, np.rint(readings)) or readings.min() < 0:
        return highest if np.count_nonzero(readings == highest) >= MIN_PLATEAU_PX else np.inf
    return highest if measure_extremes(readings.astype(np.int64)).has_plateau() else np.inf


def _estimate_step(images: Sequence[Image]) -> float:
    """Return the rounding step [DN]: 1 for readings of a converter.

    For other numbers, such as a mean of frames or a normalized image, it is a power of ten that is small against their
    noise.
    """
    if any(image.bits is not None for image in images):
        return 1.0
    noise, are_integers = zip(*(_measure_noise(image.read()) for image in images), strict=True)
    typical = float(np.median(noise))
    if not typical or (all(are_integers) and typical < MOST_NOISE_DN):
        return 1.0
    return float(10.0 ** np.floor(np.log10(typical / NOISE_STEPS)))


def _measure_noise(pixels: np.ndarray) -> tuple[float, bool]:
    """Return the noise [DN] from differences of neighbouring pixels, and whether all readings are integers."""
    readings, differences = pixels[np.isfinite(pixels)], np.abs(np.diff(pixels, axis=1))
    noise = float(np.nanmedian(differences)) / MEDIAN_DIFFERENCE if np.isfinite(differences).any() else 0.0
    return max(noise, LEAST_NOISE * float(np.ptp(readings))), bool(np.all(readings == np.rint(readings)))
