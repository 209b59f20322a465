"""Parameters of the sensor of a dataset: collects the evidence of crops, darks and pairs of frames."""

from collections.abc import Mapping

import xarray as xr

from spotcheck.characterization.dark_frames import select_dark_levels
from spotcheck.characterization.emva_quantities import Quantity
from spotcheck.characterization.frame_pairs import iterate_pairs
from spotcheck.characterization.sensor_choice import choose_sensor_values
from spotcheck.crops.cropping import is_usable, iterate_cells
from spotcheck.crops.ingest import read_full_scale
from spotcheck.dataset import frames
from spotcheck.dataset.folder import Dataset
from spotcheck.io import store


def choose_dataset_sensor(
    dataset: Dataset, crops: xr.Dataset, table: xr.Dataset, measured: Mapping[str, Quantity]
) -> xr.Dataset:
    """Return the content of sensor.nc: every parameter of the sensor with its standard error and source.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    crops, table : xr.Dataset
        Content of crops.nc and frames.nc.
    measured : mapping of str to Quantity
        Photon transfer of flats and darks, by name; empty without them.
    """
    centred = crops.sel(centring="light")
    images = (
        centred["image"].isel(index).values
        for index in iterate_cells(centred, store.grid_dims(crops))
        if is_usable(centred["status"].isel(index))
    )
    darks = (
        frames.reduce_frame(frames.read_masked_image(dataset, frame))
        for frame in dataset.frames
        if frame.kind == "dark"
    )
    surrounds = (
        frames.ReducedFrame(*(crops[name].isel(index).values for name in frames.ReducedFrame._fields))
        for index in iterate_cells(crops, store.grid_dims(crops))
    )
    dark = select_dark_levels(darks, surrounds, float(table["full_scale"]))
    pairs = {"exposures of a site": iterate_pairs(centred, "exposure"), "repeats": iterate_pairs(centred, "repeat")}
    highest_dn = float(table["maximum"].max())
    return choose_sensor_values(dataset, read_full_scale(table), images, dark, measured, pairs, highest_dn)
