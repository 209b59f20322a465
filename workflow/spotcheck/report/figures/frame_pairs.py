"""Measured frames with their fitted spots and simulated counterparts."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.crops.stages import usable
from spotcheck.fitting.fits import preferred
from spotcheck.io import store
from spotcheck.metrics.crop_metrics import shifted
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


def read_crop(crops: xr.Dataset, index: dict[str, int]) -> np.ndarray | None:
    """Return the light-centred crop [y, x] in DN at an index of the grid; None if it is not usable."""
    crop = crops.sel(centring="light").isel(index)
    return crop["image"].values.astype(float) if usable(int(crop["status"])) else None


def read_spot(crops: xr.Dataset, fits: xr.Dataset, index: dict[str, int]) -> FittedSpot | None:
    """Return the fitted spot in the light-centred crop at an index of the grid; None without a trusted fit."""
    crop, fit = crops.sel(centring="light").isel(index), preferred(fits).isel(index)
    names = ("y_centre", "x_centre", "sigma_major", "sigma_minor", "orientation")
    row, column, major, minor, direction = (float(fit[name]) for name in names)
    if not np.isfinite([row, column, major, minor, direction]).all() or int(fit["status"]) & store.UNTRUSTED:
        return None
    return FittedSpot(row - int(crop["top"]), column - int(crop["left"]), major, minor, np.radians(direction))


def predict_reading(results: Results, index: dict[str, int], spot: FittedSpot) -> np.ndarray:
    """Return the mean simulated reading [y, x] in DN at an index of the grid, centred on a measured spot."""
    simulated = results.get("simulated")
    light = simulated["mean_light"].isel(index).values.astype(float)
    # Beyond the simulated crop the light is negligible; NaN would spread into its edge.
    light = np.nan_to_num(shifted(light, spot.row - light.shape[0] // 2, spot.column - light.shape[1] // 2))
    exposure = float(simulated["exposure"][index["exposure"]]) if "exposure" in simulated.coords else None
    return results.mean_reading(np.maximum(light, 0.0), exposure)


def iterate_frames(results: Results, fixed: dict[str, int]) -> Iterator[tuple[np.ndarray, np.ndarray, FittedSpot]]:
    """Yield measured crop [y, x], predicted reading [y, x] and spot of each usable frame.

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
        image, spot = read_crop(crops, index), read_spot(crops, fits, index)
        if image is not None and spot is not None:
            yield image, predict_reading(results, index, spot), spot


class Frame(NamedTuple):
    """A crop with its fitted spot."""

    image: np.ndarray  # reading [y, x] in DN
    spot: FittedSpot  # fitted spot


class FramePair(NamedTuple):
    """A measured and a simulated frame at the same conditions."""

    measured: Frame  # measured frame
    simulated: Frame  # random simulated frame
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
        frames = [(read_crop(crops, index), read_spot(crops, fits, index)) for crops, fits in files]
        usable_frames = [Frame(image, spot) for image, spot in frames if image is not None and spot is not None]
        if len(usable_frames) == 2:
            return FramePair(*usable_frames, _named_conditions(measured_crops, index))
    raise Unavailable("no cell of the grid has a usable measured and simulated frame")


def _named_conditions(ds: xr.Dataset, index: dict[str, int]) -> str:
    """Return each recorded condition with the name of its axis as text."""
    parts = []
    for dim, k in index.items():
        if dim in ds.coords:
            values, unit, _ = series.axis_values(ds, dim)
            parts.append(f"{style.axis_name(dim)} {style.format_value(values[k], unit)}".replace("$", ""))
    return ", ".join(parts)
