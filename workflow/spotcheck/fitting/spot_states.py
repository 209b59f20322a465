"""Peak and width of every spot that the paper's simulation starts from."""

import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.fitting.calibration import read_width_law
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.io import store
from spotcheck.model.baseline import of_instrument
from spotcheck.model.conditions import SpotState
from spotcheck.model.simulation import SpotStates


def list_spot_states(dataset: Dataset, calibration: xr.Dataset, fits: xr.Dataset) -> SpotStates:
    """Return peak [DN] and width [px] of every frame by the law of calibration.nc, or by its own fit without a law.

    The peak is NaN for a frame without a usable spot.
    """
    law = read_width_law(calibration)
    if law is None:
        fit = select_preferred_fits(fits)
        is_usable = (fit["amplitude"] > 0) & (fit["status"] & store.UNTRUSTED == 0)
        peaks, widths = fit["amplitude"].where(is_usable).values, fit["sigma_mean"].values
        return {cell: SpotState(float(peaks[cell]), float(widths[cell])) for cell, _ in dataset.cells()}
    baseline = of_instrument(dataset.instrument, dataset.exposures)
    return {cell: SpotState(*law.spot_at(baseline, row.exposure_s)) for cell, row in dataset.cells()}
