"""Find bad pixels of the sensor: outlying pixels that many fits have left out.

A crop is the image around a spot. A pixel of a crop is outlying if the light of its neighbours does not explain its
reading; fits leave it out. Crops and fits lie on a grid of conditions, with one frame in a cell.
"""

from collections import Counter

import numpy as np
import xarray as xr

from spotcheck.characterization.outlier_pixels import find_outlier_pixels
from spotcheck.crops.cropping import iterate_cells, read_measured_crop
from spotcheck.dataset.instrument import BadPixels
from spotcheck.io import store
from spotcheck.sensor import SensorModel

# A pixel, column or row is bad if at least this number and this share of fits left it out. The share is of those fits
# whose crop covers it and which left out any pixel. An event in a single frame, such as a cosmic ray, is no defect.
MIN_FITS, MIN_SHARE = 2, 0.5


def find_bad_pixels(fits: xr.Dataset, crops: xr.Dataset, sensor: SensorModel) -> tuple[BadPixels, int]:
    """Return the bad pixels in coordinates of the sensor, and the number of fits that left out any pixel.

    Only the fits by likelihood in the crops centred on the light count. Their outlying pixels are searched again in the
    crops, because fits.nc has them only as a text that does not list all of them.

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
    columns, rows, pixels = Counter[int](), Counter[int](), Counter[tuple[int, int]]()
    # Column and row of the sensor under the upper left pixel of each crop [fit].
    corners = []
    for index in iterate_cells(centred, store.grid_dims(crops)):
        # The status of a fit is a set of bits; `left_out` means that it left out outlying pixels.
        if not int(flags.isel(index)) & store.flag("left_out"):
            continue
        crop = centred.isel(index)
        left, top = int(crop["left"]), int(crop["top"])
        corners.append((left, top))
        outlying = find_outlier_pixels(read_measured_crop(crop), sensor)
        columns.update(left + x for x in outlying.columns)
        rows.update(top + y for y in outlying.rows)
        pixels.update((left + x, top + y) for y, x in outlying.pixels)
    lefts, tops = np.array(corners, int).reshape(-1, 2).T
    side = centred.sizes["x"]

    def covers(starts: np.ndarray, place: int) -> np.ndarray:
        """Return a mask [fit], True where a crop with the first column or row `starts` [fit] covers `place`."""
        return (starts <= place) & (place < starts + side)

    # No mask file, but lists of columns, rows and pixels.
    bad = BadPixels(
        None,
        tuple(x for x in sorted(columns) if _is_frequent(columns[x], covers(lefts, x))),
        tuple(y for y in sorted(rows) if _is_frequent(rows[y], covers(tops, y))),
        tuple((x, y) for x, y in sorted(pixels) if _is_frequent(pixels[x, y], covers(lefts, x) & covers(tops, y))),
    )
    return bad, len(corners)


def _is_frequent(count: int, covers: np.ndarray) -> bool:
    """Return whether `count` fits that left out a place make it bad; `covers` [fit] is True where a crop covers it."""
    return count >= max(MIN_FITS, MIN_SHARE * np.count_nonzero(covers))
