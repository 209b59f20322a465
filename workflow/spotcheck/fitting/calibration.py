"""The calibrate stage: p1, p2 and the peak by three estimators, and the bias of each in a simulation.

p1 and p2 [px] are slope and intercept of the width law: σ_g = M σ_la/s_px + p1 ln(t / 1 s) + p2 (`WidthLaw`), where the
first term is the laser's own width on the sensor. The baseline (`Baseline`) is the model of the light that the
instrument file declares. A site is a combination of the grid's other conditions, such as angle and repeat; its frames
differ in exposure time alone.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import xarray as xr

from spotcheck.crops.cropping import is_usable, iterate_cells
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.likelihood import JointFit, SiteFrame, fit_baseline
from spotcheck.fitting.variables import add_variable
from spotcheck.fitting.width_law import WidthLaw, find_peak, fit_simulated_widths, regress_widths
from spotcheck.io import store
from spotcheck.model.baseline import Baseline, build_baseline
from spotcheck.sensor import SensorModel

# Estimators of p1 and p2: name in calibration.nc, and description.
ESTIMATORS = {
    "regression": "straight line over ln t of the fitted width less the laser's own (Eqs. 7 and 8)",
    "regression_of_width": "straight line over ln t of the fitted width, nothing subtracted (Eq. 8)",
    "likelihood": "maximum likelihood of the baseline model on all frames",
}
# The estimators by regression of fitted widths, which give values of single sites.
REGRESSIONS = ("regression", "regression_of_width")
# The simulation uses the estimator of the paper.
SIMULATION_ESTIMATOR = "regression"
TOO_FEW_EXPOSURES = "p1 and p2 need usable spots of one site at two exposures or more"
ONE_EXPOSURE_PER_SITE = (
    f"{TOO_FEW_EXPOSURES}, but no repeat in manifest.csv has two; count repeats anew in each condition if the sample"
    " did not move between exposures"
)


def explain_missing_law(instrument: Instrument, exposures_s: Sequence[float] | np.ndarray) -> str:
    """Return a sentence that says why there is no law of the width over exposure time; "" if there may be one.

    `exposures_s` are the distinct exposure times of the spots [s].
    """
    if not len(exposures_s):
        return "p1 and p2 need exposure times, and the manifest gives none"
    if instrument.model.photon_budget == "free":
        return "model.photon_budget is free: every frame has its own width, no law in t"
    return TOO_FEW_EXPOSURES if len(exposures_s) < 2 else ""


def explain_missing_sites(dataset: Dataset) -> str:
    """Return a sentence that says that no site has two exposures, as counted by the manifest; "" if one has."""
    exposure_axis = [axis.name for axis in dataset.axes].index("exposure")
    cells = {index for index, _ in dataset.cells()}
    # A site is one angle, repeat and combination of the declared conditions.
    sites = {(*index[:exposure_axis], *index[exposure_axis + 1 :]) for index in cells}
    return ONE_EXPOSURE_PER_SITE if len(cells) == len(sites) else ""


def calibrate(crops: xr.Dataset, fits: xr.Dataset, instrument: Instrument, sensor: SensorModel | None) -> xr.Dataset:
    """Compute calibration.nc: p1, p2 and the peak by each of `ESTIMATORS`, with averages over sites and biases.

    Parameters
    ----------
    crops, fits : crops.nc and fits.nc of the dataset.
    instrument : optics, laser and photon budget.
    sensor : model of the sensor; if None, there is no likelihood.

    Returns
    -------
    xr.Dataset
        Content of calibration.nc; NaN where an estimator has no result. If the frames do not support a law over
        exposure time, it has only the attribute `skipped` with the reason.
    """
    ds = xr.Dataset(attrs={name: fits.attrs[name] for name in ("title", "dataset", "not_recorded")})
    exposures = fits["exposure"].values if "exposure" in fits.coords else np.empty(0)
    if reason := explain_missing_law(instrument, exposures):
        return ds.assign_attrs(skipped=reason)
    baseline = build_baseline(instrument, exposures)
    widths, site_dims = _select_widths(fits)
    if (np.isfinite(widths.values).sum(axis=-1) < 2).all():
        return ds.assign_attrs(skipped=TOO_FEW_EXPOSURES)

    add_variable(ds, "estimator", "estimator", np.array([*ESTIMATORS], dtype=object), "1", "how p1 and p2 were found")
    ds = ds.assign_coords({d: fits[d] for d in site_dims if d in fits.coords})
    without_laser = replace(baseline, laser_px=0.0)
    models = dict(zip(ESTIMATORS, (baseline, without_laser, baseline), strict=True))
    _add_site_values(ds, widths.values, exposures, models, site_dims)
    _add_averages(ds, site_dims)

    side, maxima = crops.sizes["x"], _average_maxima(crops)
    laws = {}
    for estimator in REGRESSIONS:
        p1, p2 = (float(ds[name].sel(estimator=estimator)) for name in ("p1_mean", "p2_mean"))
        peak = find_peak(models[estimator], p1, p2, exposures, maxima, sensor, side)
        laws[estimator] = WidthLaw(p1, p2, peak)
    start, has_converged = laws[SIMULATION_ESTIMATOR], False
    if sensor is not None and np.isfinite(start.peak):
        joint = _fit_all_frames(crops, fits, baseline, sensor, start, site_dims)
        has_converged = joint.has_converged
        if has_converged:
            laws["likelihood"] = WidthLaw(*joint.value)
            # p1 and p2 are the first two values of the joint fit.
            for k, name in enumerate(("p1", "p2")):
                ds[f"{name}_mean"].loc[{"estimator": "likelihood"}] = joint.value[k]
                ds[f"{name}_stderr"].loc[{"estimator": "likelihood"}] = joint.stderr[k]
    peaks = [laws[name].peak if name in laws else np.nan for name in ESTIMATORS]
    add_variable(ds, "peak", "estimator", peaks, "DN", "peak of the Gaussian at the longest exposure")
    _add_biases(ds, models, laws, exposures, side)
    add_variable(ds, "likelihood_converged", (), int(has_converged), "1", "1 if the joint fit converged")
    add_variable(
        ds, "laser_width", (), baseline.laser_px, "pixel", "M sigma_la/s_px, the laser's own width on the sensor"
    )
    return ds.assign_attrs(
        used=SIMULATION_ESTIMATOR, **{f"estimator_{name}": text for name, text in ESTIMATORS.items()}
    )


def read_width_law(calibration: xr.Dataset) -> WidthLaw | None:
    """Return the width law of calibration.nc that the simulation uses; None if no p1, p2 and peak were found."""
    if "skipped" in calibration.attrs:
        return None
    results = calibration.sel(estimator=SIMULATION_ESTIMATOR)
    law = WidthLaw(*(float(results[name]) for name in ("p1_mean", "p2_mean", "peak")))
    return law if np.isfinite(law.peak) else None


def _select_widths(fits: xr.Dataset) -> tuple[xr.DataArray, tuple[str, ...]]:
    """Return the direction-averaged widths [*site_dims, exposure] in px, and `site_dims`, the dimensions of sites.

    The widths are those of least-squares fits in crops centred on the light; NaN without a usable fit.
    """
    spots = fits.sel(centring="light", fit="least_squares")
    widths = spots["sigma_mean"].where((spots["status"] & store.UNTRUSTED) == 0)
    site_dims = tuple(str(dim) for dim in widths.dims if dim != "exposure")
    return widths.transpose(*site_dims, "exposure"), site_dims


def _add_site_values(
    ds: xr.Dataset, widths: np.ndarray, exposures: np.ndarray, models: dict[str, Baseline], site_dims: tuple[str, ...]
) -> None:
    """Add p1 and p2 [estimator, *site_dims] in px by regression of widths [*site_dims, exposure] in px.

    The likelihood gives NaN: its p1 and p2 are common to all sites. `models` holds the baseline of each estimator.
    """
    regressions = [regress_widths(widths, exposures, models[estimator].laser_px) for estimator in REGRESSIONS]
    for name, values in zip(("p1", "p2"), zip(*regressions, strict=True), strict=True):
        values_by_estimator = np.stack([*values, np.full_like(values[0], np.nan)])
        add_variable(ds, name, ("estimator", *site_dims), values_by_estimator, "pixel", f"{name} of each site")


def _add_averages(ds: xr.Dataset, site_dims: tuple[str, ...]) -> None:
    """Add means and standard deviations (n − 1) of p1 and p2: over repeats, over the means of angles, over all sites.

    Repeats are all dimensions of a site except the angle. NaN sites are left out.
    """
    repeat_dims = [dim for dim in site_dims if dim != "angle"]
    for name in ("p1", "p2"):
        values = ds[name]
        mean, by_angle, sd_all = values.mean(site_dims), values.mean(repeat_dims), values.std(site_dims, ddof=1)
        stderr = sd_all / np.sqrt(values.notnull().sum(site_dims))
        sd_repeats, sd_angles = values.std(repeat_dims, ddof=1), by_angle.std("angle", ddof=1)
        for suffix, statistic, long_name in (
            ("mean", mean, f"mean of {name} over all sites"),
            ("sd_all", sd_all, f"standard deviation of {name} over all sites"),
            ("by_angle", by_angle, f"mean of {name} at each angle"),
            ("sd_repeats", sd_repeats, f"standard deviation of {name} over the repeats of an angle"),
            ("sd_angles", sd_angles, f"standard deviation over angles of the means of {name}"),
            ("stderr", stderr, f"standard error of the mean of {name}"),
        ):
            add_variable(ds, f"{name}_{suffix}", statistic.dims, statistic.values, "pixel", long_name)


def _average_maxima(crops: xr.Dataset) -> np.ndarray:
    """Return the largest reading of a crop, averaged over all sites at each exposure [exposure] in DN.

    It is NaN at an exposure without a usable crop. `crops` is crops.nc; its crops around the brightest pixel are used.
    """
    crops_at_maximum = crops.sel(centring="maximum")
    maxima: list[list[float]] = [[] for _ in range(crops.sizes["exposure"])]
    for index in iterate_cells(crops, store.grid_dims(crops)):
        if is_usable(crops_at_maximum["status"].isel(index)):
            maxima[index["exposure"]].append(float(np.nanmax(crops_at_maximum["image"].isel(index).values)))
    return np.array([np.mean(values) if values else np.nan for values in maxima])


def _fit_all_frames(
    crops: xr.Dataset, fits: xr.Dataset, model: Baseline, sensor: SensorModel, law: WidthLaw, site_dims: tuple[str, ...]
) -> JointFit:
    """Fit the baseline to all frames at once that have a spot fit, with one centre for each site.

    The fit starts at `law`, and at the centre of the longest exposure of each site. Sites without a spot fit are left
    out.

    Parameters
    ----------
    crops, fits : Dataset
        crops.nc and fits.nc.
    model : Baseline
        Model of the light.
    sensor : SensorModel
        Model of the sensor.
    law : WidthLaw
        Width law from which p1, p2 and the peak start.
    site_dims : tuple of str
        Dimensions of the grid that distinguish sites.
    """
    light_crops, light_fits = crops.sel(centring="light"), select_preferred_fits(fits)

    def read_pixels(index: dict[str, int]) -> np.ndarray:
        """Return a crop [row, column] in DN; it is read from disk each time, so that memory never holds all."""
        return light_crops["image"].isel(index).values

    frames: list[SiteFrame] = []
    centres: list[tuple[float, float]] = []
    for site in iterate_cells(crops, site_dims):
        # Centres on the sensor [exposure] in px, NaN without a fit; exposures increase.
        x, y = (light_fits[name].isel(site).values for name in ("x_centre", "y_centre"))
        fitted_exposures = np.flatnonzero(np.isfinite(x)).tolist()
        for k in fitted_exposures:
            index = site | {"exposure": k}
            left, top = (int(light_crops[name].isel(index)) for name in ("left", "top"))
            exposure_s = float(crops["exposure"][k])
            frames.append(SiteFrame(len(centres), exposure_s, left, top, partial(read_pixels, index)))
        if fitted_exposures:
            centres.append((x[fitted_exposures[-1]], y[fitted_exposures[-1]]))
    return fit_baseline(frames, model, sensor, np.array(law), np.array(centres))


def _add_biases(
    ds: xr.Dataset, models: dict[str, Baseline], laws: dict[str, WidthLaw], exposures: np.ndarray, side: int
) -> None:
    """Add the bias of p1 and p2 [px] of each estimator: the values from fits of simulated frames, less those simulated.

    `models` and `laws` hold the baseline and the width law of each estimator. The bias is NaN without a law. Frames are
    simulated at the exposures [exposure] in s, with `side` rows and columns.
    """
    biases = np.full((len(ESTIMATORS), 2), np.nan)
    for k, estimator in enumerate(ESTIMATORS):
        law, model = laws.get(estimator), models[estimator]
        if law is not None and np.isfinite(law.peak):
            widths = fit_simulated_widths(model, law, exposures, side)
            p1, p2 = regress_widths(widths, exposures, model.laser_px)
            biases[k] = p1 - law.p1, p2 - law.p2
    for name, values in zip(("p1", "p2"), biases.T, strict=True):
        long_name = f"{name} after simulate and fit, less {name} put in"
        add_variable(ds, f"{name}_miss", "estimator", values, "pixel", long_name)
