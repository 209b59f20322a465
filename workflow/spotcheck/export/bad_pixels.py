"""Find bad pixels of the sensor: outlying pixels that many fits have left out.

A pixel of a crop is outlying if no light explains its reading beside those of its neighbours; fits leave it out.
"""

from collections import Counter

import numpy as np
import xarray as xr

from spotcheck.characterization.outlier_pixels import find_outlier_pixels
from spotcheck.crops.cropping import iterate_cells
from spotcheck.dataset.instrument import BadPixels
from spotcheck.io import store
from spotcheck.sensor import SensorModel

# A pixel, column or row is bad if at least this number and this share of fits left it out. The share is of those fits
# whose crop covers it and which left out any pixel. An event in a single frame, such as a cosmic ray, is no defect.
MIN_FITS, MIN_SHARE = 2, 0.5


def find_bad_pixels(fits: xr.Dataset, crops: xr.Dataset, sensor: SensorModel) -> tuple[BadPixels, int]:
    """Return the bad pixels in coordinates of the sensor, and the number of fits that left out any pixel.

    The outlying pixels of these fits are searched again, as fits.nc names only the first of them. Only the fits by
    likelihood in the crops centred on the light count.

    Parameters
    ----------
    fits, crops : Dataset
        fits.nc and crops.nc of a dataset.
    sensor : SensorModel
        Sensor whose noise decides whether a pixel is outlying.
    """
    centred = crops.sel(centring="light")
    flags = fits["status"].sel(centring="light", fit="likelihood")
    # Number of fits that left out each column x, row y and single pixel (x, y) of the sensor.
    columns: Counter[int] = Counter()
    rows: Counter[int] = Counter()
    pixels: Counter[tuple[int, int]] = Counter()
    # Column and row of the sensor under the upper left pixel of each crop [fit].
    corners = []
    for index in iterate_cells(centred, store.grid_dims(crops)):
        if not int(flags.isel(index)) & store.flag("left_out"):
            continue
        crop = centred.isel(index)
        left, top = int(crop["left"]), int(crop["top"])
        corners.append((left, top))
        outlying = find_outlier_pixels(crop["image"].values, sensor)
        columns.update(left + x for x in outlying.columns)
        rows.update(top + y for y in outlying.rows)
        pixels.update((left + x, top + y) for y, x in outlying.pixels)
    lefts, tops = np.array(corners, int).reshape(-1, 2).T
    side = centred.sizes["x"]

    def covers(starts: np.ndarray, place: int) -> np.ndarray:
        """Return a mask [fit], True where a crop, which starts at `starts` [fit], covers the column or row `place`."""
        return (starts <= place) & (place < starts + side)

    bad = BadPixels(
        None,
        tuple(x for x in sorted(columns) if _is_frequent(columns[x], covers(lefts, x))),
        tuple(y for y in sorted(rows) if _is_frequent(rows[y], covers(tops, y))),
        tuple((x, y) for x, y in sorted(pixels) if _is_frequent(pixels[x, y], covers(lefts, x) & covers(tops, y))),
    )
    return bad, len(corners)


def _is_frequent(count: int, covers: np.ndarray) -> bool:
    """Return whether `count` fits, which left out a place, are enough; `covers` says whose crop covers it [fit]."""
    return count >= max(MIN_FITS, MIN_SHARE * np.count_nonzero(covers))
