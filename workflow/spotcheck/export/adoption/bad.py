"""Pixels of the sensor that are bad: those that fit after fit left out, since no light explains what they read."""

from collections import Counter

import numpy as np
import xarray as xr

from spotcheck.characterization.outlier_pixels import find_outlier_pixels
from spotcheck.crops.stages import cells
from spotcheck.dataset.instrument import BadPixels
from spotcheck.io import store
from spotcheck.sensor import SensorModel

# A pixel, column or row is bad where so many frames left it out, and this part of all that saw it in a fit that left
# something out: what hits one frame alone, as a cosmic ray does, is not the sensor's.
LEAST, PART = 2, 0.5


def bad_in(fits: xr.Dataset, crops: xr.Dataset, sensor: SensorModel) -> tuple[BadPixels, int]:
    """What of the sensor is bad, and how many fits left something out. Of these the odd pixels are looked for again:
    fits.nc names the first of them only."""
    own = crops.sel(centring="light")
    flags = fits["status"].sel(centring="light", fit="likelihood")
    odd: dict[str, Counter] = {"columns": Counter(), "rows": Counter(), "pixels": Counter()}
    corners = []
    for index in cells(own, store.grid_dims(crops)):
        if not int(flags.isel(index)) & store.flag("left_out"):
            continue
        at = own.isel(index)
        left, top = int(at["left"]), int(at["top"])
        corners.append((left, top))
        found = find_outlier_pixels(at["image"].values, sensor)
        odd["columns"].update(left + x for x in found.columns)
        odd["rows"].update(top + y for y in found.rows)
        odd["pixels"].update((left + x, top + y) for y, x in found.pixels)
    side = own.sizes["x"]
    lefts, tops = (np.array([corner[k] for corner in corners], int) for k in (0, 1))

    def often(count: int, x: int | None, y: int | None) -> bool:
        saw = np.ones(len(corners), bool)
        for starts, place in ((lefts, x), (tops, y)):
            saw &= True if place is None else (starts <= place) & (place < starts + side)
        return count >= max(LEAST, PART * np.count_nonzero(saw))

    columns = tuple(sorted(x for x, n in odd["columns"].items() if often(n, x, None)))
    rows = tuple(sorted(y for y, n in odd["rows"].items() if often(n, None, y)))
    pixels = tuple(sorted(p for p, n in odd["pixels"].items() if often(n, *p)))
    return BadPixels(None, columns, rows, pixels), len(corners)
