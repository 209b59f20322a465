"""Effect of the maps of the sensor's pixels on the fits of spots.

The maps hold offset and gain of each pixel, measured from darks and flats.
"""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from spotcheck.characterization.pixel_maps import SensorMaps
from spotcheck.fitting.fit_results import PARAMETERS, SpotFits
from spotcheck.fitting.variables import add_variable
from spotcheck.sensor.pixel_maps import PixelMaps


class MapComparison:
    """Comparison of likelihood fits with and without the maps of a sensor, filled crop by crop."""

    def __init__(self, maps: SensorMaps, crops: xr.Dataset, dims: Sequence[str]) -> None:
        """Prepare a comparison for crops.nc; `dims` are the grid's dimensions, with the centring."""
        self._maps, self._crops, self._dims = maps, crops, tuple(dims)
        shape = tuple(crops.sizes[dim] for dim in dims)
        # χ² per degree of freedom [*dims], and shifts of the parameters in standard errors [*dims, 8]; NaN without
        # fits.
        self._chi2_without, self._chi2_with = np.full(shape, np.nan), np.full(shape, np.nan)
        self._shifts = np.full((*shape, len(PARAMETERS)), np.nan)

    def cut_maps(self, index: dict[str, int]) -> PixelMaps:
        """Return the maps of the pixels of a crop at its exposure; `index` holds its index along each dimension."""
        crop, sizes = self._crops.isel(index), self._crops.sizes
        exposure = float(crop["exposure"]) if "exposure" in self._crops.coords else None
        return self._maps.at(exposure).cut(int(crop["top"]), int(crop["left"]), sizes["y"], sizes["x"])

    def add(self, cell: tuple[int, ...], with_maps: SpotFits, without: SpotFits) -> None:
        """Store χ² and the shifts of the parameters of one crop, whose index on the grid is `cell`.

        `with_maps` and `without` are the two fits of the crop, each of a single spot.
        """
        self._chi2_without[cell], self._chi2_with[cell] = float(without.chi2_reduced), float(with_maps.chi2_reduced)
        shift = np.asarray(with_maps.value) - np.asarray(without.value)
        # An axis has the same direction after a turn by 180°.
        orientation = list(PARAMETERS).index("orientation")
        shift[orientation] = (shift[orientation] + 90) % 180 - 90
        with np.errstate(divide="ignore", invalid="ignore"):
            self._shifts[cell] = shift / with_maps.stderr

    def write(self, fits: xr.Dataset) -> list[str]:
        """Add χ² without maps and the shifts to fits.nc, in place, and return a remark on them.

        The remark describes crops centred on the light. It is left out if no such crop was fitted both ways.
        """
        long_name = "chi-square per degree of freedom of the likelihood that takes all pixels for alike"
        add_variable(fits, "chi2_without_maps", self._dims, self._chi2_without, "1", long_name)
        for k, name in enumerate(PARAMETERS):
            long_name = f"by how many of its standard errors the maps of pixels move {name}"
            add_variable(fits, f"{name}_moved", self._dims, self._shifts[..., k], "1", long_name)
        # The centring is the last dimension.
        light = list(fits["centring"].values).index("light")
        chi2_without, chi2_with = self._chi2_without[..., light], self._chi2_with[..., light]
        is_compared = np.isfinite(chi2_without) & np.isfinite(chi2_with)
        if not is_compared.any():
            return []
        median_before, median_after = (float(np.median(chi2[is_compared])) for chi2 in (chi2_without, chi2_with))
        shifts = self._shifts[..., light, :][is_compared]
        rms = float(np.sqrt(np.mean(shifts[np.isfinite(shifts)] ** 2)))
        count = int(np.count_nonzero(np.isfinite(chi2_with)))
        failures = count - int(is_compared.sum())
        flats = f" and {self._maps.flats} flats" if self._maps.flats else ""
        failed_without = f" ({failures} of them fail{'s' if failures == 1 else ''} without)" if failures else ""
        return [
            f"maps of pixels by {self._maps.darks} darks{flats} are in the law of {count} fits{failed_without}: χ² per"
            f" degree of freedom goes from {median_before:.3g} to {median_after:.3g} (median), and parameters move by"
            f" {rms:.2g} of their errors (rms)"
        ]
