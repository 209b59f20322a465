"""Scans along a beam that several tests make: fits.nc of spots of given widths, and the instrument."""

import numpy as np
import xarray as xr

from spotcheck.dataset.instrument import Instrument, Laser, Sensor
from spotcheck.fitting.beam_axes import SpotWidths
from spotcheck.fitting.scan_widths import WIDTH_PARAMETERS
from spotcheck.io import store

WAVELENGTH, PITCH = 632.8e-9, 3.75e-6
INSTRUMENT = Instrument(conditions=("z_m",), laser=Laser(wavelength_m=WAVELENGTH), sensor=Sensor(pixel_pitch_m=PITCH))


def radius_of(z, waist: float, position: float, m2: float = 1.0) -> np.ndarray:
    """1/e² radius [m] of a beam at places z [m] (ISO 11146-1)."""
    return waist * np.hypot(1, (z - position) * m2 * WAVELENGTH / (np.pi * waist**2))


def round_spots(sigma_px, stderr_px: float = 0.01) -> SpotWidths:
    """Widths of round spots, whose direction is unknown."""
    sigma = np.asarray(sigma_px, float)
    error, none = np.full(sigma.shape, stderr_px), np.zeros(sigma.shape)
    return SpotWidths(sigma, sigma, none, error, error, none + np.inf)


def fits_of_scan(z, spots: SpotWidths) -> xr.Dataset:
    """A fits file of spots at places z [m]."""
    attrs = {"title": "scan", "dataset": "scan", "not_recorded": "exposure", "preferred": "likelihood"}
    ds = xr.Dataset(attrs=attrs)
    for name, values in (("z_m", np.asarray(z, float)), ("centring", ["light"]), ("fit", ["likelihood"])):
        ds[name] = (name, values, {"units": "1", "long_name": name})
    dims, shape = ("angle", "exposure", "repeat", "z_m", "centring", "fit"), (1, 1, 1, len(z), 1, 1)
    mean = (spots.major + spots.minor) / 2, np.hypot(spots.major_stderr, spots.minor_stderr) / 2
    names = [f"{name}{suffix}" for suffix in ("", "_stderr") for name in WIDTH_PARAMETERS]
    for name, values in zip([*names, "sigma_mean", "sigma_mean_stderr"], [*vars(spots).values(), *mean], strict=True):
        ds[name] = (dims, values.reshape(shape), {"units": "pixel", "long_name": name})
    ds["status"] = (dims, np.zeros(shape, "i4"), store.status_attributes())
    return ds
