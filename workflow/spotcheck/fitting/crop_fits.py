"""The fit stage: fits of every crop of a dataset by both estimators, and the choice between them.

The crops lie on a grid of conditions such as angle, exposure and repeat. Each frame has two crops, one for each
centring: centred on the light, and on the brightest pixel.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.characterization.outlier_pixels import OutlierPixels, find_outlier_pixels
from spotcheck.characterization.pixel_maps import SensorMaps
from spotcheck.crops.cropping import is_usable, iterate_cells, read_measured_crop
from spotcheck.fitting.fit_results import NAMES, PARAMETERS, SpotFits, add_parameters
from spotcheck.fitting.map_comparison import add_map_comparison, compute_shifts, cut_maps
from spotcheck.fitting.spotfit import fit_spots
from spotcheck.fitting.variables import add_variable
from spotcheck.io import progress, store
from spotcheck.io.number_text import two_digits
from spotcheck.sensor import SensorModel

# Estimators by their name in fits.nc, with a description.
FITS = {
    "likelihood": "maximum likelihood of the instrument's spot, Gaussian or top hat, under the sensor's noise",
    "least_squares": "unweighted least squares of a Gaussian, the paper's estimator",
}
# Indices of both estimators in `FITS`, and of the coordinates of the centre in `PARAMETERS`.
LIKELIHOOD, LEAST_SQUARES = range(len(FITS))
X_CENTRE, Y_CENTRE = (NAMES.index(name) for name in ("x_centre", "y_centre"))
# Outlying pixels are searched if χ² exceeds 1 by so many standard deviations; noise alone does so once in 1e9. They are
# left out if the fit without them keeps less than this fraction of the excess.
EXCESS_SIGMAS, KEPT_EXCESS = 6.0, 0.5
# χ² per degree of freedom below or above which a spot fit is flagged. Noise alone puts it within some percent of 1.
# Below half, the stated noise is too large. Speckle on the composite gives up to 170: above, residuals are 14 times the
# stated noise.
TOO_LOW, TOO_HIGH = 0.5, 200.0


class StoredFit(NamedTuple):
    """One fit of fits.nc with the centre relative to its crop."""

    value: np.ndarray  # values [8] in the order of `PARAMETERS`
    stderr: np.ndarray  # their standard errors [8]
    chi2_reduced: float  # χ² per degree of freedom
    status: int  # flags as bits (`store.STATUS`)


def fit_crops(
    crops: xr.Dataset,
    sensor: SensorModel | None,
    top_hat: bool = False,
    integrated: bool = False,
    maps: SensorMaps | None = None,
) -> xr.Dataset:
    """Fit every usable crop by both estimators, and return fits.nc.

    Parameters
    ----------
    crops : crops.nc of the dataset.
    sensor : model of the sensor; if None, only least squares are fitted.
    top_hat : whether the light has a plateau.
    integrated : whether a pixel reads the mean of the light over it, not the light at its centre.
    maps : offset and gain of the sensor's pixels for the likelihood; None if all pixels count as alike. With maps,
        `chi2_without_maps` and variables such as `amplitude_moved` give their effect.

    Returns
    -------
    xr.Dataset
        Content of fits.nc: values, standard errors, χ² and status over the grid, both centrings and both fits; NaN
        without a fit. Centres are in pixels of the sensor. The attribute `preferred` names the fit to use.
    """
    crop_dims = (*store.grid_dims(crops), "centring")
    dims = (*crop_dims, "fit")
    shape = (*(crops.sizes[dim] for dim in crop_dims), len(FITS))
    value, stderr = (np.full((*shape, len(PARAMETERS)), np.nan) for _ in range(2))
    chi2, left_out = np.full(shape, np.nan), np.full(shape, "", dtype=object)
    status = np.repeat(crops["status"].values[..., None], len(FITS), axis=-1)
    if sensor is None:
        status[..., LIKELIHOOD] |= store.flag("no_noise")
    left, top = crops["left"].values, crops["top"].values
    by_likelihood = partial(fit_spots, sensor=sensor, top_hat=top_hat, integrated=integrated)
    by_least_squares = partial(fit_spots, sensor=sensor, weighting="equal", integrated=integrated)
    # χ² without maps, and shifts of the parameters by the maps in standard errors.
    maps = None if sensor is None else maps
    chi2_without, shifts = np.full(shape[:-1], np.nan), np.full((*shape[:-1], len(PARAMETERS)), np.nan)
    for index in progress.track(list(iterate_cells(crops, crop_dims)), "fitting spots"):
        cell = tuple(index.values())
        if not is_usable(crops["status"].values[cell]):
            continue
        image = read_measured_crop(crops.isel(index))
        pixel_maps = None if maps is None else cut_maps(maps, crops, index)
        fits, outliers = _fit_both(image, sensor, partial(by_likelihood, maps=pixel_maps), by_least_squares)
        if maps is not None:
            fit_without = by_likelihood(np.where(outliers.mask, np.nan, image) if outliers is not None else image)
            chi2_without[cell], shifts[cell] = fit_without.chi2_reduced, compute_shifts(fits[LIKELIHOOD], fit_without)
        for k, fit in fits.items():
            fit_index = (*cell, k)
            value[fit_index], stderr[fit_index], chi2[fit_index] = fit.value, fit.stderr, fit.chi2_reduced
            value[(*fit_index, X_CENTRE)] += left[cell]
            value[(*fit_index, Y_CENTRE)] += top[cell]
            status[fit_index] |= int(fit.flags) | flag_doubtful_errors(fit)
            if outliers is not None:
                status[fit_index] |= store.flag("left_out")
                left_out[fit_index] = outliers.describe(int(left[cell]), int(top[cell]))
    coords = {name: crops[name] for name in crops.coords if set(crops[name].dims) <= set(dims)}
    ds = xr.Dataset(coords=coords, attrs={name: crops.attrs[name] for name in ("title", "dataset", "not_recorded")})
    add_variable(ds, "fit", "fit", np.array(list(FITS), dtype=object), "1", "how the spot was fitted")
    add_parameters(ds, dims, value, stderr, origin=" on the sensor")
    ds["orientation_stderr"].attrs["infinite"] = "the spot is round within its noise"
    add_variable(ds, "chi2_reduced", dims, chi2, "1", "chi-square per degree of freedom under sensor noise")
    add_variable(ds, "left_out", dims, left_out, "1", "pixels of the sensor that were left out, and why")
    ds["status"] = (dims, status.astype("i4"), store.status_attributes())
    remarks = [] if maps is None else add_map_comparison(ds, crop_dims, chi2_without, shifts, maps)
    ds.attrs |= {f"fit_{name}": text for name, text in FITS.items()}
    ds.attrs["preferred"] = "least_squares" if sensor is None else "likelihood"
    return store.add_remarks(ds, [*remarks, *_check_chi2(select_preferred_fits(ds)["chi2_reduced"].values)])


def _fit_both(
    image: np.ndarray,
    sensor: SensorModel | None,
    by_likelihood: Callable[[np.ndarray], SpotFits],
    by_least_squares: Callable[[np.ndarray], SpotFits],
) -> tuple[dict[int, SpotFits], OutlierPixels | None]:
    """Fit an image [row, column] in DN by both estimators, without outlying pixels if that improves the fit.

    `by_likelihood` and `by_least_squares` are the two fits of an image. Without a sensor there is no likelihood.

    Returns
    -------
    fits : dict
        Fits of a single spot by the index of the estimator in `FITS`.
    outliers : OutlierPixels or None
        Outlying pixels that the fits leave out; None if they use all pixels.
    """
    if sensor is None:
        return {LEAST_SQUARES: by_least_squares(image)}, None
    fit = by_likelihood(image)
    excess = float(fit.chi2_reduced) - 1
    # Standard deviation of χ² per degree of freedom due to noise.
    chi2_sigma = np.sqrt(2 / np.count_nonzero(np.isfinite(image)))
    # The excess is NaN without convergence, which may be due to outliers too.
    if not excess <= EXCESS_SIGMAS * chi2_sigma:
        outliers = find_outlier_pixels(image, sensor)
        if outliers.mask.any():
            inliers = np.where(outliers.mask, np.nan, image)
            refit = by_likelihood(inliers)
            is_better = not np.isfinite(excess) or refit.chi2_reduced - 1 < KEPT_EXCESS * excess
            if refit.flags == 0 and is_better:
                return {LIKELIHOOD: refit, LEAST_SQUARES: by_least_squares(inliers)}, outliers
    return {LIKELIHOOD: fit, LEAST_SQUARES: by_least_squares(image)}, None


def _check_chi2(chi2: np.ndarray) -> list[str]:
    """Return remarks on fits whose χ² per degree of freedom is far from 1; `chi2` has any shape, NaN without a fit."""
    known = chi2[np.isfinite(chi2)]
    keys = "sensor.gain_dn_per_e or sensor.read_noise_e"
    # Cause that a χ² outside either limit suggests, and the values there.
    too_large = f"the noise that is stated is too large: {keys} is too high or in another unit, or"
    too_small = f"the light is far from a Gaussian, as the verdict tells, or {keys} is too low or in another unit"
    causes = {
        f"{too_large} sensor.black_level_dn is missing or too low": known[known < TOO_LOW],
        too_small: known[known > TOO_HIGH],
    }
    return [
        f"{values.size} of {known.size} fits have a χ² per degree of freedom of about"
        f" {two_digits(float(np.median(values)))}: {cause}"
        for cause, values in causes.items()
        if values.size
    ]


def flag_doubtful_errors(fit: SpotFits) -> int:
    """Return the flags of a single fit whose standard errors do not describe its noise; 0 if they do.

    They do not if χ² is far from 1, or if an error is 0.
    """
    is_misfit = np.isfinite(fit.chi2_reduced) and not TOO_LOW <= fit.chi2_reduced <= TOO_HIGH
    has_zero_error = bool(np.any(fit.stderr == 0))
    return (store.flag("misfit") if is_misfit else 0) | (store.flag("no_error") if has_zero_error else 0)


def count_failure_reasons(status: np.ndarray) -> str:
    """Return why crops have no fit, as text such as "2 × no light above the noise"; "" if no flag is set.

    `status` holds the flags of the crops, in any shape.
    """
    flags = store.UNTRUSTED & np.asarray(status, int).ravel()
    counts = {text: int(np.sum(flags & bit > 0)) for bit, (_, text) in store.STATUS.items()}
    return "; ".join(f"{count} × {text}" for text, count in counts.items() if count)


def select_preferred_fits(fits: xr.Dataset) -> xr.Dataset:
    """Return the fits of fits.nc in crops centred on the light: by likelihood if the sensor's noise is known."""
    return fits.sel(centring="light", fit=fits.attrs["preferred"])


def read_fit_in_crop(fits: xr.Dataset, crops: xr.Dataset, index: dict[str, int]) -> StoredFit | None:
    """Return one fit of fits.nc with its centre relative to the crop; None if there is none.

    `index` holds the index along each dimension of the grid; fits and crops are reduced to one fit and one centring.
    """
    fit, crop = fits.isel(index), crops.isel(index)
    value, stderr = (np.array([float(fit[f"{name}{suffix}"]) for name in NAMES]) for suffix in ("", "_stderr"))
    if not np.isfinite(value).all():
        return None
    value[X_CENTRE] -= float(crop["left"])
    value[Y_CENTRE] -= float(crop["top"])
    return StoredFit(value, stderr, float(fit["chi2_reduced"]), int(fit["status"]))
