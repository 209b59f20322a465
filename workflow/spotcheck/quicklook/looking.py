"""The first look in one call: images without a word about them, and what they show."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from spotcheck.errors import InputError
from spotcheck.io import progress
from spotcheck.quicklook import plain, words
from spotcheck.quicklook.camera import Camera, camera_of
from spotcheck.quicklook.images import PITCH, WAVELENGTH, Given, Image, Z, common, images_of
from spotcheck.quicklook.scan import Beam, beams_of
from spotcheck.quicklook.seen import Seen, seen_on

# No scan along a beam is longer [m].
LONGEST_M = 50.0


@dataclass(frozen=True, eq=False, repr=False)
class Look:
    """What images show; `print` writes it as a table.

    Attributes
    ----------
    images : what each image shows: fit, second moments, clip, shape.
    cameras : what all images of one size and depth tell of their camera: gain, noise, black level, where readings stop.
    beams : the scan along z by second moments and by the fits; empty without positions.
    pixel_pitch_m, wavelength_m : as given, or as the files say; None where neither does.
    remarks : sentences on what is missing or odd.

    Examples
    --------
    >>> import numpy as np, spotcheck
    >>> y, x = np.mgrid[:120, :160]
    >>> light = 200 * np.exp(-(((x - 81.3) / 7) ** 2 + ((y - 62.6) / 5) ** 2) / 2)
    >>> image = np.random.default_rng(1).normal(light + 20, 1.5).round().astype(np.uint8)
    >>> print(spotcheck.look(image, pixel_pitch_m=5e-6))
    image 0
    ...
    >>> numbers = spotcheck.look(image).to_dict()["images"][0]
    >>> sorted(numbers["second_moments"])[:4]
    ['area_inside', 'azimuth_deg', 'azimuth_stderr_deg', 'background_dn']
    """

    images: tuple[Seen, ...]
    cameras: tuple[Camera, ...]
    beams: tuple[Beam, ...]
    pixel_pitch_m: float | None
    wavelength_m: float | None
    remarks: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """All numbers with their errors for JSON; units are in the keys, and what is unknown is None."""
        return plain.plain(self)

    def write(self, folder: str | Path) -> Path:
        """Write the page `look.html` and its first picture `look.png` into a folder; returns the page's path."""
        from spotcheck.quicklook import page

        return page.write(self, Path(folder))

    def __repr__(self) -> str:
        return words.told(self)


def look(
    images: Given,
    *,
    z_m: Sequence[float] | None = None,
    pixel_pitch_m: float | None = None,
    wavelength_m: float | None = None,
) -> Look:
    """Look at images of spots that nobody has described.

    Each is fitted with an elliptical Gaussian, by maximum likelihood where the images show the camera's noise, and
    measured by its second moments (ISO 11146-1, background after ISO 11146-3). Images of one size and depth are taken
    for those of one camera. Along z they give M² by either width.

    Parameters
    ----------
    images : an array [rows, columns] in DN, a file, a folder, or several of them. A folder's images are taken by name,
        with numbers in the order of counting; every page of a stack is an image.
    z_m : position of each image along the beam [m], in their order. By default what files or their names say
        (`z_176mm.tif`).
    pixel_pitch_m : distance of two pixels [m]; widths are then in metres too.
    wavelength_m : wavelength [m]; M² needs it, and the pitch.

    Returns
    -------
    Look
        `print(look)` shows it, `look.to_dict()` has all numbers, `look.write(folder)` writes a page with pictures.

    Raises
    ------
    InputError
        No file is an image, or one is not and positions are given by the order; a folder without an image; or a
        number of positions that is not that of the images.

    Examples
    --------
    >>> import numpy as np, spotcheck
    >>> sensor = spotcheck.SensorModel(gain_dn_per_e=0.5, read_noise_e=5, black_level_dn=20, full_scale_dn=1023)
    >>> y, x = np.mgrid[:120, :160]
    >>> photons = 900 * np.exp(-(((x - 81.3) / 7) ** 2 + ((y - 62.6) / 5) ** 2) / 2)
    >>> found = spotcheck.look(sensor.draw(photons, rng=1))
    >>> width = found.images[0].moments
    >>> print(f"D4σ {width.major:.1f} ± {width.major_stderr:.1f} px, {width.minor:.1f} ± {width.minor_stderr:.1f} px")
    D4σ 27.9 ± 0.5 px, 19.7 ± 0.4 px
    """
    given, left_out = images_of(images)
    for name, value in (("pixel pitch", pixel_pitch_m), ("wavelength", wavelength_m)):
        if value is not None and not 0 < value < 1:
            raise InputError(f"{name}: is {value:g} m; it must be above 0 and below 1 m")
    remarks = [f"left out: {why}" for why in left_out]
    pixel_pitch_m, said = _known("pixel pitch", pixel_pitch_m, PITCH, given, 1e6, "µm")
    wavelength_m, also = _known("wavelength", wavelength_m, WAVELENGTH, given, 1e9, "nm")
    remarks += said + also
    if coloured := [image for image in given if image.colour.channel]:
        taken = sorted({str(image.colour.channel) for image in coloured})
        which = " or ".join(taken)
        remarks.append(f"images with red, green and blue: one channel is taken, {which}; of unequal ones the brightest")
    positions, said = _positions(given, None if z_m is None else list(z_m), left_out)
    remarks += said
    known = [z for z in positions if z is not None]
    if known and max(known) - min(known) > LONGEST_M:
        remarks.append(f"z goes from {min(known):g} to {max(known):g} m, and no bench is that long: is it in mm?")
    cameras, seen = _looked(given, positions)
    beams: list[Beam] = []
    if any(z is not None for z in positions):
        if pixel_pitch_m and wavelength_m:
            beams = beams_of(seen, pixel_pitch_m, wavelength_m)
        else:
            names = (("wavelength", wavelength_m), ("pixel pitch", pixel_pitch_m))
            remarks.append(f"M² needs the {' and the '.join(name for name, value in names if not value)}")
    return Look(tuple(seen), tuple(cameras), tuple(beams), pixel_pitch_m, wavelength_m, tuple(remarks))


def _known(
    name: str, value: float | None, label: str, images: Sequence[Image], factor: float, unit: str
) -> tuple[float | None, list[str]]:
    """A length [m] as given, or as the files say, and a remark on where it is from; None where neither does."""
    source = "as given"
    if value is None:
        value, source = common(images, label)
    return value, [f"{name} {factor * value:.5g} {unit}: {source}"] if value else []


def _positions(
    images: Sequence[Image], z_m: Sequence[float] | None, left_out: Sequence[str]
) -> tuple[list[float | None], list[str]]:
    """Position of each image [m], and where it is from where nobody gave it."""
    if z_m is not None:
        if left_out:
            # Whose position is whose is then up to the order, which nobody should guess.
            raise InputError(f"{left_out[0]}; without it the order of --z is in doubt, so leave both out")
        if len(z_m) != len(images):
            raise InputError(
                f"z: {len(z_m)} positions, but the number of images is {len(images)}; give one for each, in metres"
            )
        if not all(math.isfinite(z) for z in z_m):
            raise InputError("z: every position must be a finite number, in metres")
        return [float(z) for z in z_m], []
    found = [image.says(Z) for image in images]
    if len({z for z in found if z is not None}) < 2:
        return [None] * len(images), []
    first = next(label for image in images if (label := (image.labels or {}).get(Z)) is not None)
    source, without = first.source, found.count(None)
    return found, [f"z: by the {source}" + (f"; images without: {without}" if without else "")]


def _looked(images: Sequence[Image], positions: Sequence[float | None]) -> tuple[list[Camera], list[Seen]]:
    """Cameras by size and depth of their images, and what each image shows, in the order of the images."""

    def camera(number: int) -> tuple:
        own = images[number]
        return (own.shape, own.bits or 0)

    cameras: list[Camera] = []
    seen: dict[int, Seen] = {}
    for _, group in groupby(sorted(range(len(images)), key=camera), key=camera):
        own = list(group)
        cameras.append(camera_of([images[k] for k in own]))
        seen |= {k: seen_on(images[k], cameras[-1], positions[k]) for k in progress.track(own, "looking at spots")}
    return cameras, [seen[k] for k in range(len(images))]
