"""The paper's statements without a number, each as a quantity that decides whether it is true.

Means and standard deviations are over the repeats of an angle and an exposure; PSNR is that of crops around the maximum
with the data range 65535, as the paper's values need.
"""

import numpy as np
import xarray as xr

from spotcheck.paper.bright_pixel import variance_over_exposure
from spotcheck.paper.measured import psnr
from spotcheck.paper.results import CENTRING, Results

# Range of PSNR that the paper expects [dB] (Section 3.2.2).
EXPECTED_PSNR_DB = (50.0, 60.0)
# Angle at which PSNR at the shortest exposure is not apart from the others [degree] (Section 6.2.1).
ANGLE_OF_EQUAL_PSNR = 90
# Angles with the largest standard deviation of the maximum [degree] (Section 6.2.3).
ANGLES_OF_LARGEST_MAXIMUM_SD = {0.0, 135.0}
# Parts of the plateau between which the edge of a spot is measured.
EDGE_LEVELS = (0.8, 0.2)
# Half the side of the square within the plateau whose rows and columns are compared, in units of the fitted width.
PLATEAU_HALF_SIDE = 0.6


def full_scale_pixels(results: Results) -> float:
    """Return the number of pixels at the converter's end over all crops of the longest exposure [px]."""
    images = _crops(results, "crops").isel(exposure=-1)
    return float((images >= float(results.open_file("frames")["full_scale"])).sum())


def direction_ratio(results: Results) -> float:
    """Return the variance of p1 between angles over that within angles, the F of a one-way analysis of variance [1]."""
    calibration = results.open_file("calibration").sel(estimator="regression")
    p1 = calibration["p1"].transpose("angle", "repeat").values
    between = p1.shape[1] * np.var(p1.mean(axis=1), ddof=1)
    return float(between / np.var(p1, axis=1, ddof=1).mean())


def widths_grow(results: Results) -> float:
    """Return the number of angles at which the mean width grows with exposure."""
    return _count_angles_rising(results.measured["sigma_mean_mean"])


def edge_steepness(results: Results) -> float:
    """Return the width of the simulated edge over that of the measured edge at the longest exposure [1].

    The edge is the radial distance between `EDGE_LEVELS` of the maximum of the mean profile around the fitted centre.
    """
    simulated, measured = (
        np.median([_edge_width(*frame) for frame in _longest_frames(results, folder)]) for folder in ("simulated/", "")
    )
    return float(simulated / measured)


def horizontal_lines(results: Results) -> float:
    """Return the variance of row means over that of column means on the plateau, median over frames [1]."""
    ratios = []
    for image, x0, y0, sigma_px in _longest_frames(results, ""):
        half = round(PLATEAU_HALF_SIDE * sigma_px)
        row, column = round(y0), round(x0)
        plateau = image[row - half : row + half + 1, column - half : column + half + 1]
        ratios.append(np.var(plateau.mean(axis=1)) / np.var(plateau.mean(axis=0)))
    return float(np.median(ratios))


def psnr_sd_similar(results: Results) -> float:
    """Return the largest over the smallest standard deviation of PSNR among exposures [1]."""
    return _ratio_of_extremes(psnr(results, "sd"))


def psnr_long_apart(results: Results) -> float:
    """Return the number of angles at which the two longer exposures differ by more than a standard deviation."""
    mean, sd = psnr(results, "mean"), psnr(results, "sd")
    difference = np.abs(mean.isel(exposure=1) - mean.isel(exposure=2))
    return float((difference > sd.isel(exposure=[1, 2]).min("exposure")).sum())


def psnr_short_as_printed(results: Results) -> float:
    """Return the number of angles at which the shortest exposure stands apart from both others, or not, as printed."""
    mean, sd = psnr(results, "mean"), psnr(results, "sd")
    longer = {"exposure": [1, 2]}
    is_apart = (mean.isel(exposure=0) > (mean + sd).isel(longer)).all("exposure")
    return float((is_apart == (is_apart["angle"] != ANGLE_OF_EQUAL_PSNR)).sum())


def psnr_outside_expected(results: Results) -> float:
    """Return the number of conditions whose mean ± standard deviation leaves the expected range."""
    mean, sd = psnr(results, "mean"), psnr(results, "sd")
    low, high = EXPECTED_PSNR_DB
    return float(((mean - sd < low) | (mean + sd > high)).sum())


def contrast_sd_long(results: Results) -> float:
    """Return the standard deviation of C_s at the second over that at the longest exposure [1]."""
    by_exposure = _root_mean_square(results.measured["speckle_contrast_sd"])
    return float(by_exposure[1] / by_exposure[2])


def contrast_drops_at_90(results: Results) -> float:
    """Return the number of exposures at which the mean C_s drops from 45° to 90°."""
    contrast = results.measured["speckle_contrast_mean"]
    return float((contrast.sel(angle=90) < contrast.sel(angle=45)).sum())


def contrast_rises_after_90(results: Results) -> float:
    """Return the number of exposures at which the mean C_s rises from 90° to 135°."""
    contrast = results.measured["speckle_contrast_mean"]
    return float((contrast.sel(angle=135) > contrast.sel(angle=90)).sum())


def contrast_falls_with_exposure(results: Results) -> float:
    """Return the number of angles at which the mean C_s falls with exposure."""
    return _count_angles_rising(-results.measured["speckle_contrast_mean"])


def simulated_contrast_falls(results: Results) -> float:
    """Return 1 if the simulated C_s falls with exposure."""
    return float(np.all(np.diff(results.simulated["speckle_contrast_mean"].values) < 0))


def intensity_grows(results: Results) -> float:
    """Return the number of angles at which the mean of the image grows with exposure."""
    return _count_angles_rising(results.measured["sum_mean"])


def image_sd_change(results: Results) -> float:
    """Return how much the image's standard deviation changes with exposure, over how much its mean changes [1].

    Both are logarithms of the ratio between the longest and the shortest exposure, averaged over frames.
    """
    images = _crops(results, "crops")
    deviation, mean = images.std(("y", "x")), images.mean(("y", "x"))
    change = (np.log(values.isel(exposure=-1) / values.isel(exposure=0)).mean() for values in (deviation, mean))
    return float(next(change) / next(change))


def simulated_contrast_below(results: Results) -> float:
    """Return by how many measured standard deviations the simulated C_s is below the measured, mean over conditions."""
    gap = results.measured["speckle_contrast_mean"] - results.simulated["speckle_contrast_mean"]
    return float((gap / results.measured["speckle_contrast_sd"]).mean())


def maximum_sd_angles(results: Results) -> float:
    """Return 1 if the maximum scatters most at the two printed angles."""
    sd = results.measured["maximum_sd"].max("exposure")
    largest = sd["angle"].values[np.argsort(sd.values)[-2:]]
    return float({float(angle) for angle in largest} == ANGLES_OF_LARGEST_MAXIMUM_SD)


def amplitudes_lower_at_shortest(results: Results) -> float:
    """Return the number of angles at which the fitted amplitude is lowest at the shortest exposure."""
    amplitude = results.measured["amplitude_mean"]
    return float((amplitude.isel(exposure=0) < amplitude.isel(exposure=[1, 2]).min("exposure")).sum())


def simulated_amplitude_larger(results: Results) -> float:
    """Return the number of conditions at the longer exposures whose simulated amplitude is above the measured."""
    gap = results.simulated["amplitude_mean"] - results.measured["amplitude_mean"]
    return float((gap.isel(exposure=[1, 2]) > 0).sum())


def width_gap_in_sd(results: Results) -> float:
    """Return the largest distance of the simulated width from the measured mean in standard deviations [1]."""
    gap = np.abs(results.measured["sigma_mean_mean"] - results.simulated["sigma_mean_mean"])
    return float((gap / results.measured["sigma_mean_sd"]).max())


def sum_sd_similar(results: Results) -> float:
    """Return the largest over the smallest standard deviation of the sum among exposures [1]."""
    return _ratio_of_extremes(results.measured["sum_sd"])


def simulated_sums_above(results: Results) -> float:
    """Return by how much the simulated sum is above the measured mean, mean over conditions [%]."""
    return 100 * float((results.simulated["sum_mean"] / results.measured["sum_mean"] - 1).mean())


def variance_sigma_spike(results: Results) -> float:
    """Return the variance of σ_g at 1 µs over its minimum (Fig. 13, printed p1 and p2) [1]."""
    _, variance = variance_over_exposure(results)
    return float(variance[0] / variance.min())


def variance_sigma_rises(results: Results) -> float:
    """Return 1 if the variance of σ_g rises with exposure beyond its minimum (Fig. 13, printed p1 and p2)."""
    _, variance = variance_over_exposure(results)
    return float(np.all(np.diff(variance[np.argmin(variance) :]) > 0))


def variance_peak_rises(results: Results) -> float:
    """Return 1 if the variance of the number of photons rises with exposure (Fig. 13, printed p1 and p2)."""
    variance, _ = variance_over_exposure(results)
    return float(np.all(np.diff(variance) > 0))


def _crops(results: Results, name: str) -> xr.DataArray:
    """Return the crops around the maximum [angle, exposure, repeat, y, x] in DN; `name` is crops or simulated/crops."""
    return results.open_file(name)["image"].sel(centring=CENTRING)


def _longest_frames(results: Results, folder: str) -> list[tuple[np.ndarray, float, float, float]]:
    """Return image [y, x] in DN, centre x and y and width [px] of each crop at the longest exposure.

    `folder` is "" for the measured and "simulated/" for the simulated crops.
    """
    crops = results.open_file(f"{folder}crops").sel(centring=CENTRING).isel(exposure=-1)
    fits = results.open_file(f"{folder}fits").sel(centring=CENTRING, fit="least_squares").isel(exposure=-1)
    images = crops["image"].transpose("angle", "repeat", "y", "x").values
    # Fitted centres are coordinates on the sensor.
    columns = (fits["x_centre"] - crops["left"], fits["y_centre"] - crops["top"], fits["sigma_mean"])
    values = [column.transpose("angle", "repeat").values for column in columns]
    frames = []
    for cell in np.ndindex(images.shape[:2]):
        x0, y0, sigma_px = (float(value[cell]) for value in values)
        frames.append((images[cell], x0, y0, sigma_px))
    return frames


def _edge_width(image: np.ndarray, x0: float, y0: float, sigma_px: float) -> float:
    """Return the radial distance [px] between `EDGE_LEVELS` of the plateau, in the mean profile around the centre.

    The plateau is the mean of the profile within `PLATEAU_HALF_SIDE` of the width.
    """
    rows, columns = np.indices(image.shape)
    radius = np.hypot(columns - x0, rows - y0).astype(int).ravel()
    profile = np.bincount(radius, image.ravel()) / np.maximum(np.bincount(radius), 1)
    plateau = profile[: max(1, round(PLATEAU_HALF_SIDE * sigma_px))].mean()
    high, low = (float(np.argmax(profile < level * plateau)) for level in EDGE_LEVELS)
    return low - high


def _count_angles_rising(values: xr.DataArray) -> float:
    """Return the number of angles at which values [angle, exposure] rise with exposure."""
    return float((values.diff("exposure") > 0).all("exposure").sum())


def _root_mean_square(sd: xr.DataArray) -> np.ndarray:
    """Return the root mean square over angles of standard deviations [angle, exposure], per exposure."""
    return np.sqrt((sd**2).mean("angle").values)


def _ratio_of_extremes(sd: xr.DataArray) -> float:
    """Return the largest over the smallest root mean square among exposures of sd [angle, exposure]."""
    by_exposure = _root_mean_square(sd)
    return float(by_exposure.max() / by_exposure.min())
