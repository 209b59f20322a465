"""Numbers of the paper's measured side: means and standard deviations over the repeats of an angle and an exposure."""

import numpy as np
import xarray as xr

from spotcheck.fitting.width_law import regress_widths
from spotcheck.paper.results import CENTRING, Results


def _propagation(results: Results) -> tuple[np.ndarray, np.ndarray]:
    """p1, p2 [angle, repeat] in px from the fits of the crops at the maximum."""
    fits = results.file("fits").sel(centring=CENTRING, fit="least_squares")
    width = fits["sigma_mean"].transpose("angle", "repeat", "exposure").values
    return regress_widths(width, fits["exposure"].values, results.baseline.laser_px)


def p1(results: Results) -> float:
    """Mean p1 over all sites [px]."""
    return float(np.nanmean(_propagation(results)[0]))


def p2(results: Results) -> float:
    """Mean p2 over all sites [px]."""
    return float(np.nanmean(_propagation(results)[1]))


def p1_sd(results: Results) -> float:
    """Standard deviation of p1 over all sites [px]."""
    return float(np.nanstd(_propagation(results)[0], ddof=1))


def p2_sd(results: Results) -> float:
    """Standard deviation of p2 over all sites [px]."""
    return float(np.nanstd(_propagation(results)[1], ddof=1))


def _psnr(results: Results, which: str) -> xr.DataArray:
    """PSNR mean or sd [angle, exposure] in dB as the paper has it: crops at the maximum, range of the container."""
    return results.measured[f"psnr_{which}"].sel(registration="maximum", data_range="container")


def psnr_smallest(results: Results) -> float:
    """Smallest mean PSNR [dB]."""
    return float(_psnr(results, "mean").min())


def psnr_largest(results: Results) -> float:
    """Largest mean PSNR [dB]."""
    return float(_psnr(results, "mean").max())


def psnr_sd_smallest(results: Results) -> float:
    """Smallest standard deviation of PSNR [dB]."""
    return float(_psnr(results, "sd").min())


def psnr_sd_largest(results: Results) -> float:
    """Largest standard deviation of PSNR [dB]."""
    return float(_psnr(results, "sd").max())


def psnr_highest_at_shortest(results: Results) -> float:
    """1 if the mean PSNR over angles is highest at the shortest exposure."""
    return float(np.argmax(_psnr(results, "mean").mean("angle").values) == 0)


def contrast_smallest(results: Results) -> float:
    """Smallest mean C_s [1]."""
    return float(results.measured["speckle_contrast_mean"].min())


def contrast_largest(results: Results) -> float:
    """Largest mean C_s [1]."""
    return float(results.measured["speckle_contrast_mean"].max())


def contrast_sd_smallest(results: Results) -> float:
    """Smallest standard deviation of C_s [1]."""
    return float(results.measured["speckle_contrast_sd"].min())


def contrast_sd_largest(results: Results) -> float:
    """Largest standard deviation of C_s [1]."""
    return float(results.measured["speckle_contrast_sd"].max())


def contrast_sd_ratio(results: Results) -> float:
    """Standard deviation of C_s at the shortest exposure over that at the others, averaged over angles [1]."""
    sd = results.measured["speckle_contrast_sd"].mean("angle").values
    return float(sd[0] / sd[1:].mean())


def maximum_smallest(results: Results) -> float:
    """Smallest mean maximum [DN]."""
    return float(results.measured["maximum_mean"].min())


def maximum_spread(results: Results) -> float:
    """Largest less smallest mean maximum over angles and exposures [DN]."""
    return float(np.ptp(results.measured["maximum_mean"].values))


def maximum_sd(results: Results) -> float:
    """Largest standard deviation of the maximum [DN]."""
    return float(results.measured["maximum_sd"].max())


def _amplitude(results: Results, which: str, exposures: slice) -> xr.DataArray:
    return results.measured[f"amplitude_{which}"].isel(exposure=exposures)


def amplitude_short_smallest(results: Results) -> float:
    """Smallest mean fitted amplitude at the shortest exposure [DN]."""
    return float(_amplitude(results, "mean", slice(0, 1)).min())


def amplitude_short_largest(results: Results) -> float:
    """Largest mean fitted amplitude at the shortest exposure [DN]."""
    return float(_amplitude(results, "mean", slice(0, 1)).max())


def amplitude_long_smallest(results: Results) -> float:
    """Smallest mean fitted amplitude at the longer exposures [DN]."""
    return float(_amplitude(results, "mean", slice(1, None)).min())


def amplitude_long_largest(results: Results) -> float:
    """Largest mean fitted amplitude at the longer exposures [DN]."""
    return float(_amplitude(results, "mean", slice(1, None)).max())


def amplitude_sd_short(results: Results) -> float:
    """Largest standard deviation of the fitted amplitude at the shortest exposure [DN]."""
    return float(_amplitude(results, "sd", slice(0, 1)).max())


def amplitude_sd_long(results: Results) -> float:
    """Largest standard deviation of the fitted amplitude at the longer exposures [DN]."""
    return float(_amplitude(results, "sd", slice(1, None)).max())


def amplitude_gap_long(results: Results) -> float:
    """Largest difference between simulated and mean measured amplitude at the longer exposures [DN]."""
    gap = results.simulated["amplitude_mean"] - results.measured["amplitude_mean"]
    return float(np.abs(gap.isel(exposure=slice(1, None))).max())


def width_sd_smallest(results: Results) -> float:
    """Smallest standard deviation of the direction-averaged width [px]."""
    return float(results.measured["sigma_mean_sd"].min())


def width_sd_largest(results: Results) -> float:
    """Largest standard deviation of the direction-averaged width [px]."""
    return float(results.measured["sigma_mean_sd"].max())


def _width_gap(results: Results) -> xr.DataArray:
    return abs(results.measured["sigma_mean_mean"] - results.simulated["sigma_mean_mean"])


def width_gap(results: Results) -> float:
    """Largest difference between measured and simulated width at 0–90° [px]."""
    return float(_width_gap(results).sel(angle=slice(0, 90)).max())


def width_gap_at_135(results: Results) -> float:
    """Difference between measured and simulated width at 135° and the shortest exposure [px]."""
    return float(_width_gap(results).sel(angle=135).isel(exposure=0))


def _width_step(results: Results, start: float, end: float) -> np.ndarray:
    width = results.measured["sigma_mean_mean"]
    return (width.sel(angle=end) - width.sel(angle=start)).values


def width_rises_to_90(results: Results) -> float:
    """1 if the mean width rises from 45° to 90° at every exposure."""
    return float(np.all(_width_step(results, 45, 90) > 0))


def width_drops_to_135(results: Results) -> float:
    """1 if the mean width drops from 90° to 135° at every exposure."""
    return float(np.all(_width_step(results, 90, 135) < 0))


def simulated_sums_inside(results: Results) -> float:
    """Conditions in which the simulated sum lies outside the measured mean ± standard deviation [1]."""
    gap = np.abs(results.simulated["sum_mean"] - results.measured["sum_mean"])
    return float((gap > results.measured["sum_sd"]).sum())


def sum_sd_largest(results: Results) -> float:
    """Largest standard deviation of the sum [DN]."""
    return float(results.measured["sum_sd"].max())


def peak_ratio_smallest(results: Results) -> float:
    """Smallest mean ratio of peak to plateau pixels [%]."""
    return 100 * float(results.measured["peak_ratio_mean"].min())


def peak_ratio_largest(results: Results) -> float:
    """Largest mean ratio of peak to plateau pixels [%]."""
    return 100 * float(results.measured["peak_ratio_mean"].max())
