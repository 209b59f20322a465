"""Parameters of the simulation with their sources, as in Table 3 of the paper.

The width of the spot at the exposure t is p1 ln t + p2 [px]. A site is a place on the sample with its own p1 and p2.
Numbers on the page are marked text: HTML that shows the source of a number on hover.
"""

from operator import attrgetter
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.io.number_text import quantity_text
from spotcheck.model.spot import TOP_HAT_RADIUS
from spotcheck.report.pages.citations import Citations

# Parameters of the instrument file: name, symbol ("–" for none), unit, key of instrument.yaml.
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
# Symbols of the variables of sensor.nc that are parameters.
SENSOR_SYMBOLS = {"gain_dn_per_e": "K", "read_noise_e": "σ_d", "dark_current_e_per_s": "µ_I"}


class ParameterRow(NamedTuple):
    """A row of the table of parameters."""

    name: str  # the parameter in words
    symbol: tuple[str, str]  # (symbol, subscript); the subscript is "" if there is none
    value: str  # value with its unit, as marked text
    source: str  # file or method from which the value is; "" if there is no value


def tabulate_parameters(dataset: Dataset, files: dict[str, xr.Dataset], citations: Citations) -> list[ParameterRow]:
    """Return a row for each parameter of the simulation; those of skipped stages are omitted.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    files : dict of str to Dataset
        netCDF results by file name without suffix, without skipped ones.
    citations : Citations
        Marks numbers with their sources.
    """

    def row(name: str, symbol: str, value: float | str | None, unit: str, source: str, key: str = "") -> ParameterRow:
        """Return a row; a value that is text includes its unit, and `key` is its name for `spotcheck explain`."""
        letter, _, subscript = symbol.partition("_")
        marked_text = citations.cite(_value_text(value, unit), key)
        return ParameterRow(name, (letter, subscript), marked_text, "" if value is None else source)

    instrument = dataset.instrument
    rows = [
        row(name, symbol, attrgetter(key)(instrument), unit, instrument.get_source(key), f"instrument.{key}")
        for name, symbol, unit, key in STATED
    ]
    if instrument.model.top_hat:
        rows.append(row("Top hat radius", "r_TH", TOP_HAT_RADIUS, "1", "Eq. 40"))
    if "sensor" in files:
        for name, symbol in SENSOR_SYMBOLS.items():
            variable = files["sensor"][name]
            long_name = variable.attrs["long_name"]
            title = long_name[:1].upper() + long_name[1:]
            unit, source = variable.attrs["units"], variable.attrs["source"]
            rows.append(row(title, symbol, float(variable), unit, source, f"sensor.{name}"))
    if dataset.exposures:
        times = ", ".join(quantity_text(exposure, None, "s") for exposure in dataset.exposures)
        rows.append(row("Exposure times", "t_exp", times, "", "manifest.csv"))
    if "calibration" in files:
        # The estimate of p1, p2 and the peak that the simulation uses.
        used = files["calibration"].sel(estimator=files["calibration"].attrs["used"])
        for name, kind in (("p1", "factor"), ("p2", "offset")):
            # Mean ± standard deviation over all sites.
            text = quantity_text(float(used[f"{name}_mean"]), float(used[f"{name}_sd_all"]), "px")
            source, key = "calibrated; ± standard deviation over all sites", f"calibration.{name}_mean"
            rows.append(row(f"Beam propagation {kind}", name, text, "", source, key))
        peak = float(used["peak"])
        rows.append(row("Peak at the longest exposure", "–", peak, "DN", "calibrated", "calibration.peak"))
    return rows


def _value_text(value: float | str | None, unit: str) -> str:
    """Return a value with its unit as text; None becomes "not given", NaN "unknown". Text is returned unchanged."""
    if value is None:
        return "not given"
    if isinstance(value, str):
        return value
    return "unknown" if np.isnan(value) else quantity_text(value, None, unit)
