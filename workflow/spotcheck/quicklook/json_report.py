"""Numbers of a first look for JSON: keys end in units, and None stands for an unknown value.

Each number has its standard error under a second key: `gain_dn_per_e` and `gain_stderr_dn_per_e`. Unknown numbers are
NaN or infinite until `build_json` replaces them by None.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from spotcheck.fitting.fit_results import PARAMETERS, SpotFits
from spotcheck.fitting.hyperbola import QUANTITIES
from spotcheck.fitting.moments import Moments
from spotcheck.quicklook import text_report
from spotcheck.quicklook.camera import Camera
from spotcheck.quicklook.image_analysis import ImageResult
from spotcheck.quicklook.scan import FIT, MOMENTS, BeamScan

if TYPE_CHECKING:
    from spotcheck.quicklook.first_look import Look

# Key of each method by which a scan measures widths.
METHOD_KEYS = {MOMENTS: "second_moments", FIT: "gaussian_fit"}
# End of a key by unit.
SUFFIXES = {"DN": "_dn", "pixel": "_px", "degree": "_deg", "m": "_m", "rad": "_rad", "1": ""}


def build_json(look: Look) -> dict[str, Any]:
    """Return all numbers of a look as plain dictionaries, lists, numbers, strings and None."""
    return _replace_unknown(
        {
            "images": [_convert_image(image, look.pixel_pitch_m) for image in look.images],
            "cameras": [_convert_camera(camera) for camera in look.cameras],
            "beams": {METHOD_KEYS[scan.method]: _convert_scan(scan) for scan in look.beams},
            "pixel_pitch_m": look.pixel_pitch_m,
            "wavelength_m": look.wavelength_m,
            "remarks": [*text_report.find_scan_cautions(look), *look.remarks],
        }
    )


def _convert_image(image: ImageResult, pitch_m: float | None) -> dict[str, Any]:
    """Return the results of one image.

    `stop_dn` is the clip level, `clipped_px` the number of pixels at it, and `d4sigma_widened_by_clip` the factor by
    which they widen D4σ. `misfit_of_peak` is the rms residual of the fit as a fraction of the peak. `left_out` is a
    sentence about outlier pixels, and `beware` a list of cautions. `pitch_m` is the pixel pitch [m], None if unknown.
    """
    rows, columns = image.shape
    return {
        "name": image.name,
        "rows": rows,
        "columns": columns,
        "z_m": image.z_m,
        "second_moments": _convert_moments(image.moments, pitch_m) if math.isfinite(image.moments.x) else None,
        "gaussian_fit": None if image.fit is None else _convert_fit(image, image.fit, pitch_m),
        "highest_dn": image.clipping.highest_dn,
        "clipped_px": image.clipping.pixels,
        "stop_dn": image.clipping.level_dn,
        "d4sigma_widened_by_clip": image.clip_widening,
        "misfit_of_peak": image.residual_rms,
        "left_out": image.outlier_text,
        "beware": text_report.list_cautions(image),
    }


def _convert_moments(moments: Moments, pitch_m: float | None) -> dict[str, Any]:
    """Return the second moments with their errors; widths also in metres if the pixel pitch [m] is known.

    `area_inside` is the fraction of the area of integration inside the frame; `whole` tells whether that is enough for
    the standard. `settled` tells whether the iteration of that area converged, `measured` whether the errors of both
    widths are small enough to state them.
    """
    return {
        **_with_error("x", moments.x, moments.x_stderr, "_px"),
        **_with_error("y", moments.y, moments.y_stderr, "_px"),
        **_with_error("d4sigma_major", moments.major, moments.major_stderr, "_px", pitch_m),
        **_with_error("d4sigma_minor", moments.minor, moments.minor_stderr, "_px", pitch_m),
        **_with_error("azimuth", moments.azimuth, moments.azimuth_stderr, "_deg"),
        **_with_error("background", moments.background, moments.background_stderr, "_dn"),
        "area_inside": moments.area_fraction,
        "whole": moments.is_whole,
        "settled": moments.has_converged,
        "measured": moments.is_measured,
    }


def _convert_fit(image: ImageResult, fit: SpotFits, pitch_m: float | None) -> dict[str, Any]:
    """Return status, reduced χ² and parameters of the fit of an image, with their errors.

    Widths are also in metres if the pixel pitch [m] is known.
    """
    numbers: dict[str, Any] = {"status": str(fit.status), "chi2_reduced": float(fit.chi2_reduced)}
    for name, (unit, _) in PARAMETERS.items():
        pitch = pitch_m if name.startswith("sigma") else None
        numbers |= _with_error(name, *image.fit_value(name), SUFFIXES[unit], pitch)
    return numbers


def _with_error(name: str, value: Any, stderr: Any, suffix: str, pitch_m: float | None = None) -> dict[str, Any]:
    """Return a number and its standard error, with the unit `suffix` in the keys such as `_px`.

    If a pixel pitch [m] is given, both are added in metres. `value` and `stderr` are numbers, lists or None.
    """
    numbers = {f"{name}{suffix}": value, f"{name}_stderr{suffix}": stderr}
    if pitch_m is not None:
        numbers |= {f"{name}_m": value * pitch_m, f"{name}_stderr_m": stderr * pitch_m}
    return numbers


def _convert_camera(camera: Camera) -> dict[str, Any]:
    """Return the properties of a camera; gain and read noise with their errors are None if unknown.

    `stop_dn` is the clip level, and `how` the method or why gain and noise are unknown.
    """
    numbers: dict[str, Any] = {
        "black_level_dn": camera.black_level_dn,
        "stop_dn": camera.clip_level_dn,
        "how": camera.method,
    }
    for name, suffix, estimate in (("gain", "_dn_per_e", camera.gain), ("read_noise", "_e", camera.read_noise)):
        value, stderr = (None, None) if estimate is None else (estimate.value, estimate.stderr)
        numbers |= _with_error(name, value, stderr, suffix)
    return numbers


def _convert_scan(scan: BeamScan) -> dict[str, Any]:
    """Return the caustics by axis with their radii along z, or why there are none (`why_not`)."""
    if scan.reason:
        return {"why_not": scan.reason, "left_out": list(scan.left_out)}
    axes = {}
    for axis, caustic in scan.caustics.items():
        numbers: dict[str, Any] = {"chi2_reduced": caustic.chi2_reduced, "scatter": caustic.scatter}
        for name, (unit, _) in QUANTITIES.items():
            numbers |= _with_error(name, getattr(caustic, name), getattr(caustic, f"{name}_stderr"), SUFFIXES[unit])
        radius = _with_error("radius", scan.radius[axis].tolist(), scan.stderr[axis].tolist(), "_m")
        axes[axis] = numbers | {"z_m": scan.z.tolist()} | radius
    return {"axes": axes, "left_out": list(scan.left_out)}


def _replace_unknown(content: Any) -> Any:
    """Return nested dictionaries and lists with None instead of NaN and infinity, which JSON does not have.

    Other numbers, such as those of NumPy, become floats.
    """
    if isinstance(content, dict):
        return {key: _replace_unknown(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_replace_unknown(value) for value in content]
    if isinstance(content, bool | int | str) or content is None:
        return content
    number = float(content)
    return number if math.isfinite(number) else None
