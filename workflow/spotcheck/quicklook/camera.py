"""What images of spots alone tell of the camera: gain, noise, black level, and where readings stop."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.characterization.contradictions import SourceValue
from spotcheck.characterization.sensor_choice import convert_to_electrons
from spotcheck.characterization.spot_estimates import estimate_from_spots, measure_rim
from spotcheck.crops.clip import LEAST_PX, Top, top_of
from spotcheck.io import progress
from spotcheck.io.plus_minus import plus_minus
from spotcheck.quicklook.images import Image
from spotcheck.sensor import SensorModel

UNKNOWN = "no image shows noise that grows with its light"
# Noise of numbers that no converter wrote, in steps that they are rounded to, which then add 2 % to its variance at
# most; and noise [DN] above which whole numbers are no single readings, but sums.
LEAST_STEPS, MOST_DN = 2.0, 1000.0
# Median step between neighbours over the noise of a normal law, √2 · 0.6745; and the noise of an image without any, as
# part of its range.
NORMAL_STEP, NOISELESS = 0.954, 1e-5


class Camera(NamedTuple):
    """Which images are its; gain [DN/e-] and read noise [e-], None where they are unknown, with the reason in `how`;
    black level [DN], the lowest rim of all images, which stray light may have raised; the reading [DN] at which images
    stop, infinite where none does; and the step [DN] that its law rounds to."""

    images: tuple[str, ...]
    gain: SourceValue | None
    noise: SourceValue | None
    how: str
    black_dn: float
    stop_dn: float
    step_dn: float = 1.0

    def sensor(self, pixels: np.ndarray) -> SensorModel | None:
        """The law of a reading of an image in steps, whose own rim is the level that its noise grows from: shot noise
        of stray light is part of the read noise here. None where gain or noise is unknown."""
        if self.gain is None or self.noise is None:
            return None
        black = measure_rim(pixels)
        gain, black, stop = (own / self.step_dn for own in (self.gain.value, black, self.stop_dn))
        return SensorModel(gain, self.noise.value, black_level_dn=black, full_scale_dn=stop)

    def lines(self) -> list[tuple[str, str]]:
        """Name and text of each number."""
        if self.gain is None or self.noise is None:
            noise = [("gain, read noise", f"unknown: {self.how}")]
        else:
            noise = [
                ("gain", f"{plus_minus(self.gain.value, self.gain.stderr, 'DN/e-')}, by {self.how}"),
                ("read noise", f"{plus_minus(self.noise.value, self.noise.stderr, 'e-')}"),
            ]
        black = ("black level", f"{self.black_dn:.4g} DN or less: what images read at their rim, stray light included")
        return [*noise, black]


def camera_of(images: Sequence[Image]) -> Camera:
    """What images of one camera, of equal size and depth, tell together."""
    stops = [end for image in images if np.isfinite(end := stop_of(image.read(), image.bits))]
    # One camera stops at one reading: a plateau that is lower is light's own.
    stop = max(stops, default=np.inf)
    step = _rounded_to(images)
    read = (image.read() / step for image in progress.over(images, "looking at noise"))
    seen = estimate_from_spots(read, {}, None, stop / step)
    names, lowest = tuple(image.name for image in images), step * seen.lowest_dn
    found = convert_to_electrons(seen)
    if not found:
        return Camera(names, None, None, UNKNOWN, lowest, stop, step)
    gain = found["gain_dn_per_e"]
    gain = gain._replace(value=step * gain.value, stderr=step * gain.stderr)
    return Camera(names, gain, found["read_noise_e"], seen.method, lowest, stop, step)


def _rounded_to(images: Sequence[Image]) -> float:
    """The step [DN] that the law of a reading rounds to: 1, or of numbers that no converter wrote, such as a mean of
    frames or parts of the brightest pixel, a power of ten that is small against their noise."""
    if any(image.bits is not None for image in images):
        return 1.0
    noise, whole = zip(*(_noise_of(image.read()) for image in images), strict=True)
    typical = float(np.median(noise))
    if not typical or (all(whole) and typical < MOST_DN):
        return 1.0
    return float(10.0 ** np.floor(np.log10(typical / LEAST_STEPS)))


def _noise_of(pixels: np.ndarray) -> tuple[float, bool]:
    """Noise of an image from pixel to pixel [DN], or a small part of its range where that is larger; and whether its
    numbers are whole."""
    known, steps = pixels[np.isfinite(pixels)], np.abs(np.diff(pixels, axis=1))
    typical = float(np.nanmedian(steps)) / NORMAL_STEP if np.isfinite(steps).any() else 0.0
    return max(typical, NOISELESS * float(np.ptp(known))), bool(np.all(known == np.rint(known)))


def stop_of(pixels: np.ndarray, bits: int | None) -> float:
    """The highest reading [DN], where readings stop at it: where pixels gather, or at the largest number that the
    stored pixel holds; infinite where they do not."""
    known = pixels[np.isfinite(pixels)]
    if not known.size:
        return np.inf
    highest = float(known.max())
    if bits is not None and highest >= 2**bits - 1:
        return highest
    if not np.array_equal(known, np.rint(known)) or known.min() < 0:
        return highest if np.count_nonzero(known == highest) >= LEAST_PX else np.inf
    top: Top = top_of(known.astype(np.int64))
    return highest if top.stops(top.lowest) else np.inf
