"""The paper's numbers of measured frames: mean and standard deviation over the repeats of an angle and an exposure."""

import numpy as np
import xarray as xr

from spotcheck.fitting.width_law import regress_widths
from spotcheck.paper.results import CENTRING, Results


def _propagation(results: Results) -> tuple[np.ndarray, np.ndarray]:
    """Return p1 and p2 [angle, repeat] in px from the fits of the crops around the maximum."""
    fits = results.open_file("fits").sel(centring=CENTRING, fit="least_squares")
    width = fits["sigma_mean"].transpose("angle", "repeat", "exposure").values
    return regress_widths(width, fits["exposure"].values, results.baseline.laser_px)


def p1(results: Results) -> float:
    """Return the mean p1 over all sites [px]."""
    return float(np.nanmean(_propagation(results)[0]))


def p2(results: Results) -> float:
    """Return the mean p2 over all sites [px]."""
    return float(np.nanmean(_propagation(results)[1]))


def p1_sd(results: Results) -> float:
    """Return the standard deviation of p1 over all sites [px]."""
    return float(np.nanstd(_propagation(results)[0], ddof=1))


def p2_sd(results: Results) -> float:
    """Return the standard deviation of p2 over all sites [px]."""
    return float(np.nanstd(_propagation(results)[1], ddof=1))


def psnr(results: Results, statistic: str) -> xr.DataArray:
    """Return mean or sd of PSNR [angle, exposure] in dB for crops at the maximum and the container range."""
    return results.measured[f"psnr_{statistic}"].sel(registration="maximum", data_range="container")


def psnr_smallest(results: Results) -> float:
    """Return the smallest mean PSNR [dB]."""
    return float(psnr(results, "mean").min())


def psnr_largest(results: Results) -> float:
    """Return the largest mean PSNR [dB]."""
    return float(psnr(results, "mean").max())


def psnr_sd_smallest(results: Results) -> float:
    """Return the smallest standard deviation of PSNR [dB]."""
    return float(psnr(results, "sd").min())


def psnr_sd_largest(results: Results) -> float:
    """Return the largest standard deviation of PSNR [dB]."""
    return float(psnr(results, "sd").max())


def psnr_highest_at_shortest(results: Results) -> float:
    """Return 1 if the mean PSNR over angles is highest at the shortest exposure."""
    return float(np.argmax(psnr(results, "mean").mean("angle").values) == 0)


def contrast_smallest(results: Results) -> float:
    """Return the smallest mean C_s [1]."""
    return float(results.measured["speckle_contrast_mean"].min())


def contrast_largest(results: Results) -> float:
    """Return the largest mean C_s [1]."""
    return float(results.measured["speckle_contrast_mean"].max())


def contrast_sd_smallest(results: Results) -> float:
    """Return the smallest standard deviation of C_s [1]."""
    return float(results.measured["speckle_contrast_sd"].min())


def contrast_sd_largest(results: Results) -> float:
    """Return the largest standard deviation of C_s [1]."""
    return float(results.measured["speckle_contrast_sd"].max())


def contrast_sd_ratio(results: Results) -> float:
    """Return the standard deviation of C_s at the shortest exposure over that at the others, mean over angles [1]."""
    sd = results.measured["speckle_contrast_sd"].mean("angle").values
    return float(sd[0] / sd[1:].mean())


def maximum_smallest(results: Results) -> float:
    """Return the smallest mean maximum [DN]."""
    return float(results.measured["maximum_mean"].min())


def maximum_spread(results: Results) -> float:
    """Return the largest minus the smallest mean maximum over angles and exposures [DN]."""
    return float(np.ptp(results.measured["maximum_mean"].values))


def maximum_sd(results: Results) -> float:
    """Return the largest standard deviation of the maximum [DN]."""
    return float(results.measured["maximum_sd"].max())


def _amplitude(results: Results, statistic: str, exposures: slice) -> xr.DataArray:
    """Return mean or sd of the fitted amplitude [angle, exposure] in DN at some exposures."""
    return results.measured[f"amplitude_{statistic}"].isel(exposure=exposures)


def amplitude_short_smallest(results: Results) -> float:
    """Return the smallest mean fitted amplitude at the shortest exposure [DN]."""
    return float(_amplitude(results, "mean", slice(0, 1)).min())


def amplitude_short_largest(results: Results) -> float:
    """Return the largest mean fitted amplitude at the shortest exposure [DN]."""
    return float(_amplitude(results, "mean", slice(0, 1)).max())


def amplitude_long_smallest(results: Results) -> float:
    """Return the smallest mean fitted amplitude at the longer exposures [DN]."""
    return float(_amplitude(results, "mean", slice(1, None)).min())


def amplitude_long_largest(results: Results) -> float:
    """Return the largest mean fitted amplitude at the longer exposures [DN]."""
    return float(_amplitude(results, "mean", slice(1, None)).max())


def amplitude_sd_short(results: Results) -> float:
    """Return the largest standard deviation of the fitted amplitude at the shortest exposure [DN]."""
    return float(_amplitude(results, "sd", slice(0, 1)).max())


def amplitude_sd_long(results: Results) -> float:
    """Return the largest standard deviation of the fitted amplitude at the longer exposures [DN]."""
    return float(_amplitude(results, "sd", slice(1, None)).max())


def amplitude_gap_long(results: Results) -> float:
    """Return the largest difference between simulated and mean measured amplitude at the longer exposures [DN]."""
    gap = results.simulated["amplitude_mean"] - results.measured["amplitude_mean"]
    return float(np.abs(gap.isel(exposure=slice(1, None))).max())


def width_sd_smallest(results: Results) -> float:
    """Return the smallest standard deviation of the direction-averaged width [px]."""
    return float(results.measured["sigma_mean_sd"].min())


def width_sd_largest(results: Results) -> float:
    """Return the largest standard deviation of the direction-averaged width [px]."""
    return float(results.measured["sigma_mean_sd"].max())


def _width_gap(results: Results) -> xr.DataArray:
    """Return the difference between measured and simulated mean width [angle, exposure] in px."""
    return abs(results.measured["sigma_mean_mean"] - results.simulated["sigma_mean_mean"])


def width_gap(results: Results) -> float:
    """Return the largest difference between measured and simulated width at 0–90° [px]."""
    return float(_width_gap(results).sel(angle=slice(0, 90)).max())


def width_gap_at_135(results: Results) -> float:
    """Return the difference between measured and simulated width at 135° and the shortest exposure [px]."""
    return float(_width_gap(results).sel(angle=135).isel(exposure=0))


def _width_step(results: Results, start: float, end: float) -> np.ndarray:
    """Return the change of the mean width [exposure] in px from one angle to another [degree]."""
    width = results.measured["sigma_mean_mean"]
    return (width.sel(angle=end) - width.sel(angle=start)).values


def width_rises_to_90(results: Results) -> float:
    """Return 1 if the mean width rises from 45° to 90° at every exposure."""
    return float(np.all(_width_step(results, 45, 90) > 0))


def width_drops_to_135(results: Results) -> float:
    """Return 1 if the mean width drops from 90° to 135° at every exposure."""
    return float(np.all(_width_step(results, 90, 135) < 0))


def simulated_sums_inside(results: Results) -> float:
    """Return the number of conditions whose simulated sum lies outside the measured mean ± standard deviation."""
    gap = np.abs(results.simulated["sum_mean"] - results.measured["sum_mean"])
    return float((gap > results.measured["sum_sd"]).sum())


def sum_sd_largest(results: Results) -> float:
    """Return the largest standard deviation of the sum [DN]."""
    return float(results.measured["sum_sd"].max())


def peak_ratio_smallest(results: Results) -> float:
    """Return the smallest mean ratio of peak to plateau pixels [%]."""
    return 100 * float(results.measured["peak_ratio_mean"].min())


def peak_ratio_largest(results: Results) -> float:
    """Return the largest mean ratio of peak to plateau pixels [%]."""
    return 100 * float(results.measured["peak_ratio_mean"].max())
