"""Peak and width of the spot in every frame, from which the simulation of the paper starts.

The width law gives the width of a spot over its exposure time (`width_law`); calibration.nc holds it.
"""

import xarray as xr

from spotcheck.dataset.folder import Dataset
from spotcheck.fitting.calibration import read_width_law
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.io import store
from spotcheck.model.baseline import build_baseline
from spotcheck.model.conditions import SpotState
from spotcheck.model.simulation import SpotStates


def list_spot_states(dataset: Dataset, calibration: xr.Dataset, fits: xr.Dataset) -> SpotStates:
    """Return peak [DN] and width σ_g [px] of every frame: by the width law, or without one by the fit of the frame.

    Parameters
    ----------
    dataset : the dataset, whose frames lie on a grid of conditions.
    calibration, fits : calibration.nc and fits.nc of the dataset.

    Returns
    -------
    dict
        State of the spot by the index of its frame in the grid. The peak is NaN for a frame without a usable spot.
    """
    law = read_width_law(calibration)
    if law is None:
        spots = select_preferred_fits(fits)
        is_usable = (spots["amplitude"] > 0) & (spots["status"] & store.UNTRUSTED == 0)
        peaks, widths = spots["amplitude"].where(is_usable).values, spots["sigma_mean"].values
        return {index: SpotState(float(peaks[index]), float(widths[index])) for index, _ in dataset.cells()}
    baseline = build_baseline(dataset.instrument, dataset.exposures)
    return {index: SpotState(*law.spot_at(baseline, frame.exposure_s)) for index, frame in dataset.cells()}
