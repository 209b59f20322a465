"""Measured frames with their fitted spots and simulated counterparts."""

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
    """Fitted Gaussian in a crop."""

    row: float  # row of the centre [px]
    column: float  # column of the centre [px]
    major: float  # σ of the long axis [px]
    minor: float  # σ of the short axis [px]
    direction: float  # direction of the long axis [rad]

    @property
    def covariance(self) -> np.ndarray:
        """Covariance [(x, y), (x, y)] of the Gaussian in px²."""
        c, s = np.cos(self.direction), np.sin(self.direction)
        rotation = np.array([[c, -s], [s, c]])
        return rotation @ np.diag([self.major**2, self.minor**2]) @ rotation.T


class FittedFrame(NamedTuple):
    """A light-centred crop with its fitted spot."""

    image: np.ndarray  # reading [y, x] in DN
    spot: FittedSpot  # fitted spot


def read_frame(crops: xr.Dataset, fits: xr.Dataset, index: dict[str, int]) -> FittedFrame | None:
    """Return the frame at an index of the grid; None without a usable crop or a trusted fit."""
    crop, fit = crops.sel(centring="light").isel(index), select_preferred_fits(fits).isel(index)
    names = ("y_centre", "x_centre", "sigma_major", "sigma_minor", "orientation")
    row, column, major, minor, direction = (float(fit[name]) for name in names)
    has_fit = np.isfinite([row, column, major, minor, direction]).all() and not int(fit["status"]) & store.UNTRUSTED
    if not has_fit or not is_usable(int(crop["status"])):
        return None
    spot = FittedSpot(row - int(crop["top"]), column - int(crop["left"]), major, minor, np.radians(direction))
    return FittedFrame(crop["image"].values.astype(float), spot)


def predict_reading(results: Results, index: dict[str, int], spot: FittedSpot) -> np.ndarray:
    """Return the mean simulated reading [y, x] in DN at an index of the grid, centred on a measured spot."""
    simulated = results.get("simulated")
    light = simulated["mean_light"].isel(index).values.astype(float)
    # Beyond the simulated crop the light is negligible; NaN would spread into its edge.
    light = np.nan_to_num(shift_image(light, spot.row - light.shape[0] // 2, spot.column - light.shape[1] // 2))
    exposure = float(simulated["exposure"][index["exposure"]]) if "exposure" in simulated.coords else None
    return results.mean_reading(np.maximum(light, 0.0), exposure)


def iterate_frames(results: Results, fixed: dict[str, int]) -> Iterator[tuple[FittedFrame, np.ndarray]]:
    """Yield each usable measured frame with its predicted reading [y, x] in DN.

    Parameters
    ----------
    results : Results
        The results.
    fixed : dict of str to int
        Index on some dimensions of the grid; frames vary over the other dimensions.
    """
    crops, fits = results.get("crops"), results.get("fits")
    free = [dim for dim in store.grid_dims(crops) if dim not in fixed]
    for at in np.ndindex(*(crops.sizes[dim] for dim in free)):
        index = fixed | dict(zip(free, at, strict=True))
        if frame := read_frame(crops, fits, index):
            yield frame, predict_reading(results, index, frame.spot)


class FramePair(NamedTuple):
    """A measured and a simulated frame at the same conditions."""

    measured: FittedFrame  # measured frame
    simulated: FittedFrame  # random simulated frame
    name: str  # conditions as text


def find_pair(results: Results) -> FramePair:
    """Return the first usable pair of frames: longest exposure, first angle, first repeat, first conditions.

    Raises `Unavailable` if there is none.
    """
    files = [[results.get(f"{folder}{name}") for name in ("crops", "fits")] for folder in ("", "simulated/")]
    measured_crops = files[0][0]
    dims = store.grid_dims(measured_crops)
    order = ("exposure", "angle", "repeat", *(dim for dim in dims if dim not in ("exposure", "angle", "repeat")))
    for at in np.ndindex(*(measured_crops.sizes[dim] for dim in order)):
        index = dict(zip(order, at, strict=True))
        index["exposure"] = measured_crops.sizes["exposure"] - 1 - index["exposure"]
        measured, simulated = (read_frame(crops, fits, index) for crops, fits in files)
        if measured and simulated:
            return FramePair(measured, simulated, _named_conditions(measured_crops, index))
    raise Unavailable("no cell of the grid has a usable measured and simulated frame")


def _named_conditions(ds: xr.Dataset, index: dict[str, int]) -> str:
    """Return each recorded condition with the name of its axis as text."""
    parts = []
    for dim, k in index.items():
        if dim in ds.coords:
            values, unit, _ = series.axis_values(ds, dim)
            parts.append(f"{style.axis_name(dim)} {style.format_value(values[k], unit)}".replace("$", ""))
    return ", ".join(parts)
