"""The truth file: what the rig put in. No stage of the analysis reads it."""

from __future__ import annotations

import json
import math
from typing import Any

from rig import exposure, photons, settings, speckle
from rig.exposure import LitSite


def site_truth(rig: settings.Settings, lit: LitSite) -> dict[str, Any]:
    """One site and its frames, as plain numbers."""
    spot = lit.spot
    place: dict[str, Any] = {"site": lit.site.index, "kind": lit.site.shots[0].kind}
    if spot is not None:
        sigma_long, sigma_short = spot.sigmas_px
        covariance = spot.covariance_px2
        place |= {
            "angle_deg": spot.angle_deg,
            "repeat": lit.site.shots[0].repeat,
            "x_px": spot.x_px,
            "y_px": spot.y_px,
            "sigma_long_px": sigma_long,
            "sigma_short_px": sigma_short,
            "covariance_px2": covariance.tolist(),
            "relative_light": spot.relative_light,
            "site_reflectance": spot.site_reflectance,
            "site_spread": spot.site_spread,
            "light_with_speckle": float(lit.irradiance.sum()),
        }
    place["frames"] = [_frame_truth(rig, lit, index) for index in range(len(lit.site.shots))]
    return place


def whole_truth(rig: settings.Settings, sites: list[dict[str, Any]]) -> dict[str, Any]:
    """The truth of a dataset; refuses anything that is not finite plain JSON."""
    truth = {
        "what": "What the virtual rig put in. For people and tests; no stage of the analysis reads it.",
        "seed": rig.seed,
        "settings": settings.to_dict(rig),
        "derived": {
            "magnification": rig.optics.focal_length_m / rig.optics.working_distance_m,
            "photons_per_second": photons.reflected_photons(rig, 1.0),
            "speckle_grain_px": speckle.grain_px(rig),
            "clip_level_dn": None
            if rig.sensor.clip_level_e is None
            else rig.sensor.clip_level_e * rig.sensor.gain_dn_per_e + rig.sensor.black_level_dn,
        },
        "sites": sites,
    }
    json.dumps(truth, allow_nan=False)
    return truth


def _frame_truth(rig: settings.Settings, lit: LitSite, index: int) -> dict[str, Any]:
    shot = lit.site.shots[index]
    spot_photons = exposure.spot_photons(rig, lit, shot)
    frame: dict[str, Any] = {
        "file": shot.file,
        "exposure_s": exposure.exposure_s(rig, shot),
        "exposure_recorded": shot.exposure_s is not None,
        "photons": spot_photons,
        "dark_e_per_px": rig.sensor.dark_current_e_per_s * exposure.exposure_s(rig, shot),
    }
    if lit.spot is not None:
        sigma_long, sigma_short = lit.spot.sigmas_px
        peak_e = spot_photons * rig.sensor.quantum_efficiency / (2.0 * math.pi * sigma_long * sigma_short)
        frame["peak_without_speckle_dn"] = peak_e * rig.sensor.gain_dn_per_e
        if rig.sensor.clip_level_e is not None:
            frame["peak_over_clip_level"] = peak_e / rig.sensor.clip_level_e
    if shot.kind == "flat":
        frame["photons_per_px"] = shot.other("photons_per_px")
    return frame
