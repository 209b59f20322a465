"""Measured frames with their fitted spots and simulated counterparts.

Frames lie on a grid with the dimensions angle, exposure and repeat and one for each declared condition. An index maps
dimensions of the grid to the positions of values on them, which count from 0. A crop is the square part of a frame
around its spot.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.crops.cropping import is_usable
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.io import store
from spotcheck.metrics.crop_metrics import shift_image
from spotcheck.report.figures import series, style
from spotcheck.report.figures.results import Results, Unavailable


@dataclass(frozen=True)
class FittedSpot:
    """Gaussian fitted to the spot in a crop."""

    row: float  # row of the centre in the crop [px]
    column: float  # column of the centre in the crop [px]
    major: float  # σ of the long axis [px]
    minor: float  # σ of the short axis [px]
    direction: float  # direction of the long axis, from +x (columns) towards +y (rows, downwards) [rad]

    @property
    def covariance(self) -> np.ndarray:
        """Covariance matrix [2, 2] of the Gaussian in the order x, y [px²]."""
        c, s = np.cos(self.direction), np.sin(self.direction)
        rotation = np.array([[c, -s], [s, c]])
        return rotation @ np.diag([self.major**2, self.minor**2]) @ rotation.T


class FittedFrame(NamedTuple):
    """A crop that is centred on the light, with its fitted spot."""

    image: np.ndarray  # readings [y, x] in DN; NaN where a pixel is masked
    spot: FittedSpot  # fitted spot


def read_frame(crops: xr.Dataset | None, fits: xr.Dataset | None, index: dict[str, int]) -> FittedFrame | None:
    """Return the frame at an index of the grid; None without a usable crop or a trusted fit, or without both files.

    `crops` and `fits` are crops.nc and fits.nc of the measured frames, or of those simulated by one of the models.
    """
    if crops is None or fits is None:
        return None
    crop, fit = crops.sel(centring="light").isel(index), select_preferred_fits(fits).isel(index)
    names = ("y_centre", "x_centre", "sigma_major", "sigma_minor", "orientation")
    row, column, major, minor, direction = (float(fit[name]) for name in names)
    has_fit = np.isfinite([row, column, major, minor, direction]).all() and not int(fit["status"]) & store.UNTRUSTED
    if not has_fit or not is_usable(int(crop["status"])):
        return None
    # fits.nc has centres on the sensor and directions in degrees.
    spot = FittedSpot(row - int(crop["top"]), column - int(crop["left"]), major, minor, np.radians(direction))
    return FittedFrame(crop["image"].values.astype(float), spot)


def predict_reading(results: Results, index: dict[str, int], spot: FittedSpot) -> np.ndarray:
    """Return the mean simulated reading [y, x] in DN at an index of all dimensions, centred on the measured `spot`."""
    simulated = results.get("simulated")
    light = simulated["mean_light"].isel(index).values.astype(float)
    # The shift leaves NaN at an edge that the simulated crop does not cover; the light there is negligible.
    light = np.nan_to_num(shift_image(light, spot.row - light.shape[0] // 2, spot.column - light.shape[1] // 2))
    exposure = float(simulated["exposure"][index["exposure"]]) if "exposure" in simulated.coords else None
    return results.mean_reading(np.maximum(light, 0.0), exposure)


def iterate_frames(results: Results, fixed: dict[str, int]) -> Iterator[tuple[FittedFrame, np.ndarray]]:
    """Yield each usable measured frame with its predicted reading [y, x] in DN.

    Parameters
    ----------
    results : Results
        Results with crops.nc, fits.nc and simulated.nc.
    fixed : dict of str to int
        Index of some dimensions of the grid; all frames with this index are read.
    """
    crops, fits = results.get("crops"), results.get("fits")
    for place in series.iterate_places(crops, (dim for dim in store.grid_dims(crops) if dim not in fixed)):
        index = fixed | place
        if frame := read_frame(crops, fits, index):
            yield frame, predict_reading(results, index, frame.spot)


class FramePair(NamedTuple):
    """A measured frame and simulated ones at the same index of the grid."""

    measured: FittedFrame  # measured frame
    simulated: FittedFrame  # frame simulated by the declared model, with random noise
    extended: FittedFrame | None  # frame simulated by the extended model; None if there is none, or without a fit
    name: str  # conditions as text; "" if none were recorded


def find_pair(results: Results) -> FramePair:
    """Return the first pair of frames that are both usable, from the longest exposure and the first angle on.

    Declared conditions vary fastest, then repeats, angles and exposures. Raises `Unavailable` if there is no pair.
    """
    crops, fits = results.get("crops"), results.get("fits")
    simulated_crops, simulated_fits = results.get("simulated/crops"), results.get("simulated/fits")
    dims = ("exposure", "angle", "repeat", *(dim for dim in store.grid_dims(crops) if dim not in series.UNITS))
    extended_crops, extended_fits = results.find("extended/crops"), results.find("extended/fits")
    for index in series.iterate_places(crops, dims):
        index["exposure"] = crops.sizes["exposure"] - 1 - index["exposure"]
        measured, simulated = read_frame(crops, fits, index), read_frame(simulated_crops, simulated_fits, index)
        if measured and simulated:
            extended = read_frame(extended_crops, extended_fits, index)
            return FramePair(measured, simulated, extended, _describe_conditions(crops, index))
    raise Unavailable("no cell of the grid has a usable measured and simulated frame")


def _describe_conditions(ds: xr.Dataset, index: dict[str, int]) -> str:
    """Return the recorded conditions at an index with their names as text: `exposure time t 500 µs, repeat 0`."""
    descriptions = []
    for dim, k in index.items():
        if dim in ds.coords:
            values, unit, _ = series.axis_values(ds, dim)
            # Captions are plain text, without the marks of mathematical text.
            descriptions.append(f"{style.axis_name(dim)} {style.format_value(values[k], unit)}".replace("$", ""))
    return ", ".join(descriptions)
