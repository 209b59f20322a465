"""The precision stage: scatter of the fits over repeats against the Cramér–Rao bound, and the best exposure.

A ratio of scatter to bound of 1 means that noise alone limits the precision. It is computed for measured and simulated
fits. The bound of one frame over the exposure time follows from the calibrated width law (`WidthLaw`), which gives peak
and width of a spot, and from the sensor's full distribution of a reading. The baseline (`Baseline`) is the model of the
light that the instrument file declares.
"""

import numpy as np
import xarray as xr

from spotcheck.dataset.instrument import Instrument
from spotcheck.fitting import fisher
from spotcheck.fitting.bounds import sample_exposures
from spotcheck.fitting.calibration import read_width_law
from spotcheck.fitting.crop_fits import select_preferred_fits
from spotcheck.fitting.fit_results import PARAMETERS
from spotcheck.fitting.variables import add_variable
from spotcheck.fitting.width_law import WidthLaw
from spotcheck.io import store
from spotcheck.model.baseline import Baseline, build_baseline
from spotcheck.sensor import SensorModel

# Parameters whose scatter is evaluated. The orientation of a round spot is undefined, so its scatter has no meaning.
SCATTERED = tuple(name for name in PARAMETERS if name != "orientation")
# The sufficient exposure is the shortest whose bound exceeds the least by no more than this fraction.
BOUND_TOLERANCE = 0.05
# Name of the file's variable, units and description of each parameter of `compute_frame_bounds`.
BOUND_PARAMETERS = (
    ("amplitude", "DN", "peak"),
    ("x_centre", "pixel", "column of the centre"),
    ("y_centre", "pixel", "row of the centre"),
    ("sigma", "pixel", "direction-averaged width"),
    ("offset", "DN", "offset"),
)
# Scatter counts as larger than the bound by this ratio, if it is significant by so many standard errors.
EXCESS_RATIO, EXCESS_SIGMAS = 1.2, 3.0


def compute_frame_bounds(
    baseline: Baseline, amplitude: float, sigma: float, exposure_s: float, sensor: SensorModel, side: int
) -> np.ndarray:
    """Return bounds on the standard deviations of the parameters of a centred circular spot in one frame.

    The bound on σ_g is also that on the mean of both widths of an elliptical fit.

    Parameters
    ----------
    baseline : model of the light.
    amplitude, sigma : peak [DN] and width σ_g [px] of the spot.
    exposure_s : exposure time [s], for dark current.
    sensor : model of the sensor.
    side : rows and columns of the frame [px].

    Returns
    -------
    np.ndarray
        Bounds on amplitude [DN], x0 [px], y0 [px], σ_g [px] and offset [DN] if all five are unknown, in the order of
        `BOUND_PARAMETERS`.
    """
    pixel, middle = np.arange(side, dtype=float), side // 2
    dark_e = sensor.dark_current_e_per_s * exposure_s

    def mean_e(peak, x0, y0, width, offset):
        """Return the mean electrons [row, column] of a frame."""
        light = baseline.declared_light(pixel[None, :], pixel[:, None], peak, x0, y0, width) + offset
        return light / sensor.gain_dn_per_e + dark_e

    parameters = (amplitude, middle, middle, sigma, 0.0)
    matrix = fisher.information_of_mean(mean_e, parameters, lambda mean: fisher.reading_information(mean, sensor))
    return np.sqrt(fisher.cramer_rao_bounds(matrix))


def compute_precision(
    fits: dict[str, xr.Dataset],
    calibration: xr.Dataset,
    instrument: Instrument,
    exposures: np.ndarray,
    sensor: SensorModel | None,
    side: int,
) -> xr.Dataset:
    """Compute precision.nc from measured and simulated fits.

    Parameters
    ----------
    fits : fits.nc by source, "measured" and "simulated".
    calibration : calibration.nc of the dataset.
    instrument : optics, laser and photon budget.
    exposures : exposure times of the dataset [exposure] in s.
    sensor : model of the sensor; None if gain or read noise is unknown.
    side : rows and columns of a frame [px].

    Returns
    -------
    xr.Dataset
        Content of precision.nc. For each source: `scatter`, `bound` and `ratio` [parameter, grid without repeat] with
        the ratio's standard error and the number of frames. The bounds over `fine_exposure` need a width law; without
        it the attribute `no_design` gives the reason. Without a sensor there is only the attribute `skipped` with the
        reason.
    """
    ds = xr.Dataset(attrs={name: fits["measured"].attrs[name] for name in ("title", "dataset", "not_recorded")})
    if sensor is None:
        return ds.assign_attrs(skipped="the bound needs gain and read noise of the sensor")
    for source, source_fits in fits.items():
        for name, values in _compare_scatter(select_preferred_fits(source_fits)).items():
            ds[f"{name}_{source}"] = values
    law = read_width_law(calibration)
    if law is None:
        reason = calibration.attrs.get("skipped", "no peak was found below full scale")
        return ds.assign_attrs(no_design=f"the bound over exposure needs a law in t: {reason}")
    _add_bounds_over_exposure(ds, build_baseline(instrument, exposures), law, exposures, sensor, side)
    return ds


def _compare_scatter(fits: xr.Dataset) -> dict[str, xr.DataArray]:
    """Compare the scatter of fits over repeats with the bound.

    Returns
    -------
    dict
        `scatter`, `bound`, `ratio`, `ratio_stderr` [parameter, grid without repeat] and `frames` [grid without repeat],
        the number of usable frames. All but `frames` are NaN with fewer than two frames.
    """
    fits = fits.drop_vars(["fit", "centring"], errors="ignore")
    is_trusted = (fits["status"] & store.UNTRUSTED) == 0
    names = xr.Variable("parameter", np.array(SCATTERED, object), {"units": "1", "long_name": "fitted parameter"})
    value, stderr = (
        xr.concat([fits[f"{name}{suffix}"].where(is_trusted) for name in SCATTERED], names, coords="minimal")
        for suffix in ("", "_stderr")
    )
    count = is_trusted.sum("repeat")
    scatter = value.std("repeat", ddof=1).where(count > 1)
    bound = ((stderr**2).mean("repeat") ** 0.5).where(count > 1)
    ratio = scatter / bound
    ratio_stderr = ratio / np.sqrt(2 * (count - 1))
    return {
        "scatter": scatter.assign_attrs(units="of the parameter", long_name="standard deviation (n - 1) over repeats"),
        "bound": bound.assign_attrs(units="of the parameter", long_name="Cramer-Rao bound on it, rms over repeats"),
        "ratio": ratio.assign_attrs(units="1", long_name="scatter over bound"),
        "ratio_stderr": ratio_stderr.assign_attrs(units="1", long_name="standard error of the ratio"),
        "frames": count.assign_attrs(units="1", long_name="usable frames"),
    }


def _add_bounds_over_exposure(
    ds: xr.Dataset, baseline: Baseline, law: WidthLaw, exposures: np.ndarray, sensor: SensorModel, side: int
) -> None:
    """Add the bounds of one frame over exposure time, the best and the sufficient exposure, and the plateau.

    The bounds are computed at closely spaced times of a curve and at the `exposures` [exposure] in s of the dataset,
    for images of `side` rows and columns. The plateau is the mean reading where a top hat cuts the light, along the
    curve.
    """
    curve_exposures = sample_exposures(baseline, law, exposures)
    add_variable(ds, "fine_exposure", "fine_exposure", curve_exposures, "s", "exposure time")
    add_variable(ds, "design_exposure", "design_exposure", exposures, "s", "exposure time of the dataset")
    for dim, times in (("fine_exposure", curve_exposures), ("design_exposure", exposures)):
        values = np.array([compute_frame_bounds(baseline, *law.spot_at(baseline, t), t, sensor, side) for t in times])
        for k, (name, units, description) in enumerate(BOUND_PARAMETERS):
            long_name = f"bound on the standard deviation of the {description} from one frame"
            add_variable(ds, f"{name}_bound_over_{dim}", dim, values[:, k], units, long_name)
    width_bound = ds["sigma_bound_over_fine_exposure"].values
    best = int(np.argmin(width_bound))
    sufficient = int(np.argmax(width_bound <= (1 + BOUND_TOLERANCE) * width_bound[best]))
    add_variable(ds, "best_exposure", (), curve_exposures[best], "s", "exposure with the least bound on the width")
    long_name = f"shortest exposure whose bound on the width is within {BOUND_TOLERANCE:.0%} of the least"
    add_variable(ds, "enough_exposure", (), curve_exposures[sufficient], "s", long_name)
    peak, _ = law.spot_at(baseline, curve_exposures)
    plateau = baseline.plateau(peak) + sensor.black_level_dn
    add_variable(ds, "plateau", "fine_exposure", plateau, "DN", "mean reading of the plateau without clips")


def pool_ratios(ds: xr.Dataset, source: str, parameter: str) -> tuple[float, float]:
    """Return the ratio of scatter to bound over all conditions, and its standard error; NaN without repeats.

    It is the root mean square of the ratios, weighted by their degrees of freedom.

    Parameters
    ----------
    ds : precision.nc of a dataset.
    source : "measured" or "simulated".
    parameter : one of `SCATTERED`.
    """
    ratio = ds[f"ratio_{source}"].sel(parameter=parameter).values
    degrees_of_freedom = np.where(np.isfinite(ratio), ds[f"frames_{source}"].values - 1, 0)
    if degrees_of_freedom.sum() < 1:
        return np.nan, np.nan
    pooled = np.sqrt(np.sum(degrees_of_freedom * np.nan_to_num(ratio) ** 2) / degrees_of_freedom.sum())
    return float(pooled), float(pooled / np.sqrt(2 * degrees_of_freedom.sum()))


def summarize_precision(ds: xr.Dataset) -> str:
    """Return precision.nc in one sentence: the bound of one frame, the best exposure, and what limits the fits.

    Only the bounds are described if no condition has two usable repeats, and vice versa.
    """
    clauses = _describe_bounds(ds) if "best_exposure" in ds else []
    for source in ("measured", "simulated"):
        ratio, error = pool_ratios(ds, source, "sigma_mean")
        # Copies of one frame do not scatter at all.
        if np.isfinite(ratio) and error > 0:
            # Two significant digits of the error.
            digits = max(0, 1 - int(np.floor(np.log10(error))))
            text = f"{source} widths scatter over repeats by {ratio:.{digits}f} ± {error:.{digits}f} bounds"
            if source == "measured":
                exceeds = ratio > 1 + EXCESS_SIGMAS * error and ratio > EXCESS_RATIO
                text += ": what differs between repeats limits, not noise" if exceeds else ": noise limits"
            clauses.append(text)
    text = "; ".join(clauses)
    return f"{text[0].upper()}{text[1:]}." if text else "No condition has two usable repeats."


def _describe_bounds(ds: xr.Dataset) -> list[str]:
    """Return clauses of a sentence on the bound on the width at the dataset's exposures and at the best exposure."""
    times = [_format_time(t) for t in ds["design_exposure"].values]
    widths = [f"{value:.2g} px" for value in ds["sigma_bound_over_design_exposure"].values]
    bounds = ", ".join(f"{width} at {time}" for time, width in zip(times, widths, strict=True))
    if len(set(widths)) == 1 and len(widths) > 1:
        bounds = f"{widths[0]} from {times[0]} to {times[-1]}"
    best, sufficient = float(ds["best_exposure"]), float(ds["enough_exposure"])
    exposures, least_bound = ds["fine_exposure"].values, float(ds["sigma_bound_over_fine_exposure"].min())
    # Notes on the ends of the curve, beyond which the bound may be less.
    end_notes = {exposures[-1]: " (the longest that was looked at)", exposures[0]: " (the shortest that was looked at)"}
    clauses = [
        f"One frame can fix the direction-averaged width to {bounds} (Cramér–Rao bound, standard deviation)",
        f"the bound is least at {_format_time(best)}{end_notes.get(best, '')}, {least_bound:.2g} px",
    ]
    if sufficient < best:
        clauses.append(f"from {_format_time(sufficient)} on it falls by no more than {100 * BOUND_TOLERANCE:g} %")
    return clauses


def _format_time(seconds: float) -> str:
    """Return a time as text with three digits, in the unit of µs, ms and s that gives a number below 1000."""
    scales = (1e6, "µs"), (1e3, "ms"), (1.0, "s")
    factor, unit = next((scale for scale in scales if seconds * scale[0] < 1000), scales[-1])
    return f"{seconds * factor:.3g} {unit}"
