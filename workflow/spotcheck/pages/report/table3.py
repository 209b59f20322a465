"""Table 3 of the paper for any dataset: the parameters that the simulation ran on, and where each comes from."""

import numpy as np
import xarray as xr

from spotcheck.dataset import Dataset


def parameters(
    dataset: Dataset, files: dict[str, xr.Dataset], top_hat_radius: float
) -> list[tuple[str, str, str, str, str]]:
    """Rows (parameter, symbol, value, unit, source)."""
    given = dataset.instrument
    rows: list[tuple[str, str, float | str | None, str, str]] = [
        ("Focal length", "f", given.optics.focal_length_m, "m", given.source("optics.focal_length_m")),
        ("Working distance", "d_w", given.optics.working_distance_m, "m", given.source("optics.working_distance_m")),
        ("Aperture f-number", "f_a", given.optics.f_number, "1", given.source("optics.f_number")),
        (
            "Filter transmission",
            "ϱ_f",
            given.optics.filter_transmission,
            "1",
            given.source("optics.filter_transmission"),
        ),
        ("Pixel pitch", "s_px", given.sensor.pixel_pitch_m, "m", given.source("sensor.pixel_pitch_m")),
        ("Bits of the converter", "–", given.sensor.bit_depth, "bit", given.source("sensor.bit_depth")),
        ("Laser power", "P_L", given.laser.power_w, "W", given.source("laser.power_w")),
        ("Laser wavelength", "λ_la", given.laser.wavelength_m, "m", given.source("laser.wavelength_m")),
        ("Laser FWHM, x", "FWHM_x", given.laser.fwhm_x_m, "m", given.source("laser.fwhm_x_m")),
        ("Laser FWHM, y", "FWHM_y", given.laser.fwhm_y_m, "m", given.source("laser.fwhm_y_m")),
        ("Material reflection", "ϱ_m", given.material.reflectance, "1", given.source("material.reflectance")),
        ("Side of the crop", "–", given.crop_px, "px", given.source("crop_px")),
        ("Photon budget", "–", given.model.photon_budget, "", given.source("model.photon_budget")),
    ]
    if given.model.top_hat:
        rows.append(("Top hat radius", "r_TH", top_hat_radius, "1", "Eq. 40"))
    if "sensor" in files:
        sensor = files["sensor"]
        for name, symbol in (("gain_dn_per_e", "K"), ("read_noise_e", "σ_d"), ("dark_current_e_per_s", "µ_I")):
            variable = sensor[name]
            rows.append(
                (
                    _sentence(variable.attrs["long_name"]),
                    symbol,
                    float(variable),
                    variable.attrs["units"],
                    variable.attrs["source"],
                )
            )
    if exposures := dataset.exposures:
        rows.append(("Exposure times", "t_exp", ", ".join(f"{t:g}" for t in exposures), "s", "manifest.csv"))
    calibration = files.get("calibration")
    if calibration is not None and "skipped" not in calibration.attrs:
        own = calibration.sel({"estimator": calibration.attrs["used"]})
        for name in ("p1", "p2"):
            text = f"{float(own[f'{name}_mean']):.3f} ± {float(own[f'{name}_sd_all']):.3f}"
            rows.append((f"Beam propagation {'factor' if name == 'p1' else 'offset'}", name, text, "px", "calibrated"))
        rows.append(("Peak at the longest exposure", "–", float(own["peak"]), "DN", "calibrated"))
    return [(a, b, _text(value), unit, "" if value is None else source) for a, b, value, unit, source in rows]


def _sentence(text: str) -> str:
    """First letter in upper case, the symbols left alone."""
    return text[:1].upper() + text[1:]


def _text(value: float | str | None) -> str:
    if value is None:
        return "not given"
    if isinstance(value, str):
        return value
    return "unknown" if np.isnan(value) else f"{value:.5g}"
