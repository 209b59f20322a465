"""The fit stage: every crop of a file, one at a time, by both estimators."""

from functools import partial
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.characterization.outlier_pixels import OutlierPixels, find_outlier_pixels
from spotcheck.characterization.pixel_maps import SensorMaps
from spotcheck.crops.cropping import is_usable, iterate_cells
from spotcheck.fitting.by_maps import ByMaps
from spotcheck.fitting.fitted import NAMES, PARAMETERS, SpotFits
from spotcheck.fitting.spotfit import fit_spots
from spotcheck.io import progress, store
from spotcheck.io.plus_minus import two_digits
from spotcheck.sensor import SensorModel
from spotcheck.sensor.pixel_maps import PixelMaps

FITS = {
    "likelihood": "maximum likelihood of the instrument's spot, Gaussian or top hat, under the sensor's noise",
    "least_squares": "unweighted least squares of a Gaussian, the paper's estimator",
}
# A fit is looked at for odd pixels where its χ² exceeds 1 by so many standard deviations: noise alone does so once in
# 1e9. It is made again without them where that leaves less than this part of the excess.
SECOND_LOOK, LEFT = 6.0, 0.5


# χ² per degree of freedom of a spot fit that is flagged. Noise alone puts it within some percent of 1. Below half, the
# stated noise is too large. Speckle on the composite brings up to 170: above, residuals are 14 times the stated noise.
TOO_LOW, TOO_HIGH = 0.5, 200.0


class Spot(NamedTuple):
    """One stored fit: values and standard errors in the order of `PARAMETERS`, centre relative to the crop, χ² per
    degree of freedom, status."""

    value: np.ndarray
    stderr: np.ndarray
    chi2_reduced: float
    status: int


def fit_crops(
    crops: xr.Dataset,
    sensor: SensorModel | None,
    top_hat: bool = False,
    integrated: bool = False,
    maps: SensorMaps | None = None,
) -> xr.Dataset:
    """Fits of both centrings: values, standard errors, χ² and status on the grid; centres in pixels of the sensor.

    `top_hat` is the plateau of the light, `integrated` whether a pixel reads the mean of the light over it. Without a
    sensor model there is no likelihood; the attribute `preferred` says which fit to use. With `maps` of the sensor's
    pixels, which enter the likelihood, `chi2_without_maps` and `amplitude_moved` and the like say what they changed.
    """
    dims = (*store.grid_dims(crops), "centring", "fit")
    shape = (*(crops.sizes[d] for d in dims[:-1]), len(FITS))
    value, stderr = (np.full((*shape, len(PARAMETERS)), np.nan) for _ in range(2))
    chi2, left_out = np.full(shape, np.nan), np.full(shape, "", dtype=object)
    status = np.repeat(crops["status"].values[..., None], len(FITS), axis=-1)
    if sensor is None:
        status[..., 0] |= store.flag("no_noise")
    origin = {1: crops["left"].values, 2: crops["top"].values}
    told = None if maps is None or sensor is None else ByMaps(crops, dims[:-1])
    for index in progress.track(list(iterate_cells(crops, dims[:-1])), "fitting spots"):
        at = tuple(index.values())
        if not is_usable(crops["status"].values[at]):
            continue
        image = crops["image"].isel(index).values
        part = None if told is None or maps is None else told.cut(maps, index)
        own, odd = _both(image, sensor, top_hat, integrated, part)
        if told is not None:
            good = np.where(odd.mask, np.nan, image) if odd else image
            told.compare(at, own[0], fit_spots(good, sensor, top_hat=top_hat, integrated=integrated))
        for k, fit in own.items():
            value[(*at, k)], stderr[(*at, k)] = fit.value, fit.stderr
            chi2[(*at, k)] = fit.chi2_reduced
            status[(*at, k)] |= int(fit.flags) | remarks_of(fit) | (store.flag("left_out") if odd else 0)
            left_out[(*at, k)] = odd.describe(int(origin[1][at]), int(origin[2][at])) if odd else ""
            for axis, start in origin.items():
                value[(*at, k, axis)] += start[at]
    keep = [name for name in crops.coords if set(crops[name].dims) <= set(dims)]
    ds = xr.Dataset(coords={name: crops[name] for name in keep}, attrs=_titles(crops))
    ds["fit"] = ("fit", np.array(list(FITS), dtype=object), {"units": "1", "long_name": "how the spot was fitted"})
    for k, (name, (units, long_name)) in enumerate(PARAMETERS.items()):
        long_name += " on the sensor" if k in origin else ""
        ds[name] = (dims, value[..., k], {"units": units, "long_name": long_name})
        ds[f"{name}_stderr"] = (
            dims,
            stderr[..., k],
            {"units": units, "long_name": f"standard error of {long_name}"},
        )
    ds["orientation_stderr"].attrs["infinite"] = "the spot is round within its noise"
    ds["chi2_reduced"] = (
        dims,
        chi2,
        {"units": "1", "long_name": "chi-square per degree of freedom under sensor noise"},
    )
    ds["left_out"] = (dims, left_out, {"units": "1", "long_name": "pixels of the sensor that were left out, and why"})
    ds["status"] = (dims, status.astype("i4"), store.status_attributes())
    remarks = told.put(ds, maps) if told is not None and maps is not None else []
    chosen = "least_squares" if sensor is None else "likelihood"
    ds = ds.assign_attrs(preferred=chosen, **{f"fit_{name}": text for name, text in FITS.items()})
    return store.add_remarks(ds, [*remarks, *_on_misfits(preferred(ds)["chi2_reduced"].values)])


def _on_misfits(chi2: np.ndarray) -> list[str]:
    """Sentences on frames whose χ² is far from 1 [any shape; NaN: none]."""
    out, known = [], chi2[np.isfinite(chi2)]
    keys = "sensor.gain_dn_per_e or sensor.read_noise_e"
    for own, why in (
        (
            known[known < TOO_LOW],
            f"the noise that is stated is too large: {keys} is too high or in another unit, or sensor.black_level_dn is"
            " missing or too low",
        ),
        (
            known[known > TOO_HIGH],
            f"the light is far from a Gaussian, as the verdict tells, or {keys} is too low or in another unit",
        ),
    ):
        if own.size:
            middle = two_digits(float(np.median(own)))
            out.append(f"{own.size} of {known.size} fits have a χ² per degree of freedom of about {middle}: {why}")
    return out


def reasons_text(status: np.ndarray) -> str:
    """Why crops have no fit, by their flags [any shape]: "2 × no light above the noise"; "" where none is flagged."""
    flags = store.UNTRUSTED & np.asarray(status, int).ravel()
    counts = {text: int(np.sum(flags & bit > 0)) for bit, (_, text) in store.STATUS.items()}
    return "; ".join(f"{count} × {text}" for text, count in counts.items() if count)


def _both(
    image: np.ndarray, sensor: SensorModel | None, top_hat: bool, integrated: bool, maps: PixelMaps | None
) -> tuple[dict[int, SpotFits], OutlierPixels | None]:
    """Fits of an image in the order of `FITS`, and the odd pixels that they leave out."""
    equal = partial(fit_spots, sensor=sensor, weighting="equal", integrated=integrated)
    if sensor is None:
        return {1: equal(image)}, None
    likely = partial(fit_spots, sensor=sensor, top_hat=top_hat, integrated=integrated, maps=maps)
    first = likely(image)
    excess = float(first.chi2_reduced) - 1
    noise = np.sqrt(2 / np.count_nonzero(np.isfinite(image)))
    if not excess <= SECOND_LOOK * noise:
        odd = find_outlier_pixels(image, sensor)
        if odd.mask.any():
            good = np.where(odd.mask, np.nan, image)
            again = likely(good)
            better = not np.isfinite(excess) or again.chi2_reduced - 1 < LEFT * excess
            if again.flags == 0 and better:
                return {0: again, 1: equal(good)}, odd
    return {0: first, 1: equal(image)}, None


def remarks_of(fit: SpotFits) -> int:
    """Flags of a fit that is there, but whose errors are not those of its noise."""
    misfit = np.isfinite(fit.chi2_reduced) and not TOO_LOW <= fit.chi2_reduced <= TOO_HIGH
    certain = bool(np.any(fit.stderr == 0))
    return (store.flag("misfit") if misfit else 0) | (store.flag("no_error") if certain else 0)


def preferred(fits: xr.Dataset) -> xr.Dataset:
    """The likelihood, or least squares where the sensor's noise is unknown; from the crops centred on the light."""
    return fits.sel(centring="light", fit=fits.attrs["preferred"])


def fit_in_crop(fits: xr.Dataset, crops: xr.Dataset, index: dict[str, int]) -> Spot | None:
    """A stored fit with its centre relative to the crop again; None where there is none."""
    at = fits.isel(index)
    value = np.array([float(at[name]) for name in NAMES])
    if not np.isfinite(value).all():
        return None
    value[1] -= float(crops["left"].isel(index))
    value[2] -= float(crops["top"].isel(index))
    stderr = np.array([float(at[f"{name}_stderr"]) for name in NAMES])
    return Spot(value, stderr, float(at["chi2_reduced"]), int(at["status"]))


def _titles(ds: xr.Dataset) -> dict[str, str]:
    return {name: ds.attrs[name] for name in ("title", "dataset", "not_recorded")}
