"""The metrics stage: measured and simulated frames side by side, by the same functions."""

import numpy as np
import xarray as xr

from spotcheck.crops.stages import cells, usable
from spotcheck.errors import InputError
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.io import progress, store
from spotcheck.metrics import crop_metrics as metrics
from spotcheck.metrics.crop_metrics import PER_IMAGE

SOURCES = ("measured", "simulated")
FROM_FIT = {"amplitude": "DN", "sigma_mean": "pixel"}
REGISTRATIONS = ("maximum", "fitted")
RANGES = ("container", "sensor")


def metrics_of_both(crops: dict[str, xr.Dataset], fits: dict[str, xr.Dataset], full_scale: float) -> xr.Dataset:
    """Metrics of both sources on the grid, PSNR between them, and means and standard deviations (n − 1) over
    repeats. Raises `InputError` where a declared condition bears the name of a metric."""
    measured = crops["measured"]
    grid = store.grid_dims(measured)
    if taken := [own.name for own in PER_IMAGE if own.name in grid]:
        raise InputError(f"instrument.yaml: key conditions names {taken[0]}, which is a metric; rename it")
    dims = ("source", *grid, "centring")
    shape = (2, *(measured.sizes[d] for d in dims[1:]))
    fit_dims = (*dims, "fit")
    values = {own.name: np.full(shape, np.nan) for own in PER_IMAGE}
    for s, source in enumerate(SOURCES):
        status = crops[source]["status"].values
        for index in progress.over(list(cells(crops[source], dims[1:])), f"metrics of {source} frames"):
            at = tuple(index.values())
            if usable(status[at]):
                image = crops[source]["image"].isel(index).values
                for own in PER_IMAGE:
                    values[own.name][(s, *at)] = own.function(image)
    coords = {d: measured[d] for d in dims[1:] if d in measured.coords}
    ds = xr.Dataset(coords=coords, attrs={n: measured.attrs[n] for n in ("title", "dataset", "not_recorded")})
    for name, labels, long_name in (
        ("source", SOURCES, "where the frames come from"),
        ("registration", REGISTRATIONS, "how the two crops are laid over each other"),
        ("data_range", RANGES, "range that PSNR is scaled to: 65535 of the container, or the sensor's own"),
    ):
        ds[name] = (name, np.array(labels, dtype=object), {"units": "1", "long_name": long_name})
    for own in PER_IMAGE:
        ds[own.name] = (dims, values[own.name], {"units": own.units, "long_name": own.long_name})
    ds["fit"] = fits["measured"]["fit"]
    for name, units in FROM_FIT.items():
        ds[name] = (
            fit_dims,
            np.stack([fits[s][name].transpose(*fit_dims[1:]).values for s in SOURCES]),
            {"units": units, "long_name": str(fits["measured"][name].attrs["long_name"])},
        )
    ds["psnr"] = (
        (*grid, "registration", "data_range"),
        _psnr(crops, fits, grid, full_scale),
        {
            "units": "dB",
            "long_name": "peak signal-to-noise ratio of measured against simulated",
            "infinite": "both frames are alike to the last digit",
        },
    )
    ds["status"] = (
        fit_dims,
        np.stack([fits[s]["status"].transpose(*fit_dims[1:]).values for s in SOURCES]),
        store.status_attributes(),
    )
    return _with_averages(ds).assign_attrs(preferred=fits["measured"].attrs["preferred"])


def _psnr(crops: dict, fits: dict, grid: tuple[str, ...], full_scale: float) -> np.ndarray:
    measured, simulated = crops["measured"], crops["simulated"]
    out = np.full((*(measured.sizes[d] for d in grid), 2, 2), np.nan)
    ranges = (metrics.CONTAINER_RANGE, full_scale)
    for index in cells(measured, grid):
        at = tuple(index.values())
        states = [c["status"].isel(index).values for c in (measured, simulated)]
        if not all(usable(s) for state in states for s in state):
            continue
        image, reference = (c["image"].sel(centring="maximum").isel(index).values for c in (measured, simulated))
        out[(*at, 0)] = [metrics.psnr(reference, image, r) for r in ranges]
        registered = _registered(crops, fits, index)
        if registered is not None:
            image, reference = registered
            out[(*at, 1)] = [metrics.psnr(reference, image, r) for r in ranges]
    return out


def _registered(crops: dict, fits: dict, index: dict[str, int]) -> tuple[np.ndarray, np.ndarray] | None:
    """Measured crop, and the simulated one moved so that both fitted centres coincide."""
    images, centres = [], []
    for source in SOURCES:
        own, fit = crops[source].sel(centring="light").isel(index), select_preferred_fits(fits[source]).isel(index)
        images.append(own["image"].values)
        centres.append((float(fit["y_centre"]) - float(own["top"]), float(fit["x_centre"]) - float(own["left"])))
    rows, columns = (measured - simulated for measured, simulated in zip(*centres, strict=True))
    if not np.isfinite(rows + columns):
        return None
    return images[0], metrics.shifted(images[1], rows, columns)


def _with_averages(ds: xr.Dataset) -> xr.Dataset:
    for name in (*(own.name for own in PER_IMAGE), *FROM_FIT, "psnr"):
        attrs = ds[name].attrs
        finite = ds[name].where(np.isfinite(ds[name]))
        for suffix, text, result in (
            ("mean", "mean over repeats", finite.mean("repeat")),
            ("sd", "standard deviation (n - 1) over repeats", finite.std("repeat", ddof=1)),
        ):
            ds[f"{name}_{suffix}"] = result.assign_attrs(
                units=attrs["units"], long_name=f"{attrs['long_name']}, {text}"
            )
    return ds
