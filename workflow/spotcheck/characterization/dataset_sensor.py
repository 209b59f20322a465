"""The `sensor` stage: reads crops, dark frames and pairs of frames of a dataset, and chooses the sensor's values.

A crop is a square image around a spot. crops.nc holds two crops of each frame (`centring`): one centred on the light,
one on the maximum. A cell is a place in the grid of conditions and repeats. A reduced frame consists of the means of
blocks, rows and columns of a whole frame [DN].
"""

from collections.abc import Mapping

import numpy as np
import xarray as xr

from spotcheck.characterization.dark_frames import select_dark_levels
from spotcheck.characterization.emva_quantities import Quantity
from spotcheck.characterization.frame_pairs import iterate_pairs
from spotcheck.characterization.sensor_choice import choose_sensor_values
from spotcheck.crops.cropping import is_usable, iterate_cells, read_measured_crop
from spotcheck.crops.ingest import read_full_scale
from spotcheck.dataset import frames
from spotcheck.dataset.folder import Dataset
from spotcheck.io import store

# Largest part of the pixels of a spot frame that read 0 where its dark pixels give the black level: the converter's
# zero cuts the noise of more, whose mean is then above the black level.
MAX_ZEROS = 0.01


def choose_dataset_sensor(
    dataset: Dataset, crops: xr.Dataset, table: xr.Dataset, measured: Mapping[str, Quantity]
) -> xr.Dataset:
    """Return the content of sensor.nc: every parameter of the sensor with its standard error and source.

    Parameters
    ----------
    dataset : Dataset
        The dataset, whose dark frames are read.
    crops, table : xr.Dataset
        Content of crops.nc, and of frames.nc, the table of all frames of the dataset.
    measured : mapping of str to Quantity
        Quantities of the photon transfer of flats and darks, by name; empty without flats and darks.
    """
    light_crops, grid_dims = crops.sel(centring="light"), store.grid_dims(crops)
    spot_images = (
        read_measured_crop(light_crops.isel(cell))
        for cell in iterate_cells(light_crops, grid_dims)
        if is_usable(light_crops["status"].isel(cell))
    )
    # Generators: a single frame is in memory at a time.
    reduced_darks = (
        frames.reduce_frame(frames.read_masked_image(dataset, frame))
        for frame in dataset.frames
        if frame.kind == "dark"
    )
    # crops.nc contains the fields of the reduced frames as variables.
    reduced_spots = (
        frames.ReducedFrame(*(crops[name].isel(cell).values for name in frames.ReducedFrame._fields))
        for cell in iterate_cells(crops, grid_dims)
    )
    darks = select_dark_levels(reduced_darks, reduced_spots, float(table["full_scale"]))
    # Spot frames with more than one reading: empty ones tell nothing of the converter's zero.
    is_spot = (table["kind"].values == "spot") & (table["minimum"].values < table["maximum"].values)
    zeros = table["at_zero"].values[is_spot] / float(table["rows"] * table["columns"])
    if np.any(zeros > MAX_ZEROS):
        darks = darks._replace(dark_pixels=(np.nan, np.nan))
    # Pairs of frames of the same pixels, along two axes of the grid.
    axes = {"exposures of a site": "exposure", "repeats": "repeat"}
    pairs = {phrase: iterate_pairs(light_crops, axis) for phrase, axis in axes.items()}
    highest_dn = float(table["maximum"].max())
    return choose_sensor_values(dataset, read_full_scale(table), spot_images, darks, measured, pairs, highest_dn)
