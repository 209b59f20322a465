"""The numbers of a first look as JSON has them: units in the keys, None for what is unknown."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from spotcheck.fitting.caustic import QUANTITIES
from spotcheck.fitting.fit_results import NAMES, PARAMETERS
from spotcheck.quicklook import words
from spotcheck.quicklook.camera import Camera
from spotcheck.quicklook.scan import METHODS, Beam
from spotcheck.quicklook.seen import Seen

if TYPE_CHECKING:
    from spotcheck.quicklook.looking import Look

# Ending of a key for each unit of a fit.
ENDINGS = {"DN": "dn", "pixel": "px", "degree": "deg"}
OF_BEAM = {"m": "_m", "rad": "_rad", "1": ""}


def plain(look: Look) -> dict[str, Any]:
    """A look as a dictionary of plain numbers and words."""
    out = {
        "images": [_image(one, look.pixel_pitch_m) for one in look.images],
        "cameras": [_camera(own) for own in look.cameras],
        "beams": {METHODS[own.method]: _beam(own) for own in look.beams},
        "pixel_pitch_m": look.pixel_pitch_m,
        "wavelength_m": look.wavelength_m,
        "remarks": [*words.on_beams(look), *look.remarks],
    }
    return _known(out)


def _image(one: Seen, pitch: float | None) -> dict[str, Any]:
    own = one.moments
    widths = {"d4sigma_major": (own.major, own.major_stderr), "d4sigma_minor": (own.minor, own.minor_stderr)}
    moments = {
        "x_px": own.x, "x_stderr_px": own.x_stderr, "y_px": own.y, "y_stderr_px": own.y_stderr,
        **_lengths(widths, pitch),
        "azimuth_deg": own.azimuth, "azimuth_stderr_deg": own.azimuth_stderr,
        "background_dn": own.background, "background_stderr_dn": own.background_stderr,
        "area_inside": own.area_fraction, "whole": own.is_whole, "settled": own.has_converged,
        "measured": own.is_measured,
    }  # fmt: skip
    return {
        "name": one.name, "rows": one.rows, "columns": one.columns, "z_m": one.z_m,
        "second_moments": moments if math.isfinite(own.x) else None,
        "gaussian_fit": _fit(one, pitch),
        "highest_dn": one.highest_dn, "clipped_px": one.clipped_px, "stop_dn": one.stop_dn,
        "d4sigma_widened_by_clip": one.widened, "misfit_of_peak": one.misfit, "left_out": one.left_out,
        "beware": [words.said(own) for own in words.beware(one)],
    }  # fmt: skip


def _fit(one: Seen, pitch: float | None) -> dict[str, Any] | None:
    if one.fit is None:
        return None
    out: dict[str, Any] = {"status": str(one.fit.status), "chi2_reduced": float(one.fit.chi2_reduced)}
    for name in NAMES:
        unit = ENDINGS[PARAMETERS[name][0]]
        value, stderr = one.fitted_to(name)
        if name.startswith("sigma"):
            out |= _lengths({name: (value, stderr)}, pitch)
        else:
            out |= {f"{name}_{unit}": value, f"{name}_stderr_{unit}": stderr}
    return out


def _lengths(lengths: dict[str, tuple[float, float]], pitch: float | None) -> dict[str, float]:
    """Lengths with their errors in px, and in m where the pitch is known."""
    out: dict[str, float] = {}
    for unit, factor in (("px", 1.0), ("m", pitch)):
        for name, (value, stderr) in lengths.items():
            if factor is not None:
                out |= {f"{name}_{unit}": value * factor, f"{name}_stderr_{unit}": stderr * factor}
    return out


def _camera(own: Camera) -> dict[str, Any]:
    out: dict[str, Any] = {"black_level_dn": own.black_dn, "stop_dn": own.stop_dn, "how": own.how}
    for name, found in (("gain_dn_per_e", own.gain), ("read_noise_e", own.noise)):
        quantity, unit = name.split("_dn_per_e")[0].removesuffix("_e"), "dn_per_e" if found is own.gain else "e"
        out[name] = None if found is None else found.value
        out[f"{quantity}_stderr_{unit}"] = None if found is None else found.stderr
    return out


def _beam(own: Beam) -> dict[str, Any]:
    if own.why_not:
        return {"why_not": own.why_not, "left_out": list(own.left_out)}
    axes = {}
    for axis, found in own.caustics.items():
        numbers: dict[str, Any] = {"chi2_reduced": found.chi2_reduced, "scatter": found.scatter}
        for name, (unit, _) in QUANTITIES.items():
            numbers[f"{name}{OF_BEAM[unit]}"] = getattr(found, name)
            numbers[f"{name}_stderr{OF_BEAM[unit]}"] = getattr(found, f"{name}_stderr")
        numbers |= {"z_m": own.z.tolist(), "radius_m": own.radius[axis].tolist()}
        axes[axis] = numbers | {"radius_stderr_m": own.stderr[axis].tolist()}
    return {"axes": axes, "left_out": list(own.left_out)}


def _known(content: Any) -> Any:
    """The same without NaN and infinity, which JSON does not have."""
    if isinstance(content, dict):
        return {key: _known(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_known(value) for value in content]
    if isinstance(content, bool | int | str) or content is None:
        return content
    value = float(content)
    return value if math.isfinite(value) else None
