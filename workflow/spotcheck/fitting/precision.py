"""The precision stage: how precisely this rig measures a spot, and at which exposure best.

Scatter over repeats against the Cramér–Rao bound, for measured and simulated fits: 1 means that noise alone limits.
And the bound of one frame over the exposure, along the calibrated law, with the sensor's whole law of a reading.
"""

import numpy as np
import xarray as xr

from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting import fisher
from spotcheck.fitting.bounds import BEYOND, POINTS
from spotcheck.fitting.calibration import USED
from spotcheck.fitting.fits import preferred
from spotcheck.fitting.fitted import PARAMETERS
from spotcheck.io import store
from spotcheck.model.baseline import Baseline, of_instrument
from spotcheck.sensor import SensorModel

# A round spot has no orientation to scatter.
SCATTERED = tuple(name for name in PARAMETERS if name != "orientation")
# The exposure that is enough: the shortest whose bound is within this part of the least.
ENOUGH = 0.05


def frame_bounds(
    baseline: Baseline, amplitude: float, sigma: float, exposure_s: float, sensor: SensorModel, side: int
) -> np.ndarray:
    """Bounds on the standard deviations of amplitude [DN], x0, y0 [px], σ_g [px] and offset [DN] from one frame of
    side × side pixels with a centred spot, all five unknown.

    σ_g is that of a circular spot, and so also the bound on the mean of both widths of an elliptical fit.
    """
    pixel, middle = np.arange(side, dtype=float), side // 2
    dark_e = sensor.dark_current_e_per_s * exposure_s

    def mean_e(peak, x0, y0, width, offset):
        light = baseline.declared_light(pixel[None, :], pixel[:, None], peak, x0, y0, width) + offset
        return light / sensor.gain_dn_per_e + dark_e

    at = (amplitude, middle, middle, sigma, 0.0)
    matrix = fisher.of_mean(mean_e, at, lambda mean: fisher.reading_information(mean, sensor))
    return np.sqrt(fisher.bounds(matrix))


def precision_of(
    fits: dict[str, xr.Dataset],
    calibration: xr.Dataset,
    instrument: Instrument,
    exposures: np.ndarray,
    sensor: SensorModel | None,
    side: int,
) -> xr.Dataset:
    """Precision file of `measured` and `simulated` fits; `skipped` where the sensor's noise is unknown.

    `scatter`, `bound` and `ratio` [parameter, source, grid without repeat] with the ratio's standard error and the
    number of frames; where a law in t was found, the bounds over `fine_exposure`, else `no_design` says why not.
    """
    titles = {name: fits["measured"].attrs[name] for name in ("title", "dataset", "not_recorded")}
    ds = xr.Dataset(attrs=titles)
    if sensor is None:
        return ds.assign_attrs(skipped="the bound needs gain and read noise of the sensor")
    for source, found in fits.items():
        for name, values in _scatter(preferred(found)).items():
            ds[f"{name}_{source}"] = values
    peak = np.nan if "skipped" in calibration.attrs else float(calibration["peak"].sel(estimator=USED))
    if not np.isfinite(peak):
        why = calibration.attrs.get("skipped", "no peak was found below full scale")
        return ds.assign_attrs(no_design=f"the bound over exposure needs a law in t: {why}")
    p1, p2 = (float(calibration[n].sel(estimator=USED)) for n in ("p1_mean", "p2_mean"))
    return _design(ds, of_instrument(instrument, exposures), p1, p2, peak, exposures, sensor, side)


def _scatter(fits: xr.Dataset) -> dict[str, xr.DataArray]:
    good = (fits["status"] & store.UNTRUSTED) == 0
    value, stderr = (
        xr.concat([fits[f"{n}{suffix}"].where(good) for n in SCATTERED], dim="parameter", coords="minimal")
        for suffix in ("", "_stderr")
    )
    names = {"parameter": ("parameter", np.array(SCATTERED, dtype=object))}
    value, stderr = (v.drop_vars(["fit", "centring"], errors="ignore").assign_coords(names) for v in (value, stderr))
    value["parameter"].attrs.update(units="1", long_name="fitted parameter")
    count = good.sum("repeat").drop_vars(["fit", "centring"], errors="ignore")
    enough = count > 1
    scatter = value.std("repeat", ddof=1).where(enough)
    bound = ((stderr**2).mean("repeat") ** 0.5).where(enough)
    ratio = scatter / bound
    texts = {
        "scatter": (scatter, "of the parameter", "standard deviation (n - 1) over repeats"),
        "bound": (bound, "of the parameter", "Cramer-Rao bound on it, rms over repeats"),
        "ratio": (ratio, "1", "scatter over bound"),
        "ratio_stderr": (ratio / np.sqrt(2 * (count - 1)), "1", "standard error of the ratio"),
        "frames": (count, "1", "usable frames"),
    }
    return {name: values.assign_attrs(units=units, long_name=text) for name, (values, units, text) in texts.items()}


def _design(
    ds: xr.Dataset,
    baseline: Baseline,
    p1: float,
    p2: float,
    peak: float,
    exposures: np.ndarray,
    sensor: SensorModel,
    side: int,
) -> xr.Dataset:
    fine = np.geomspace(exposures.min() / BEYOND, exposures.max() * BEYOND, POINTS)
    fine = fine[baseline.sigma(fine, p1, p2) > 1.0]
    times = np.concatenate([fine, exposures])
    found = np.array(
        [
            frame_bounds(baseline, peak * baseline.relative_peak(t, p1, p2), baseline.sigma(t, p1, p2), t, sensor, side)
            for t in times
        ]
    )
    width = found[: len(fine), 3]
    ds["fine_exposure"] = ("fine_exposure", fine, {"units": "s", "long_name": "exposure time"})
    ds["design_exposure"] = ("design_exposure", exposures, {"units": "s", "long_name": "exposure time of the dataset"})
    for k, (name, units, text) in enumerate(
        (
            ("amplitude", "DN", "peak"),
            ("x_centre", "pixel", "column of the centre"),
            ("y_centre", "pixel", "row of the centre"),
            ("sigma", "pixel", "direction-averaged width"),
            ("offset", "DN", "offset"),
        )
    ):
        long_name = f"bound on the standard deviation of the {text} from one frame"
        for dim, values in (("fine_exposure", found[: len(fine), k]), ("design_exposure", found[len(fine) :, k])):
            ds[f"{name}_bound_over_{dim}"] = (dim, values, {"units": units, "long_name": long_name})
    least = int(np.argmin(width))
    enough = int(np.argmax(width <= (1 + ENOUGH) * width[least]))
    for name, k, text in (
        ("best_exposure", least, "exposure with the least bound on the width"),
        ("enough_exposure", enough, f"shortest exposure whose bound on the width is within {ENOUGH:.0%} of the least"),
    ):
        ds[name] = ((), fine[k], {"units": "s", "long_name": text})
    top = peak * baseline.plateau(baseline.relative_peak(fine, p1, p2)) + sensor.black_level_dn
    ds["plateau"] = ("fine_exposure", top, {"units": "DN", "long_name": "mean reading of the plateau without clips"})
    return ds


def pooled_ratio(ds: xr.Dataset, source: str, parameter: str) -> tuple[float, float]:
    """Scatter over bound of all conditions together, rms weighted by their degrees of freedom, and its standard
    error."""
    ratio = ds[f"ratio_{source}"].sel(parameter=parameter).values
    freedom = np.where(np.isfinite(ratio), ds[f"frames_{source}"].values - 1, 0)
    if freedom.sum() < 1:
        return np.nan, np.nan
    pooled = np.sqrt(np.sum(freedom * np.nan_to_num(ratio) ** 2) / freedom.sum())
    return float(pooled), float(pooled / np.sqrt(2 * freedom.sum()))


def sentence(ds: xr.Dataset) -> str:
    """What the file says, for a reader: how precise one frame is, which exposure is best, and what limits."""
    parts = []
    if "best_exposure" in ds:
        times, width = ds["design_exposure"].values, ds["sigma_bound_over_design_exposure"].values
        texts = [f"{value:.2g} px" for value in width]
        own = ", ".join(f"{text} at {_time(t)}" for t, text in zip(times, texts, strict=True))
        if len(set(texts)) == 1 and len(texts) > 1:
            own = f"{texts[0]} from {_time(times[0])} to {_time(times[-1])}"
        parts.append(f"One frame can fix the direction-averaged width to {own} (Cramér–Rao bound, standard deviation)")
        best, enough = float(ds["best_exposure"]), float(ds["enough_exposure"])
        fine = ds["fine_exposure"].values
        edge = " (the longest that was looked at)" if best == fine[-1] else ""
        edge = " (the shortest that was looked at)" if best == fine[0] else edge
        parts.append(
            f"the bound is least at {_time(best)}{edge}, {float(ds['sigma_bound_over_fine_exposure'].min()):.2g} px"
        )
        if enough < best:
            parts.append(f"from {_time(enough)} on it falls by no more than {100 * ENOUGH:g} %")
    for source in ("measured", "simulated"):
        ratio, error = pooled_ratio(ds, source, "sigma_mean")
        # Copies of one frame do not scatter at all.
        if np.isfinite(ratio) and error > 0:
            digits = max(0, 1 - int(np.floor(np.log10(error))))
            meaning = ""
            if source == "measured":
                limited = ratio > 1 + 3 * error and ratio > 1.2
                meaning = ": what differs between repeats limits, not noise" if limited else ": noise limits"
            parts.append(
                f"{source} widths scatter over repeats by {ratio:.{digits}f} ± {error:.{digits}f} bounds{meaning}"
            )
    text = "; ".join(parts)
    return f"{text[0].upper()}{text[1:]}." if text else "No condition has two usable repeats."


def _time(seconds: float) -> str:
    factor, unit = next((f, u) for f, u in ((1e6, "µs"), (1e3, "ms"), (1.0, "s")) if seconds * f < 1000 or u == "s")
    return f"{seconds * factor:.3g} {unit}"
