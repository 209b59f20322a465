"""The calibrate stage: p1, p2 and the peak by three methods, and how far each misses its own input."""

from dataclasses import replace
from functools import partial

import numpy as np
import xarray as xr

from spotcheck.crops.cropping import is_usable, iterate_cells
from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting.fits import preferred
from spotcheck.fitting.likelihood import JointFit, SiteFrame, fit_baseline
from spotcheck.fitting.propagation import peak_from_maxima, regress, simulate_and_fit
from spotcheck.io import store
from spotcheck.model.baseline import Baseline, of_instrument
from spotcheck.sensor import SensorModel

ESTIMATORS = {
    "regression": "straight line over ln t of the fitted width less the laser's own (Eqs. 7 and 8)",
    "regression_of_width": "straight line over ln t of the fitted width, nothing subtracted (Eq. 8)",
    "likelihood": "maximum likelihood of the baseline model on all frames",
}
# What the simulation runs on: the paper's own estimator.
USED = "regression"


def calibrate(crops: xr.Dataset, fits: xr.Dataset, instrument: Instrument, sensor: SensorModel | None) -> xr.Dataset:
    """Calibration file; with `skipped` and its reason in the attributes where the design does not support a law in
    t."""
    ds = xr.Dataset(attrs={name: fits.attrs[name] for name in ("title", "dataset", "not_recorded")})
    if "exposure" not in fits.coords:
        return ds.assign_attrs(skipped="p1 and p2 need exposure times, and the manifest gives none")
    exposures = fits["exposure"].values
    baseline = of_instrument(instrument, exposures)
    if baseline.photon_budget == "free":
        return ds.assign_attrs(skipped="model.photon_budget is free: every frame has its own width, no law in t")
    light, site_dims = _widths(fits)
    if (np.isfinite(light.values).sum(axis=-1) < 2).all():
        return ds.assign_attrs(skipped="p1 and p2 need usable spots of one site at two exposures or more")

    ds["estimator"] = (
        "estimator",
        np.array(list(ESTIMATORS), dtype=object),
        {"units": "1", "long_name": "how p1 and p2 were found"},
    )
    ds = ds.assign_coords({d: fits[d] for d in site_dims if d in fits.coords})
    per_site = {}
    for estimator, laser in (("regression", baseline.laser_px), ("regression_of_width", 0.0)):
        per_site[estimator] = regress(light.values, exposures, laser)
    blank = np.full_like(per_site[USED][0], np.nan)
    for k, name in enumerate(("p1", "p2")):
        values = np.stack([per_site[m][k] if m in per_site else blank for m in ESTIMATORS])
        ds[name] = (("estimator", *site_dims), values, _attrs(f"{name} of each site"))
    _averages(ds, site_dims)

    results = {m: np.array([ds["p1_mean"].sel(estimator=m), ds["p2_mean"].sel(estimator=m)], float) for m in per_site}
    maximum = _maxima(crops)
    side = crops.sizes["x"]
    peaks, converged = {}, False
    for estimator, (p1, p2) in results.items():
        model = baseline if estimator == USED else replace(baseline, laser_px=0.0)
        peaks[estimator] = peak_from_maxima(model, p1, p2, exposures, maximum, sensor, side)
    if sensor is not None and np.isfinite(peaks[USED]):
        start = np.array([*results[USED], peaks[USED]])
        joint = _likelihood(crops, fits, baseline, sensor, start, site_dims)
        converged = joint.converged
        if converged:
            results["likelihood"], peaks["likelihood"] = joint.value[:2], joint.value[2]
            for k, name in enumerate(("p1", "p2")):
                ds[f"{name}_mean"].loc[{"estimator": "likelihood"}] = joint.value[k]
                ds[f"{name}_stderr"].loc[{"estimator": "likelihood"}] = joint.stderr[k]
    ds["peak"] = (
        "estimator",
        [peaks.get(m, np.nan) for m in ESTIMATORS],
        _attrs("peak of the Gaussian at the longest exposure", "DN"),
    )
    _misses(ds, baseline, results, peaks, exposures, side)
    ds["likelihood_converged"] = (
        (),
        int(converged),
        {"units": "1", "long_name": "1 if the joint fit converged"},
    )
    ds["laser_width"] = (
        (),
        baseline.laser_px,
        _attrs("M sigma_la/s_px, the laser's own width on the sensor"),
    )
    return ds.assign_attrs(used=USED, **{f"estimator_{name}": text for name, text in ESTIMATORS.items()})


def _attrs(long_name: str, units: str = "pixel") -> dict[str, str]:
    return {"units": units, "long_name": long_name}


def _widths(fits: xr.Dataset) -> tuple[xr.DataArray, tuple[str, ...]]:
    """σ̄ of usable fits [site dims..., exposure] from the crops centred on the light, and the site dims."""
    own = fits.sel(centring="light", fit="least_squares")
    good = (own["status"] & store.UNTRUSTED) == 0
    width = own["sigma_mean"].where(good)
    site_dims = tuple(str(d) for d in width.dims if d != "exposure")
    return width.transpose(*site_dims, "exposure"), site_dims


def _averages(ds: xr.Dataset, site_dims: tuple[str, ...]) -> None:
    """Means and standard deviations (n − 1) over repeats, over angles (of their means), and over all sites."""
    for name in ("p1", "p2"):
        own = ds[name]
        ds[f"{name}_mean"] = own.mean(site_dims).assign_attrs(_attrs(f"mean of {name} over all sites"))
        ds[f"{name}_sd_all"] = own.std(site_dims, ddof=1).assign_attrs(
            _attrs(f"standard deviation of {name} over all sites")
        )
        ds[f"{name}_by_angle"] = own.mean([d for d in site_dims if d != "angle"]).assign_attrs(
            _attrs(f"mean of {name} at each angle")
        )
        ds[f"{name}_sd_repeats"] = own.std([d for d in site_dims if d != "angle"], ddof=1).assign_attrs(
            _attrs(f"standard deviation of {name} over the repeats of an angle")
        )
        ds[f"{name}_sd_angles"] = (
            ds[f"{name}_by_angle"]
            .std("angle", ddof=1)
            .assign_attrs(_attrs(f"standard deviation over angles of the means of {name}"))
        )
        count = own.notnull().sum(site_dims)
        ds[f"{name}_stderr"] = (ds[f"{name}_sd_all"] / np.sqrt(count)).assign_attrs(
            _attrs(f"standard error of the mean of {name}")
        )


def _maxima(crops: xr.Dataset) -> np.ndarray:
    """Mean of the crops' maxima at each exposure [DN]."""
    dims = store.grid_dims(crops)
    own = crops.sel(centring="maximum")
    maxima: list[list[float]] = [[] for _ in range(crops.sizes["exposure"])]
    for index in iterate_cells(crops, dims):
        if is_usable(own["status"].isel(index)):
            maxima[index["exposure"]].append(float(np.nanmax(own["image"].isel(index).values)))
    return np.array([np.mean(values) if values else np.nan for values in maxima])


def _likelihood(
    crops: xr.Dataset,
    fits: xr.Dataset,
    baseline: Baseline,
    sensor: SensorModel,
    start: np.ndarray,
    site_dims: tuple[str, ...],
) -> JointFit:
    """Joint fit of all usable frames, one centre a site, started at the fitted centres."""
    own_crops, own_fits = crops.sel(centring="light"), preferred(fits)
    frames: list[SiteFrame] = []
    centres: list[tuple[float, float]] = []
    for site in iterate_cells(crops, site_dims):
        x, y = (own_fits[name].isel(site).values for name in ("x_centre", "y_centre"))
        good = [k for k in range(crops.sizes["exposure"]) if np.isfinite(x[k])]
        if not good:
            continue
        for k in good:
            index = site | {"exposure": k}
            frames.append(
                SiteFrame(
                    site=len(centres),
                    exposure_s=float(crops["exposure"][k]),
                    left=int(own_crops["left"].isel(index)),
                    top=int(own_crops["top"].isel(index)),
                    pixels=partial(_pixels, own_crops, index),
                )
            )
        centres.append((x[good[-1]], y[good[-1]]))
    return fit_baseline(frames, baseline, sensor, start, np.array(centres))


def _pixels(crops: xr.Dataset, index: dict[str, int]) -> np.ndarray:
    return crops["image"].isel(index).values


def _misses(ds: xr.Dataset, baseline: Baseline, results: dict, peaks: dict, exposures: np.ndarray, side: int) -> None:
    """Simulate at each estimator's p1 and p2, fit, regress in the same way: output less input."""
    miss = np.full((len(ESTIMATORS), 2), np.nan)
    for k, estimator in enumerate(ESTIMATORS):
        if estimator in results and np.isfinite(peaks.get(estimator, np.nan)):
            model = replace(baseline, laser_px=0.0) if estimator == "regression_of_width" else baseline
            p1, p2 = results[estimator]
            widths = simulate_and_fit(model, p1, p2, peaks[estimator], exposures, side)
            again = regress(widths[None, :], exposures, model.laser_px)
            miss[k] = [again[0][0] - p1, again[1][0] - p2]
    for k, name in enumerate(("p1", "p2")):
        ds[f"{name}_miss"] = (
            "estimator",
            miss[:, k],
            _attrs(f"{name} after simulate and fit, less {name} put in"),
        )
