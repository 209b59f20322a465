"""What images of spots alone tell of the camera: gain, noise, black level, and where readings stop."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck import progress
from spotcheck.clip import LEAST_PX, Top, top_of
from spotcheck.estimate.by_spots import dark_level, seen_by_spots
from spotcheck.estimate.plus_minus import plus_minus
from spotcheck.estimate.sensor import Found, spots_in_electrons
from spotcheck.first_look.images import Image
from spotcheck.model.sensor import SensorModel

UNKNOWN = "no image shows noise that grows with its light"


class Camera(NamedTuple):
    """Which images are its; gain [DN/e-] and read noise [e-], None where they are unknown, with the reason in `how`;
    black level [DN], the lowest rim of all images, which stray light may have raised; and the reading [DN] at which
    images stop, infinite where none does."""

    images: tuple[str, ...]
    gain: Found | None
    noise: Found | None
    how: str
    black_dn: float
    stop_dn: float

    def sensor(self, pixels: np.ndarray) -> SensorModel | None:
        """The law of a reading of an image, whose own rim is the level that its noise grows from: shot noise of stray
        light is part of the read noise here. None where gain or noise is unknown."""
        if self.gain is None or self.noise is None:
            return None
        black = dark_level(pixels)
        return SensorModel(self.gain.value, self.noise.value, black_level_dn=black, full_scale_dn=self.stop_dn)

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
    seen = seen_by_spots((image.read() for image in progress.over(images, "looking at noise")), {}, None, stop)
    names = tuple(image.name for image in images)
    found = spots_in_electrons(seen)
    if not found:
        return Camera(names, None, None, UNKNOWN, seen.lowest_dn, stop)
    return Camera(names, found["gain_dn_per_e"], found["read_noise_e"], seen.how, seen.lowest_dn, stop)


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
