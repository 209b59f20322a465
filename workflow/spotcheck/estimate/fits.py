"""The fit stage: every crop of a file, one at a time."""

import numpy as np
import xarray as xr

from spotcheck import store
from spotcheck.crops import cells, usable
from spotcheck.estimate.spotfit import NO_FIT, PARAMETERS, SpotFit, fit_spot
from spotcheck.model.sensor import SensorModel


def exposure_of(ds: xr.Dataset, index: dict[str, int]) -> float:
    """Exposure [s] of a cell; 0 where it was not recorded, so that no dark current is counted."""
    return float(ds["exposure"][index["exposure"]]) if "exposure" in ds.coords else 0.0


def fit_crops(crops: xr.Dataset, sensor: SensorModel | None) -> xr.Dataset:
    """Fits of both centrings: values, standard errors, χ² and status on the grid; centres in pixels of the sensor."""
    dims = (*store.grid_dims(crops), "centring")
    shape = tuple(crops.sizes[d] for d in dims)
    value, stderr = (np.full((*shape, len(PARAMETERS)), np.nan) for _ in range(2))
    chi2, status = np.full(shape, np.nan), crops["status"].values.copy()
    top, left = crops["top"].values, crops["left"].values
    for index in cells(crops, dims):
        at = tuple(index.values())
        if not usable(status[at]):
            continue
        fit = fit_spot(crops["image"].isel(index).values, exposure_of(crops, index), sensor)
        value[at], stderr[at], chi2[at] = fit.value, fit.stderr, fit.chi2_reduced
        value[(*at, 1)] += left[at]
        value[(*at, 2)] += top[at]
        status[at] |= fit.status
    keep = [name for name in crops.coords if set(crops[name].dims) <= set(dims)]
    ds = xr.Dataset(coords={name: crops[name] for name in keep}, attrs=_titles(crops))
    for k, (name, (units, long_name)) in enumerate(PARAMETERS.items()):
        ds[name] = (dims, value[..., k], {"units": units, "long_name": long_name})
        ds[f"{name}_stderr"] = (
            dims,
            stderr[..., k],
            {"units": units, "long_name": f"standard error of {long_name}"},
        )
    ds["chi2_reduced"] = (
        dims,
        chi2,
        {"units": "1", "long_name": "chi-square per degree of freedom under sensor noise"},
    )
    ds["status"] = (dims, status.astype("i4"), store.status_attributes())
    return ds


def fit_in_crop(fits: xr.Dataset, crops: xr.Dataset, index: dict[str, int]) -> SpotFit:
    """A stored fit with its centre relative to the crop again."""
    at = fits.isel(index)
    if not np.isfinite(float(at["amplitude"])):
        return NO_FIT
    value = np.array([float(at[name]) for name in PARAMETERS])
    value[1] -= float(crops["left"].isel(index))
    value[2] -= float(crops["top"].isel(index))
    stderr = np.array([float(at[f"{name}_stderr"]) for name in PARAMETERS])
    return SpotFit(value, stderr, float(at["chi2_reduced"]), int(at["status"]))


def _titles(ds: xr.Dataset) -> dict[str, str]:
    return {name: ds.attrs[name] for name in ("title", "dataset", "not_recorded")}
