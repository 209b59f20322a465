"""The metrics stage: compute the metrics of measured and simulated crops by the same functions (metrics.nc).

The grid has a dimension for each axis of the dataset: angle, exposure, repeat and declared conditions. crops.nc has two
crops of each cell, along the dimension `centring`: "light" around the centroid of the light, "maximum" around the
brightest pixel.
"""

import numpy as np
import xarray as xr

from spotcheck.crops.cropping import is_usable, iterate_cells
from spotcheck.errors import InputError
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.variables import add_variable
from spotcheck.io import progress, store
from spotcheck.metrics.crop_metrics import CONTAINER_RANGE, PER_IMAGE, psnr, shift_image

SOURCES = ("measured", "simulated")
# Parameters that are copied from fits.nc → unit.
FIT_PARAMETERS = {"amplitude": "DN", "sigma_mean": "pixel"}
# How the simulated crop is aligned with the measured one for PSNR: both are cut around their maximum, or the simulated
# one is shifted so that the fitted centres agree.
REGISTRATIONS = ("maximum", "fitted")
# Ranges to which PSNR is scaled: 65535 DN of the 16-bit container, or the largest reading of the sensor.
DATA_RANGES = ("container", "sensor")


def compute_metrics(crops: dict[str, xr.Dataset], fits: dict[str, xr.Dataset], full_scale: float) -> xr.Dataset:
    """Return the metrics of measured and simulated crops, PSNR between them, and averages over repeats.

    Parameters
    ----------
    crops, fits : dict
        crops.nc and fits.nc of each of `SOURCES`, on one grid with the dimension `repeat`.
    full_scale : float
        Largest reading of the sensor [DN], one of the two data ranges of PSNR.

    Returns
    -------
    Dataset
        Contents of metrics.nc: metrics [source, grid..., centring], fit parameters and status [source, grid...,
        centring, fit], and PSNR [grid..., registration, data_range]. All but the status also have NAME_mean and
        NAME_sd, the mean and the standard deviation (n − 1) over repeats.

    Raises
    ------
    InputError
        If a condition that instrument.yaml declares, which is a dimension of the grid, has the name of a metric.
    """
    measured = crops["measured"]
    grid = store.grid_dims(measured)
    if clashes := [metric.name for metric in PER_IMAGE if metric.name in grid]:
        raise InputError(f"instrument.yaml: key conditions names {clashes[0]}, which is a metric; rename it")
    dims = (*grid, "centring")
    # `not_recorded` names the dimensions that have no coordinate because the manifest leaves the column blank.
    coords = {dim: measured[dim] for dim in dims if dim in measured.coords}
    ds = xr.Dataset(coords=coords, attrs={name: measured.attrs[name] for name in ("title", "dataset", "not_recorded")})
    for name, labels, long_name in (
        ("source", SOURCES, "where the frames come from"),
        ("registration", REGISTRATIONS, "how the two crops are laid over each other"),
        ("data_range", DATA_RANGES, "range that PSNR is scaled to: 65535 of the container, or the sensor's own"),
    ):
        add_variable(ds, name, name, np.array(labels, dtype=object), "1", long_name)
    values = np.stack([_measure_crops(crops[source], dims, source) for source in SOURCES])
    for k, metric in enumerate(PER_IMAGE):
        add_variable(ds, metric.name, ("source", *dims), values[..., k], metric.units, metric.long_name)
    ds["fit"] = fits["measured"]["fit"]
    attributes = {
        name: {"units": units, "long_name": str(fits["measured"][name].attrs["long_name"])}
        for name, units in FIT_PARAMETERS.items()
    }
    for name, attrs in (attributes | {"status": store.status_attributes()}).items():
        both = [fits[source][name].transpose(*dims, "fit").values for source in SOURCES]
        ds[name] = (("source", *dims, "fit"), np.stack(both), attrs)
    text = "peak signal-to-noise ratio of measured against simulated"
    psnr_dims = (*grid, "registration", "data_range")
    add_variable(ds, "psnr", psnr_dims, _compute_psnr(crops, fits, grid, full_scale), "dB", text)
    # Explains infinite values to readers of the file.
    ds["psnr"].attrs["infinite"] = "both frames are alike to the last digit"
    return _add_averages(ds).assign_attrs(preferred=fits["measured"].attrs["preferred"])


def _measure_crops(crops: xr.Dataset, dims: tuple[str, ...], source: str) -> np.ndarray:
    """Return the metrics [dims..., metric] of all usable crops of a source; NaN for the other crops.

    The last axis is in the order of `PER_IMAGE`; `dims` are the grid and the centring.
    """
    values = np.full((*(crops.sizes[dim] for dim in dims), len(PER_IMAGE)), np.nan)
    status = crops["status"].transpose(*dims).values
    for index in progress.track(list(iterate_cells(crops, dims)), f"metrics of {source} frames"):
        cell = tuple(index.values())
        if is_usable(status[cell]):
            image = crops["image"].isel(index).values
            values[cell] = [metric.function(image) for metric in PER_IMAGE]
    return values


def _compute_psnr(
    crops: dict[str, xr.Dataset], fits: dict[str, xr.Dataset], grid: tuple[str, ...], full_scale: float
) -> np.ndarray:
    """Return PSNR [grid..., registration, data range] in dB, with the range `full_scale` [DN] for the sensor.

    NaN unless the crops of both sources are usable in every centring, and for "fitted" unless both have a fit.
    """
    pair = [crops[source] for source in SOURCES]
    values = np.full((*(pair[0].sizes[dim] for dim in grid), len(REGISTRATIONS), len(DATA_RANGES)), np.nan)
    for index in iterate_cells(pair[0], grid):
        if not all(is_usable(status) for ds in pair for status in ds["status"].isel(index).values):
            continue
        at_maximum = [ds["image"].sel(centring="maximum").isel(index).values for ds in pair]
        for k, images in enumerate((at_maximum, _align_centres(crops, fits, index))):
            if images is not None:
                measured, simulated = images
                ratios = [psnr(simulated, measured, data_range) for data_range in (CONTAINER_RANGE, full_scale)]
                values[(*index.values(), k)] = ratios
    return values


def _align_centres(
    crops: dict[str, xr.Dataset], fits: dict[str, xr.Dataset], index: dict[str, int]
) -> list[np.ndarray] | None:
    """Return the measured crop, and the simulated one shifted so that its fitted centre lies on the measured one.

    Both are the crops [y, x] in DN that are centred on the light. None unless both have a fit.
    """
    # Fitted centres are in px of the crop.
    images, row_centres, column_centres = [], [], []
    for source in SOURCES:
        crop, fit = crops[source].sel(centring="light").isel(index), select_preferred_fits(fits[source]).isel(index)
        images.append(crop["image"].values)
        row_centres.append(float(fit["y_centre"]) - float(crop["top"]))
        column_centres.append(float(fit["x_centre"]) - float(crop["left"]))
    if not np.isfinite(row_centres + column_centres).all():
        return None
    return [images[0], shift_image(images[1], row_centres[0] - row_centres[1], column_centres[0] - column_centres[1])]


def _add_averages(ds: xr.Dataset) -> xr.Dataset:
    """Add NAME_mean and NAME_sd over repeats of each metric, fit parameter and PSNR, and return the same dataset.

    Values that are NaN or infinite are left out; the standard deviation of fewer than two values is NaN.
    """
    for name in (*(metric.name for metric in PER_IMAGE), *FIT_PARAMETERS, "psnr"):
        attrs = ds[name].attrs
        finite = ds[name].where(np.isfinite(ds[name]))
        for suffix, text, statistic in (
            ("mean", "mean over repeats", finite.mean("repeat")),
            ("sd", "standard deviation (n - 1) over repeats", finite.std("repeat", ddof=1)),
        ):
            long_name = f"{attrs['long_name']}, {text}"
            ds[f"{name}_{suffix}"] = statistic.assign_attrs(units=attrs["units"], long_name=long_name)
    return ds
