"""Peak and width of every spot that the paper's simulation starts from."""

import numpy as np
import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.fitting.calibration import USED
from spotcheck.fitting.fits import preferred
from spotcheck.io import store
from spotcheck.model.baseline import of_instrument
from spotcheck.model.conditions import SpotState
from spotcheck.model.simulation import SpotStates


def has_law(calibration: xr.Dataset) -> bool:
    """Return whether p1, p2 and the peak were found; else every frame is simulated at its own fit."""
    return "skipped" not in calibration.attrs and bool(np.isfinite(calibration["peak"].sel(estimator=USED)))


def spot_states(dataset: Dataset, calibration: xr.Dataset, fits: xr.Dataset) -> SpotStates:
    """Return peak and width of every frame by the baseline's law, or those of its own fit if no law was found.

    The peak is NaN for a frame without a usable spot.
    """
    if not has_law(calibration):
        fit = preferred(fits)
        is_usable = (fit["amplitude"] > 0) & (fit["status"] & store.UNTRUSTED == 0)
        peaks, widths = fit["amplitude"].where(is_usable).values, fit["sigma_mean"].values
        return {cell: SpotState(float(peaks[cell]), float(widths[cell])) for cell, _ in dataset.cells()}
    baseline = of_instrument(dataset.instrument, dataset.exposures)
    p1, p2, peak = (float(calibration[name].sel(estimator=USED)) for name in ("p1_mean", "p2_mean", "peak"))
    return {
        cell: SpotState(peak * baseline.relative_peak(row.exposure_s, p1, p2), baseline.sigma(row.exposure_s, p1, p2))
        for cell, row in dataset.cells()
    }
