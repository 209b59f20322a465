"""Effect of the maps of the sensor's pixels on the fits of spots.

The maps hold offset and gain of each pixel, measured from darks and flats.
"""

import numpy as np
import xarray as xr

from spotcheck.characterization.pixel_maps import SensorMaps
from spotcheck.fitting.fit_results import NAMES, SpotFits
from spotcheck.fitting.variables import add_variable
from spotcheck.sensor.pixel_maps import PixelMaps


def cut_maps(maps: SensorMaps, crops: xr.Dataset, index: dict[str, int]) -> PixelMaps:
    """Return the maps of the pixels of a crop at its exposure; `index` holds its index along each dimension."""
    crop, sizes = crops.isel(index), crops.sizes
    exposure = float(crop["exposure"]) if "exposure" in crops.coords else None
    return maps.at(exposure).cut(int(crop["top"]), int(crop["left"]), sizes["y"], sizes["x"])


def compute_shifts(with_maps: SpotFits, without: SpotFits) -> np.ndarray:
    """Return by how many standard errors the maps move each parameter [8] of a single spot."""
    shift = with_maps.value - without.value
    # An axis has the same direction after a turn by 180°.
    orientation = NAMES.index("orientation")
    shift[orientation] = (shift[orientation] + 90) % 180 - 90
    with np.errstate(divide="ignore", invalid="ignore"):
        return shift / with_maps.stderr


def add_map_comparison(
    fits: xr.Dataset, dims: tuple[str, ...], chi2_without: np.ndarray, shifts: np.ndarray, maps: SensorMaps
) -> list[str]:
    """Add χ² without maps and the shifts of the parameters to fits.nc, in place, and return a remark on them.

    The remark describes crops centred on the light. It is left out if no such crop was fitted both ways.

    Parameters
    ----------
    fits : fits.nc, whose likelihood fits are those with maps.
    dims : dimensions of the grid, with the centring.
    chi2_without : χ² per degree of freedom without maps [*dims]; NaN without a fit.
    shifts : shifts of the parameters in standard errors [*dims, 8]; NaN without both fits.
    maps : the maps.
    """
    long_name = "chi-square per degree of freedom of the likelihood that takes all pixels for alike"
    add_variable(fits, "chi2_without_maps", dims, chi2_without, "1", long_name)
    for k, name in enumerate(NAMES):
        long_name = f"by how many of its standard errors the maps of pixels move {name}"
        add_variable(fits, f"{name}_moved", dims, shifts[..., k], "1", long_name)
    light = fits.sel(centring="light")
    chi2_without, chi2_with = light["chi2_without_maps"].values, light["chi2_reduced"].sel(fit="likelihood").values
    is_compared = np.isfinite(chi2_without) & np.isfinite(chi2_with)
    if not is_compared.any():
        return []
    median_before, median_after = (float(np.median(chi2[is_compared])) for chi2 in (chi2_without, chi2_with))
    moves = np.stack([light[f"{name}_moved"] for name in NAMES])[:, is_compared]
    rms = float(np.sqrt(np.mean(moves[np.isfinite(moves)] ** 2)))
    count = int(np.count_nonzero(np.isfinite(chi2_with)))
    failures = count - int(is_compared.sum())
    flats = f" and {maps.flats} flats" if maps.flats else ""
    failed_without = f" ({failures} of them fail{'s' if failures == 1 else ''} without)" if failures else ""
    return [
        f"maps of pixels by {maps.darks} darks{flats} are in the law of {count} fits{failed_without}: χ² per"
        f" degree of freedom goes from {median_before:.3g} to {median_after:.3g} (median), and parameters move by"
        f" {rms:.2g} of their errors (rms)"
    ]
