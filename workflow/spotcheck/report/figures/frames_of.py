"""Measured and simulated frames, one at a time, with their fitted centres: what images and residuals are made of."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.crops.stages import usable
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.io import store
from spotcheck.metrics import crop_metrics as metrics
from spotcheck.report.figures.results import Results, Unavailable

# A fit with one of these flags has no width or centre that could be drawn.
UNTRUSTED = store.UNTRUSTED


class Spot(NamedTuple):
    """Fitted spot in a crop: centre (row, column) [px], σ along both axes [px], direction of the long one [rad]."""

    row: float
    column: float
    major: float
    minor: float
    direction: float

    @property
    def covariance(self) -> np.ndarray:
        """Covariance [(x, y), (x, y)] of the Gaussian in px²."""
        c, s = np.cos(self.direction), np.sin(self.direction)
        turn = np.array([[c, -s], [s, c]])
        return turn @ np.diag([self.major**2, self.minor**2]) @ turn.T


def crop(crops: xr.Dataset, index: dict[str, int]) -> np.ndarray | None:
    """Light-centred crop [y, x] in DN of one cell of the grid, or None when it is not usable."""
    own = crops.sel(centring="light").isel(index)
    return own["image"].values.astype(float) if usable(int(own["status"])) else None


def spot(crops: xr.Dataset, fits: xr.Dataset, index: dict[str, int]) -> Spot | None:
    """The fitted spot in the light-centred crop of one cell, or None without a fit."""
    own, fit = crops.sel(centring="light").isel(index), select_preferred_fits(fits).isel(index)
    numbers = [float(fit[n]) for n in ("y_centre", "x_centre", "sigma_major", "sigma_minor", "orientation")]
    if not np.isfinite(numbers).all() or int(fit["status"]) & UNTRUSTED:
        return None
    row, column, major, minor, direction = numbers
    return Spot(row - int(own["top"]), column - int(own["left"]), major, minor, np.radians(direction))


def expected(results: Results, index: dict[str, int], at: Spot) -> np.ndarray:
    """Mean simulated reading [y, x] in DN of one cell, moved onto a centre in the measured crop."""
    simulated = results.get("simulated")
    light = simulated["mean_light"].isel(index).values.astype(float)
    # The border is light too faint to matter; NaN would bite into the crop's edge.
    light = np.nan_to_num(metrics.shifted(light, at.row - light.shape[0] // 2, at.column - light.shape[1] // 2))
    exposure = float(simulated["exposure"][index["exposure"]]) if "exposure" in simulated.coords else None
    return results.mean_reading(np.maximum(light, 0.0), exposure)


def residual_frames(results: Results, fixed: dict[str, int]) -> Iterator[tuple[np.ndarray, np.ndarray, Spot]]:
    """Measured crop [y, x], expected reading on its centre, and spot, of every usable frame under the fixed indices."""
    crops, fits = results.get("crops"), results.get("fits")
    free = [d for d in store.grid_dims(crops) if d not in fixed]
    for at in np.ndindex(*(crops.sizes[d] for d in free)):
        index = fixed | dict(zip(free, at, strict=True))
        image, found = crop(crops, index), spot(crops, fits, index)
        if image is not None and found is not None:
            yield image, expected(results, index, found), found


class Example(NamedTuple):
    """One cell that both sources have: crops [y, x] in DN, fitted spots, and what to call it."""

    measured: np.ndarray
    simulated: np.ndarray
    measured_spot: Spot
    simulated_spot: Spot
    name: str


def example(results: Results, name_of: Callable[[xr.Dataset, dict[str, int]], str]) -> Example:
    """The first usable cell in the order: longest exposure, first angle, first repeat, first condition."""
    crops = {"measured": results.get("crops"), "simulated": results.get("simulated/crops")}
    fits = {"measured": results.get("fits"), "simulated": results.get("simulated/fits")}
    dims = store.grid_dims(crops["measured"])
    order = ("exposure", "angle", "repeat", *(d for d in dims if d not in ("exposure", "angle", "repeat")))
    shape = [crops["measured"].sizes[d] for d in order]
    for at in np.ndindex(*shape):
        index = dict(zip(order, at, strict=True))
        index["exposure"] = shape[0] - 1 - index["exposure"]
        images = {s: crop(crops[s], index) for s in crops}
        spots = {s: spot(crops[s], fits[s], index) for s in crops}
        m, s, ms, ss = images["measured"], images["simulated"], spots["measured"], spots["simulated"]
        if m is not None and s is not None and ms is not None and ss is not None:
            return Example(m, s, ms, ss, name_of(crops["measured"], index))
    raise Unavailable("no cell of the grid has a usable measured and simulated frame")
