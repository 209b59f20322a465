"""The paper's numbers of its measured frames.

`check_numbers` calls each public function by its name, which is the `id` of an entry in published.yaml. Means and
standard deviations are over the repeats of each condition, a pair of angle and exposure: variables NAME_mean and
NAME_sd [angle, exposure] of `results.measured`. Those of `results.simulated` are averaged over angles [exposure].
Exposures ascend, so index 0 is the shortest. Crops are those around the maximum. C_s is the speckle contrast. p1 and p2
are the parameters of the beam propagation p_b = p1 ln(t/1 s) + p2, the width σ_g of the spot without that of the laser.
"""

import numpy as np
import xarray as xr

from spotcheck.fitting.width_law import regress_widths
from spotcheck.paper.results import CENTRING, Results

# Exposures by index: the shortest, and all others.
SHORTEST, LONGER = slice(0, 1), slice(1, None)


def _regress_beam_propagation(results: Results) -> tuple[np.ndarray, np.ndarray]:
    """Return p1 and p2 [angle, repeat] in px, fitted to the widths over ln(t/1 s); NaN with fewer than two widths."""
    fits = results.open_file("fits").sel(centring=CENTRING, fit="least_squares")
    width = fits["sigma_mean"].transpose("angle", "repeat", "exposure").values
    return regress_widths(width, fits["exposure"].values, results.baseline.laser_px)


def p1(results: Results) -> float:
    """Return the mean p1 over all sites, pairs of angle and repeat [px]."""
    return float(np.nanmean(_regress_beam_propagation(results)[0]))


def p2(results: Results) -> float:
    """Return the mean p2 over all sites, pairs of angle and repeat [px]."""
    return float(np.nanmean(_regress_beam_propagation(results)[1]))


def p1_sd(results: Results) -> float:
    """Return the standard deviation (n − 1) of p1 over all sites, pairs of angle and repeat [px]."""
    return float(np.nanstd(_regress_beam_propagation(results)[0], ddof=1))


def p2_sd(results: Results) -> float:
    """Return the standard deviation (n − 1) of p2 over all sites, pairs of angle and repeat [px]."""
    return float(np.nanstd(_regress_beam_propagation(results)[1], ddof=1))


def psnr(results: Results, statistic: str) -> xr.DataArray:
    """Return PSNR [angle, exposure] in dB of crops around the maximum, for a data range of 65535 DN.

    `statistic` is "mean" or "sd" over repeats.
    """
    return results.measured[f"psnr_{statistic}"].sel(registration="maximum", data_range="container")


def psnr_smallest(results: Results) -> float:
    """Return the smallest mean PSNR of a condition [dB]."""
    return float(psnr(results, "mean").min())


def psnr_largest(results: Results) -> float:
    """Return the largest mean PSNR of a condition [dB]."""
    return float(psnr(results, "mean").max())


def psnr_sd_smallest(results: Results) -> float:
    """Return the smallest standard deviation of PSNR of a condition [dB]."""
    return float(psnr(results, "sd").min())


def psnr_sd_largest(results: Results) -> float:
    """Return the largest standard deviation of PSNR of a condition [dB]."""
    return float(psnr(results, "sd").max())


def psnr_highest_at_shortest(results: Results) -> float:
    """Return 1 if PSNR, averaged over angles, is highest at the shortest exposure, else 0."""
    return float(np.argmax(psnr(results, "mean").mean("angle").values) == 0)


def contrast_smallest(results: Results) -> float:
    """Return the smallest mean C_s of a condition [1]."""
    return float(results.measured["speckle_contrast_mean"].min())


def contrast_largest(results: Results) -> float:
    """Return the largest mean C_s of a condition [1]."""
    return float(results.measured["speckle_contrast_mean"].max())


def contrast_sd_smallest(results: Results) -> float:
    """Return the smallest standard deviation of C_s of a condition [1]."""
    return float(results.measured["speckle_contrast_sd"].min())


def contrast_sd_largest(results: Results) -> float:
    """Return the largest standard deviation of C_s of a condition [1]."""
    return float(results.measured["speckle_contrast_sd"].max())


def contrast_sd_ratio(results: Results) -> float:
    """Return the standard deviation of C_s at the shortest exposure divided by its mean at the longer ones [1].

    Standard deviations are averaged over angles before they are divided.
    """
    shortest, *longer = results.measured["speckle_contrast_sd"].mean("angle").values
    return float(shortest / np.mean(longer))


def maximum_smallest(results: Results) -> float:
    """Return the smallest mean maximum of a crop, over all conditions [DN]."""
    return float(results.measured["maximum_mean"].min())


def maximum_spread(results: Results) -> float:
    """Return the largest minus the smallest mean maximum of a crop, over all conditions [DN]."""
    return float(np.ptp(results.measured["maximum_mean"].values))


def maximum_sd(results: Results) -> float:
    """Return the largest standard deviation of the maximum of a crop, over all conditions [DN]."""
    return float(results.measured["maximum_sd"].max())


def _amplitude(results: Results, statistic: str, exposures: slice) -> xr.DataArray:
    """Return the fitted amplitude [angle, exposure] in DN at `SHORTEST` or `LONGER`; `statistic` is "mean" or "sd"."""
    return results.measured[f"amplitude_{statistic}"].isel(exposure=exposures)


def amplitude_short_smallest(results: Results) -> float:
    """Return the smallest mean fitted amplitude at the shortest exposure [DN]."""
    return float(_amplitude(results, "mean", SHORTEST).min())


def amplitude_short_largest(results: Results) -> float:
    """Return the largest mean fitted amplitude at the shortest exposure [DN]."""
    return float(_amplitude(results, "mean", SHORTEST).max())


def amplitude_long_smallest(results: Results) -> float:
    """Return the smallest mean fitted amplitude at the longer exposures [DN]."""
    return float(_amplitude(results, "mean", LONGER).min())


def amplitude_long_largest(results: Results) -> float:
    """Return the largest mean fitted amplitude at the longer exposures [DN]."""
    return float(_amplitude(results, "mean", LONGER).max())


def amplitude_sd_short(results: Results) -> float:
    """Return the largest standard deviation of the fitted amplitude at the shortest exposure [DN]."""
    return float(_amplitude(results, "sd", SHORTEST).max())


def amplitude_sd_long(results: Results) -> float:
    """Return the largest standard deviation of the fitted amplitude at the longer exposures [DN]."""
    return float(_amplitude(results, "sd", LONGER).max())


def amplitude_gap_long(results: Results) -> float:
    """Return the largest absolute difference of simulated and measured mean amplitude at longer exposures [DN]."""
    gap = results.simulated["amplitude_mean"] - results.measured["amplitude_mean"]
    return float(np.abs(gap.isel(exposure=LONGER)).max())


def width_sd_smallest(results: Results) -> float:
    """Return the smallest standard deviation of the fitted width, the mean of both axes [px]."""
    return float(results.measured["sigma_mean_sd"].min())


def width_sd_largest(results: Results) -> float:
    """Return the largest standard deviation of the fitted width, the mean of both axes [px]."""
    return float(results.measured["sigma_mean_sd"].max())


def _width_gap(results: Results) -> xr.DataArray:
    """Return the absolute difference of measured and simulated mean width [angle, exposure] in px."""
    return abs(results.measured["sigma_mean_mean"] - results.simulated["sigma_mean_mean"])


def width_gap(results: Results) -> float:
    """Return the largest absolute difference of measured and simulated mean width at angles from 0° to 90° [px]."""
    return float(_width_gap(results).sel(angle=slice(0, 90)).max())


def width_gap_at_135(results: Results) -> float:
    """Return the absolute difference of measured and simulated mean width at 135° and the shortest exposure [px]."""
    return float(_width_gap(results).sel(angle=135).isel(exposure=0))


def _width_change(results: Results, start: float, end: float) -> np.ndarray:
    """Return the change of the mean width [exposure] in px from angle `start` to angle `end` [degree]."""
    width = results.measured["sigma_mean_mean"]
    return (width.sel(angle=end) - width.sel(angle=start)).values


def width_rises_to_90(results: Results) -> float:
    """Return 1 if the mean width rises from 45° to 90° at every exposure, else 0."""
    return float(np.all(_width_change(results, 45, 90) > 0))


def width_drops_to_135(results: Results) -> float:
    """Return 1 if the mean width drops from 90° to 135° at every exposure, else 0."""
    return float(np.all(_width_change(results, 90, 135) < 0))


def simulated_sums_inside(results: Results) -> float:
    """Return the number of conditions whose simulated sum is outside the measured mean ± standard deviation.

    The name is the paper's claim, that all are inside. Conditions without a value (NaN) are not counted.
    """
    gap = np.abs(results.simulated["sum_mean"] - results.measured["sum_mean"])
    return float((gap > results.measured["sum_sd"]).sum())


def sum_sd_largest(results: Results) -> float:
    """Return the largest standard deviation of the sum of a crop, over all conditions [DN]."""
    return float(results.measured["sum_sd"].max())


def peak_ratio_smallest(results: Results) -> float:
    """Return the smallest mean of the peak ratio, the number of peak pixels over that of plateau pixels [%]."""
    return 100 * float(results.measured["peak_ratio_mean"].min())


def peak_ratio_largest(results: Results) -> float:
    """Return the largest mean of the peak ratio, the number of peak pixels over that of plateau pixels [%]."""
    return 100 * float(results.measured["peak_ratio_mean"].max())
