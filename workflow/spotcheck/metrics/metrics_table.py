"""The metrics stage: compute the metrics of measured and simulated crops by the same functions (metrics.nc).

The grid has a dimension for each axis of the dataset: angle, exposure, repeat and declared conditions. A condition is a
cell of the grid without its repeat. crops.nc has two crops of each cell, along the dimension `centring`: "light" around
the centroid of the light, "maximum" around the brightest pixel. `top` and `left` are the place of a crop on the sensor.
A crop is usable if its `status`, an integer of flags (bits), has none of `store.UNUSABLE`. fits.nc has a fit of each
crop by each method along the dimension `fit`: "least_squares" or "likelihood". Its attribute `preferred` names the
method that later stages use, in the crops centred on the light (`select_preferred_fits`).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.crops.cropping import is_usable, iterate_cells
from spotcheck.errors import InputError
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.variables import add_variable
from spotcheck.io import progress, store
from spotcheck.metrics.crop_metrics import CONTAINER_RANGE, PER_IMAGE, psnr, shift_image

SOURCES = ("measured", "simulated")
# Fit parameters that are copied from fits.nc → unit.
FIT_PARAMETERS = {"amplitude": "DN", "sigma_mean": "pixel"}
# How the simulated crop is aligned with the measured one for PSNR: both are cut around their maximum, or the simulated
# one is shifted so that the fitted centres agree.
REGISTRATIONS = ("maximum", "fitted")
# Ranges to which PSNR is scaled: 65535 DN of the 16-bit container, or the largest reading of the sensor.
DATA_RANGES = ("container", "sensor")

# Position along each dimension of the grid.
Index = dict[str, int]
# Function from the index of a measured frame to that of the frame it is compared with; None if there is none.
FindPartner = Callable[[Index], Index | None]


class FrameSource(NamedTuple):
    """Crops and fits of measured or simulated frames."""

    crops: xr.Dataset  # crops.nc
    fits: xr.Dataset  # fits.nc

    def is_usable_at(self, index: Index) -> bool:
        """Return whether the crops of a frame are usable in every centring."""
        return all(is_usable(status) for status in self.crops["status"].isel(index).values)

    def maximum_at(self, index: Index) -> np.ndarray:
        """Return the crop of a frame around its brightest pixel [y, x] in DN."""
        return self.crops["image"].sel(centring="maximum").isel(index).values

    def spot_at(self, index: Index) -> tuple[np.ndarray, np.ndarray]:
        """Return the crop of a frame centred on the light [y, x] in DN, and its fitted centre (row, column).

        The centre is that of the preferred fit [px from the centre of the first pixel of the crop]; NaN without a fit.
        """
        crop, fit = self.crops.sel(centring="light").isel(index), select_preferred_fits(self.fits).isel(index)
        # Fitted centres are positions on the sensor.
        centre = (float(fit["y_centre"]) - float(crop["top"]), float(fit["x_centre"]) - float(crop["left"]))
        return crop["image"].values, np.array(centre)


def compute_metrics(crops: dict[str, xr.Dataset], fits: dict[str, xr.Dataset], full_scale: float) -> xr.Dataset:
    """Return metrics.nc: metrics of measured and simulated crops, PSNR between them, and averages over repeats.

    Parameters
    ----------
    crops, fits : dict
        crops.nc and fits.nc of each of `SOURCES`, on one grid with the dimension `repeat`.
    full_scale : float
        Largest reading of the sensor [DN], one of the two data ranges of PSNR.

    Returns
    -------
    Dataset
        - each metric of `PER_IMAGE` [source, grid..., centring]; NaN for an unusable crop.
        - each of `FIT_PARAMETERS`, and `status` of the fits [source, grid..., centring, fit].
        - `psnr` [grid..., registration, data_range] in dB: a measured frame against the simulated one.
        - `psnr_repeats`, of the same shape: a measured frame against the next measured repeat; NaN without one.
        - NAME_mean and NAME_sd of each but the status: mean and standard deviation (n − 1) over repeats.

        The attributes title, dataset, not_recorded and preferred are copied.

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
    _copy_fits(ds, fits, dims)
    frames = {source: FrameSource(crops[source], fits[source]) for source in SOURCES}
    # Variable → words, frames with which measured ones are compared, and how the partner of a frame is found.
    comparisons = {
        "psnr": ("measured against simulated", frames["simulated"], lambda index: index),
        "psnr_repeats": ("a measured frame against the next repeat", frames["measured"], _next_repeat(measured, grid)),
    }
    for name, (text, other, find_partner) in comparisons.items():
        values = _compute_psnr(frames["measured"], other, find_partner, grid, full_scale)
        text = f"peak signal-to-noise ratio of {text}"
        add_variable(ds, name, (*grid, "registration", "data_range"), values, "dB", text)
        # Explains infinite values to readers of the file.
        ds[name].attrs["infinite"] = "both frames are alike to the last digit"
    return _add_averages(ds).assign_attrs(preferred=fits["measured"].attrs["preferred"])


def _copy_fits(ds: xr.Dataset, fits: dict[str, xr.Dataset], dims: tuple[str, ...]) -> None:
    """Add `FIT_PARAMETERS` and the status of all fits [source, dims..., fit] to `ds`; `dims` are grid and centring."""
    measured = fits["measured"]
    ds["fit"] = measured["fit"]
    for name in (*FIT_PARAMETERS, "status"):
        both = np.stack([fits[source][name].transpose(*dims, "fit").values for source in SOURCES])
        attrs = store.status_attributes()
        if name != "status":
            attrs = {"units": FIT_PARAMETERS[name], "long_name": str(measured[name].attrs["long_name"])}
        ds[name] = (("source", *dims, "fit"), both, attrs)


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


def _next_repeat(crops: xr.Dataset, grid: tuple[str, ...]) -> FindPartner:
    """Return a function from the index of a usable frame to that of the next usable repeat of its condition.

    The first repeat follows the last one. The function returns None for the only usable repeat. `crops` are those of
    the measured frames, `grid` the dimensions of the grid.
    """
    usable = (crops["status"] & store.UNUSABLE == 0).all("centring").transpose(*grid)

    def find_partner(index: Index) -> Index | None:
        """Return the index of the next usable repeat, or None; the frame at `index` must be usable itself."""
        condition_index = {dim: position for dim, position in index.items() if dim != "repeat"}
        repeats = np.flatnonzero(usable.isel(condition_index).values)
        later = repeats[repeats > index["repeat"]]
        partner = int(later[0] if later.size else repeats[0])
        return None if partner == index["repeat"] else condition_index | {"repeat": partner}

    return find_partner


def _compute_psnr(
    measured: FrameSource, other: FrameSource, find_partner: FindPartner, grid: tuple[str, ...], full_scale: float
) -> np.ndarray:
    """Return PSNR [grid..., registration, data range] in dB between each measured frame and its partner in `other`.

    `find_partner` gives the index of the partner, or None. The data ranges are that of the container and `full_scale`
    [DN], the largest reading of the sensor. NaN without a partner, if a crop of either frame is unusable in any
    centring, and for "fitted" if either has no fit.
    """
    values = np.full((*(measured.crops.sizes[dim] for dim in grid), len(REGISTRATIONS), len(DATA_RANGES)), np.nan)
    for index in iterate_cells(measured.crops, grid):
        if not measured.is_usable_at(index):
            continue
        partner = find_partner(index)
        if partner is None or not other.is_usable_at(partner):
            continue
        # Pairs of images in the order of `REGISTRATIONS`.
        pairs = [(measured.maximum_at(index), other.maximum_at(partner))]
        (image, centre), (other_image, other_centre) = measured.spot_at(index), other.spot_at(partner)
        shift = centre - other_centre
        if np.isfinite(shift).all():
            pairs.append((image, shift_image(other_image, *map(float, shift))))
        for k, images in enumerate(pairs):
            ratios = [psnr(*images, data_range=data_range) for data_range in (CONTAINER_RANGE, full_scale)]
            values[(*index.values(), k)] = ratios
    return values


def _add_averages(ds: xr.Dataset) -> xr.Dataset:
    """Add NAME_mean and NAME_sd over repeats of each metric, fit parameter and PSNR, and return the same dataset.

    Values that are NaN or infinite are left out; the standard deviation of fewer than two values is NaN.
    """
    for name in (*(metric.name for metric in PER_IMAGE), *FIT_PARAMETERS, "psnr", "psnr_repeats"):
        attrs = ds[name].attrs
        finite = ds[name].where(np.isfinite(ds[name]))
        for suffix, text, statistic in (
            ("mean", "mean over repeats", finite.mean("repeat")),
            ("sd", "standard deviation (n - 1) over repeats", finite.std("repeat", ddof=1)),
        ):
            long_name = f"{attrs['long_name']}, {text}"
            ds[f"{name}_{suffix}"] = statistic.assign_attrs(units=attrs["units"], long_name=long_name)
    return ds
