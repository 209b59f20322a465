"""What maps of the sensor's pixels change in the fits of spots."""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from spotcheck.characterization.pixel_maps import SensorMaps
from spotcheck.fitting.fitted import PARAMETERS, SpotFits
from spotcheck.sensor.pixel_maps import PixelMaps


class ByMaps:
    """Fits with and without maps side by side, filled crop by crop."""

    def __init__(self, crops: xr.Dataset, dims: Sequence[str]) -> None:
        self._crops, self._dims = crops, tuple(dims)
        shape = tuple(crops.sizes[d] for d in dims)
        self._chi2, self._after = np.full(shape, np.nan), np.full(shape, np.nan)
        self._moved = np.full((*shape, len(PARAMETERS)), np.nan)

    def cut(self, maps: SensorMaps, index: dict[str, int]) -> PixelMaps:
        """The maps of the pixels of a crop, at its exposure."""
        at, crops = self._crops.isel(index), self._crops
        exposure = float(at["exposure"]) if "exposure" in crops.coords else None
        return maps.at(exposure).cut(int(at["top"]), int(at["left"]), crops.sizes["y"], crops.sizes["x"])

    def compare(self, at: tuple[int, ...], with_maps: SpotFits, without: SpotFits) -> None:
        """Note a fit of each at a place of the grid."""
        self._chi2[at], self._after[at] = float(without.chi2_reduced), float(with_maps.chi2_reduced)
        moved = np.asarray(with_maps.value) - np.asarray(without.value)
        turn = list(PARAMETERS).index("orientation")
        moved[turn] = (moved[turn] + 90) % 180 - 90
        with np.errstate(divide="ignore", invalid="ignore"):
            self._moved[at] = moved / with_maps.stderr

    def put(self, fits: xr.Dataset, maps: SensorMaps) -> list[str]:
        """Add what was noted to fits.nc; the sentence that says it."""
        text = "chi-square per degree of freedom of the likelihood that takes all pixels for alike"
        fits["chi2_without_maps"] = (self._dims, self._chi2, {"units": "1", "long_name": text})
        for k, name in enumerate(PARAMETERS):
            text = f"by how many of its standard errors the maps of pixels move {name}"
            fits[f"{name}_moved"] = (self._dims, self._moved[..., k], {"units": "1", "long_name": text})
        chosen = list(fits["centring"].values).index("light")
        chi2, after = self._chi2[..., chosen], self._after[..., chosen]
        found, known = int(np.count_nonzero(np.isfinite(after))), np.isfinite(chi2) & np.isfinite(after)
        if not known.any():
            return []
        before, then, more = float(np.median(chi2[known])), float(np.median(after[known])), found - int(known.sum())
        far = self._moved[..., chosen, :][known]
        rms = float(np.sqrt(np.mean(far[np.isfinite(far)] ** 2)))
        flats = f" and {maps.flats} flats" if maps.flats else ""
        only = f" ({more} of them fail{'s' if more == 1 else ''} without)" if more else ""
        return [
            f"maps of pixels by {maps.darks} darks{flats} are in the law of {found} fits{only}: χ² per degree of"
            f" freedom goes from {before:.3g} to {then:.3g} (median), and parameters move by {rms:.2g} of their errors"
            " (rms)"
        ]
