"""Table 3 of the paper for any dataset: the parameters that the simulation ran on, and where each comes from."""

from operator import attrgetter
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.discrepancy.words import value_text
from spotcheck.report.pages.cited import Cited

# Of the data sheet: parameter, symbol, unit, and key.
STATED = (
    ("Focal length", "f", "m", "optics.focal_length_m"),
    ("Working distance", "d_w", "m", "optics.working_distance_m"),
    ("Aperture f-number", "f_a", "1", "optics.f_number"),
    ("Filter transmission", "ϱ_f", "1", "optics.filter_transmission"),
    ("Pixel pitch", "s_px", "m", "sensor.pixel_pitch_m"),
    ("Bits of the converter", "–", "bit", "sensor.bit_depth"),
    ("Laser power", "P_L", "W", "laser.power_w"),
    ("Laser wavelength", "λ_la", "m", "laser.wavelength_m"),
    ("Laser FWHM, x", "FWHM_x", "m", "laser.fwhm_x_m"),
    ("Laser FWHM, y", "FWHM_y", "m", "laser.fwhm_y_m"),
    ("Material reflection", "ϱ_m", "1", "material.reflectance"),
    ("Side of the crop", "–", "px", "crop_px"),
    ("Photon budget", "–", "", "model.photon_budget"),
)
# Of sensor.nc: variable and symbol.
SENSOR = (("gain_dn_per_e", "K"), ("read_noise_e", "σ_d"), ("dark_current_e_per_s", "µ_I"))


class Row(NamedTuple):
    """A parameter; `key` is what `spotcheck explain` knows its number by."""

    name: str
    symbol: str
    value: float | str | None
    unit: str
    source: str
    key: str


def parameters(
    dataset: Dataset, files: dict[str, xr.Dataset], top_hat_radius: float, cite: Cited
) -> list[tuple[str, str, str, str, str]]:
    """Rows (parameter, symbol, its index, value with unit, source)."""
    given = dataset.instrument
    rows = [
        Row(name, symbol, attrgetter(key)(given), unit, given.get_source(key), f"instrument.{key}")
        for name, symbol, unit, key in STATED
    ]
    if given.model.top_hat:
        rows.append(Row("Top hat radius", "r_TH", top_hat_radius, "1", "Eq. 40", ""))
    if "sensor" in files:
        sensor = files["sensor"]
        for name, symbol in SENSOR:
            told = sensor[name].attrs
            words = _sentence(told["long_name"])
            rows.append(Row(words, symbol, float(sensor[name]), told["units"], told["source"], f"sensor.{name}"))
    if exposures := dataset.exposures:
        rows.append(
            Row(
                "Exposure times",
                "t_exp",
                ", ".join(value_text(t, None, "s") for t in exposures),
                "",
                "manifest.csv",
                "",
            )
        )
    calibration = files.get("calibration")
    if calibration is not None and "skipped" not in calibration.attrs:
        own = calibration.sel({"estimator": calibration.attrs["used"]})
        for name in ("p1", "p2"):
            text = value_text(float(own[f"{name}_mean"]), float(own[f"{name}_sd_all"]), "px")
            what = f"Beam propagation {'factor' if name == 'p1' else 'offset'}"
            rows.append(Row(what, name, text, "", "calibrated; ± sd over all sites", f"calibration.{name}_mean"))
        peak = float(own["peak"])
        rows.append(Row("Peak at the longest exposure", "–", peak, "DN", "calibrated", "calibration.peak"))
    return [
        (own.name, *_split(own.symbol), cite(_text(own), own.key), "" if own.value is None else own.source)
        for own in rows
    ]


def _sentence(text: str) -> str:
    """First letter in upper case, the symbols left alone."""
    return text[:1].upper() + text[1:]


def _split(symbol: str) -> tuple[str, str]:
    """A symbol and its index."""
    sign, _, index = symbol.partition("_")
    return sign, index


def _text(own: Row) -> str:
    if own.value is None:
        return "not given"
    if isinstance(own.value, str):
        return own.value
    return "unknown" if np.isnan(own.value) else value_text(own.value, None, own.unit)
