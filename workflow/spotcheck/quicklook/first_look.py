"""First look at images without a description: the `Look` and the function that makes it.

A scan is a series of images at several positions along the beam, from which M² follows.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spotcheck.dataset.metadata.entry import PITCH
from spotcheck.errors import InputError
from spotcheck.io import progress
from spotcheck.quicklook import json_report, text_report
from spotcheck.quicklook.camera import Camera, estimate_camera
from spotcheck.quicklook.image_analysis import ImageResult, analyse_image
from spotcheck.quicklook.images import WAVELENGTH, Image, ImageInput, Z, find_common_value, open_images
from spotcheck.quicklook.scan import BeamScan, fit_scan

# Longest plausible scan [m]; longer ones are probably in mm.
LONGEST_SCAN_M = 50.0


@dataclass(frozen=True, eq=False, repr=False)
class Look:
    """Results of a first look; `print` shows them as a table.

    Attributes
    ----------
    images : results of each image: Gaussian fit, second moments, clipped pixels.
    cameras : properties of each camera; images of one size and bit depth share a camera.
    beams : caustics (radius along z) by second moments and by Gaussian fits; empty without positions, pixel pitch or
        wavelength.
    pixel_pitch_m, wavelength_m : as given or as stated by the files; None if unknown.
    remarks : sentences about the sources of these values and about missing or implausible ones.

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

    images: tuple[ImageResult, ...]
    cameras: tuple[Camera, ...]
    beams: tuple[BeamScan, ...]
    pixel_pitch_m: float | None
    wavelength_m: float | None
    remarks: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return all numbers with their errors for JSON; keys end in units, and unknown values are None."""
        return json_report.build_json(self)

    def write(self, folder: str | Path) -> Path:
        """Write the page `look.html` and its first picture `look.png` into a folder; return the path of the page."""
        # Matplotlib is slow to import, and most looks are only printed.
        from spotcheck.quicklook import page

        return page.write_page(self, Path(folder))

    def __repr__(self) -> str:
        """Return all results as text, which `print` shows."""
        return text_report.format_look(self)


def look(
    images: ImageInput,
    *,
    z_m: Sequence[float] | None = None,
    pixel_pitch_m: float | None = None,
    wavelength_m: float | None = None,
) -> Look:
    """Measure the spots on images that nobody has described.

    Each image is fitted with an elliptical Gaussian, by maximum likelihood if the images show the noise of the camera.
    Its second moments are measured as well (ISO 11146-1, background after ISO 11146-3). Images of one size and bit
    depth count as taken by one camera. A scan along z gives M² from both kinds of width.

    Parameters
    ----------
    images : an array [rows, columns] in DN, a file, a folder, or several of them. The images of a folder are sorted by
        name, with numbers in numerical order; every page of a stack is an image.
    z_m : position of each image along the beam [m]; by default what the files or their names state (`z_176mm.tif`).
    pixel_pitch_m : pixel pitch [m], for widths in metres.
    wavelength_m : wavelength [m]; M² needs it and the pixel pitch.

    Returns
    -------
    Look
        `print(look)` shows it, `look.to_dict()` has all numbers, `look.write(folder)` writes a page with pictures.

    Raises
    ------
    InputError
        No file is a readable image; one file is unreadable and `z_m` is given; a folder holds no image; or the number
        of positions differs from that of the images.

    Examples
    --------
    >>> import numpy as np, spotcheck
    >>> sensor = spotcheck.SensorModel(gain_dn_per_e=0.5, read_noise_e=5, black_level_dn=20, full_scale_dn=1023)
    >>> y, x = np.mgrid[:120, :160]
    >>> photons = 900 * np.exp(-(((x - 81.3) / 7) ** 2 + ((y - 62.6) / 5) ** 2) / 2)
    >>> width = spotcheck.look(sensor.draw(photons, rng=1)).images[0].moments
    >>> print(f"D4σ {width.major:.1f} ± {width.major_stderr:.1f} px, {width.minor:.1f} ± {width.minor_stderr:.1f} px")
    D4σ 27.9 ± 0.5 px, 19.7 ± 0.4 px
    """
    opened_images, errors = open_images(images)
    for name, value in (("pixel pitch", pixel_pitch_m), ("wavelength", wavelength_m)):
        if value is not None and not 0 < value < 1:
            raise InputError(f"{name}: is {value:g} m; it must be above 0 and below 1 m")
    remarks = [f"left out: {error}" for error in errors]
    pixel_pitch_m, pitch_remarks = _find_length("pixel pitch", pixel_pitch_m, PITCH, opened_images, 1e6, "µm")
    wavelength_m, wavelength_remarks = _find_length("wavelength", wavelength_m, WAVELENGTH, opened_images, 1e9, "nm")
    positions, position_remarks = _find_positions(opened_images, None if z_m is None else list(z_m), errors)
    remarks += [*pitch_remarks, *wavelength_remarks, *_remark_on_colours(opened_images), *position_remarks]
    cameras, results = _analyse_images(opened_images, positions)
    beams: tuple[BeamScan, ...] = ()
    is_scan = any(z is not None for z in positions)
    if is_scan and pixel_pitch_m and wavelength_m:
        beams = fit_scan(results, pixel_pitch_m, wavelength_m)
    elif is_scan:
        lengths = (("wavelength", wavelength_m), ("pixel pitch", pixel_pitch_m))
        remarks.append(f"M² needs the {' and the '.join(name for name, value in lengths if not value)}")
    return Look(tuple(results), tuple(cameras), beams, pixel_pitch_m, wavelength_m, tuple(remarks))


def _find_length(
    name: str, value: float | None, key: str, images: Sequence[Image], factor: float, unit: str
) -> tuple[float | None, list[str]]:
    """Return a length [m] as given (`value`) or as the files state it, and a remark on its source in a list.

    `key` is that of the metadata, and the remark shows `factor` times the length in `unit`. Returns (None, []) if the
    length is unknown.
    """
    source = "as given"
    if value is None:
        value, source = find_common_value(images, key)
    return value, [f"{name} {factor * value:.5g} {unit}: {source}"] if value else []


def _remark_on_colours(images: Sequence[Image]) -> list[str]:
    """Return a remark on the channels that are read from colour images; [] if there are none."""
    channels = sorted({str(image.colour.channel) for image in images if image.colour.channel})
    return [f"colour images: only the brightest channel is used, {' or '.join(channels)}"] if channels else []


def _find_positions(
    images: Sequence[Image], z_m: Sequence[float] | None, errors: Sequence[str]
) -> tuple[list[float | None], list[str]]:
    """Return the position of each image [m], None if unknown, and remarks on their source and plausibility.

    `z_m` are the positions that the user gives, or None; `errors` are the sentences about skipped files. All positions
    are None unless the files state at least two different ones. Raises `InputError` if `z_m` does not fit the images.
    """
    remarks: list[str] = []
    if z_m is not None:
        if errors:
            # The order of the positions cannot be matched to images if one is missing.
            raise InputError(f"{errors[0]}; without it the order of --z is in doubt, so leave both out")
        if len(z_m) != len(images):
            raise InputError(
                f"z: {len(z_m)} positions, but the number of images is {len(images)}; give one for each, in metres"
            )
        if not all(math.isfinite(z) for z in z_m):
            raise InputError("z: every position must be a finite number, in metres")
        positions: list[float | None] = [float(z) for z in z_m]
    else:
        positions = [image.stated_value(Z) for image in images]
        remarks += _remark_on_unclear_positions(images)
        if len(set(positions) - {None}) < 2:
            return [None] * len(images), remarks
        source = next(image.metadata[Z].source for image in images if Z in image.metadata)
        missing_count = positions.count(None)
        remarks.append(f"z: from the {source}" + (f"; images without: {missing_count}" if missing_count else ""))
    known_positions = [z for z in positions if z is not None]
    lowest, highest = min(known_positions, default=0.0), max(known_positions, default=0.0)
    if highest - lowest > LONGEST_SCAN_M:
        remarks.append(f"z goes from {lowest:g} to {highest:g} m, which is implausibly long: is it in mm?")
    return positions, remarks


def _remark_on_unclear_positions(images: Sequence[Image]) -> list[str]:
    """Return a remark on positions that files state and that cannot be used; [] unless they differ between images."""
    unclear = [image.unclear[Z] for image in images if Z in image.unclear and Z not in image.metadata]
    if not unclear or len({image.unclear.get(Z) or image.stated_value(Z) for image in images}) < 2:
        return []
    others = f" ({len(unclear)} images)" if len(unclear) > 1 else ""
    return [f"z is not used where it is unclear: {unclear[0]}{others}; give the positions of all images by --z for M²"]


def _analyse_images(
    images: Sequence[Image], positions: Sequence[float | None]
) -> tuple[list[Camera], list[ImageResult]]:
    """Return the cameras, one for each size and bit depth, and the results in the order of the images.

    `positions` are those of the images along the beam [m], None if unknown.
    """
    # Indices of the images by size and bit depth; 0 replaces None, which cannot be sorted.
    groups: dict[tuple, list[int]] = {}
    for index, image in enumerate(images):
        groups.setdefault((image.shape, image.bits or 0), []).append(index)
    cameras: list[Camera] = []
    results: dict[int, ImageResult] = {}
    for _, indices in sorted(groups.items()):
        cameras.append(estimate_camera([images[index] for index in indices]))
        for index in progress.track(indices, "fitting spots"):
            results[index] = analyse_image(images[index], cameras[-1], positions[index])
    return cameras, [results[index] for index in range(len(images))]
