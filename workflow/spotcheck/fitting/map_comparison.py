"""Effect of the maps of the sensor's pixels on the fits of spots."""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from spotcheck.characterization.pixel_maps import SensorMaps
from spotcheck.fitting.fit_results import PARAMETERS, SpotFits
from spotcheck.fitting.variables import add_variable
from spotcheck.sensor.pixel_maps import PixelMaps


class MapComparison:
    """Fits with and without the maps of a sensor over the grid of crops, filled crop by crop."""

    def __init__(self, maps: SensorMaps, crops: xr.Dataset, dims: Sequence[str]) -> None:
        """Compare fits of `crops` over the dimensions `dims` of their grid."""
        self._maps, self._crops, self._dims = maps, crops, tuple(dims)
        shape = tuple(crops.sizes[d] for d in dims)
        self._chi2_without, self._chi2_with = np.full(shape, np.nan), np.full(shape, np.nan)
        self._shift = np.full((*shape, len(PARAMETERS)), np.nan)

    def cut_maps(self, index: dict[str, int]) -> PixelMaps:
        """Return the maps of the pixels of a crop at its exposure."""
        crop, sizes = self._crops.isel(index), self._crops.sizes
        exposure = float(crop["exposure"]) if "exposure" in self._crops.coords else None
        return self._maps.at(exposure).cut(int(crop["top"]), int(crop["left"]), sizes["y"], sizes["x"])

    def add(self, cell: tuple[int, ...], with_maps: SpotFits, without: SpotFits) -> None:
        """Store χ² and the shifts of the parameters of both fits of one crop at its cell of the grid."""
        self._chi2_without[cell], self._chi2_with[cell] = float(without.chi2_reduced), float(with_maps.chi2_reduced)
        shift = np.asarray(with_maps.value) - np.asarray(without.value)
        orientation = list(PARAMETERS).index("orientation")
        shift[orientation] = (shift[orientation] + 90) % 180 - 90
        with np.errstate(divide="ignore", invalid="ignore"):
            self._shift[cell] = shift / with_maps.stderr

    def write(self, fits: xr.Dataset) -> list[str]:
        """Add χ² without maps and the shifts to fits.nc; return the remark on them, if any fit succeeded both ways."""
        long_name = "chi-square per degree of freedom of the likelihood that takes all pixels for alike"
        add_variable(fits, "chi2_without_maps", self._dims, self._chi2_without, "1", long_name)
        for k, name in enumerate(PARAMETERS):
            long_name = f"by how many of its standard errors the maps of pixels move {name}"
            add_variable(fits, f"{name}_moved", self._dims, self._shift[..., k], "1", long_name)
        light = list(fits["centring"].values).index("light")
        before, after = self._chi2_without[..., light], self._chi2_with[..., light]
        is_fitted, is_compared = np.isfinite(after), np.isfinite(before) & np.isfinite(after)
        if not is_compared.any():
            return []
        median_before, median_after = (float(np.median(chi2[is_compared])) for chi2 in (before, after))
        shift = self._shift[..., light, :][is_compared]
        rms = float(np.sqrt(np.mean(shift[np.isfinite(shift)] ** 2)))
        count = int(np.count_nonzero(is_fitted))
        failures = count - int(is_compared.sum())
        flats = f" and {self._maps.flats} flats" if self._maps.flats else ""
        only = f" ({failures} of them fail{'s' if failures == 1 else ''} without)" if failures else ""
        return [
            f"maps of pixels by {self._maps.darks} darks{flats} are in the law of {count} fits{only}: χ² per degree of"
            f" freedom goes from {median_before:.3g} to {median_after:.3g} (median), and parameters move by {rms:.2g}"
            " of their errors (rms)"
        ]
