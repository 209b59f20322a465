"""The paper's statements without a number, each as a quantity that decides whether it is true.

`check_numbers` calls each public function by its name, which is the `id` of an entry in published.yaml. A condition is
a pair of angle and exposure. NAME_mean and NAME_sd are mean and standard deviation over the repeats of a condition
[angle, exposure] in `results.measured`. Those in `results.simulated` are averaged over angles [exposure]. There are
three exposures, which ascend. Crops are those around the maximum; PSNR is for the data range of 65535 DN, as the
paper's values need. C_s is the speckle contrast, σ_g the width of the spot, µ_p,max the number of photons at its peak.
p1 and p2 are parameters of the width: p_b = p1 ln(t/1 s) + p2 over the exposure t.
"""

import numpy as np
import xarray as xr

from spotcheck.paper.bright_pixel import variance_over_exposure
from spotcheck.paper.measured import LONGER, psnr
from spotcheck.paper.results import CENTRING, Results

# Range of PSNR that the paper expects [dB] (Section 3.2.2).
EXPECTED_PSNR_DB = (50.0, 60.0)
# The only angle at which PSNR at the shortest exposure is printed as not above the others [degree] (Section 6.2.1).
ANGLE_OF_EQUAL_PSNR = 90
# Angles with the largest standard deviation of the maximum [degree] (Section 6.2.3).
ANGLES_OF_LARGEST_MAXIMUM_SD = {0.0, 135.0}
# Levels between which the edge of a spot lies, divided by the level of the plateau.
EDGE_LEVELS = (0.8, 0.2)
# Part of a spot that counts as its plateau: half the side of a square, or radius, in units of the fitted width.
PLATEAU_HALF_SIDE = 0.6


def full_scale_pixels(results: Results) -> float:
    """Return how many pixels reach full scale in all measured crops at the longest exposure together [px]."""
    images = _crops(results, "crops").isel(exposure=-1)
    return float((images >= float(results.open_file("frames")["full_scale"])).sum())


def direction_ratio(results: Results) -> float:
    """Return F of a one-way analysis of variance [1]: variance of p1 between angles divided by that within angles."""
    # calibration.nc has p1 and p2 of each site by several estimators; the paper fits a line to the widths over ln t.
    calibration = results.open_file("calibration").sel(estimator="regression")
    p1 = calibration["p1"].transpose("angle", "repeat").values
    between = p1.shape[1] * np.var(p1.mean(axis=1), ddof=1)
    return float(between / np.var(p1, axis=1, ddof=1).mean())


def widths_grow(results: Results) -> float:
    """Return the number of angles at which the mean width grows with each exposure."""
    return _count_angles_rising(results.measured["sigma_mean_mean"])


def edge_steepness(results: Results) -> float:
    """Return the width of the simulated edge divided by that of the measured edge, at the longest exposure [1].

    Above 1 the measured edge is steeper. Widths are medians of `_edge_width` over frames.
    """
    simulated, measured = (
        np.median([_edge_width(*frame) for frame in _read_longest_exposure(results, folder)])
        for folder in ("simulated/", "")
    )
    return float(simulated / measured)


def horizontal_lines(results: Results) -> float:
    """Return the variance of row means divided by that of column means on the plateau, at the longest exposure [1].

    It is the median over measured frames; above 1 there are horizontal lines.
    """
    ratios = []
    for image, x0, y0, sigma_px in _read_longest_exposure(results, ""):
        half = round(PLATEAU_HALF_SIDE * sigma_px)
        row, column = round(y0), round(x0)
        plateau = image[row - half : row + half + 1, column - half : column + half + 1]
        ratios.append(np.var(plateau.mean(axis=1)) / np.var(plateau.mean(axis=0)))
    return float(np.median(ratios))


def psnr_sd_similar(results: Results) -> float:
    """Return the largest divided by the smallest standard deviation of PSNR among exposures [1]."""
    return _ratio_of_extremes(psnr(results, "sd"))


def psnr_long_apart(results: Results) -> float:
    """Return the number of angles at which PSNR differs between the longer exposures by more than the smaller sd."""
    mean, sd = psnr(results, "mean"), psnr(results, "sd")
    difference = np.abs(mean.isel(exposure=1) - mean.isel(exposure=2))
    return float((difference > sd.isel(exposure=LONGER).min("exposure")).sum())


def psnr_short_as_printed(results: Results) -> float:
    """Return the number of angles that agree with the paper about PSNR at the shortest exposure.

    It is printed as above mean plus standard deviation of both longer exposures, except at `ANGLE_OF_EQUAL_PSNR`.
    """
    mean, sd = psnr(results, "mean"), psnr(results, "sd")
    is_above = (mean.isel(exposure=0) > (mean + sd).isel(exposure=LONGER)).all("exposure")
    return float((is_above == (is_above["angle"] != ANGLE_OF_EQUAL_PSNR)).sum())


def psnr_outside_expected(results: Results) -> float:
    """Return the number of conditions whose mean PSNR ± standard deviation is not within `EXPECTED_PSNR_DB`."""
    mean, sd = psnr(results, "mean"), psnr(results, "sd")
    low, high = EXPECTED_PSNR_DB
    return float(((mean - sd < low) | (mean + sd > high)).sum())


def contrast_sd_long(results: Results) -> float:
    """Return the standard deviation of C_s at the second exposure divided by that at the longest one [1]."""
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
    """Return the number of angles at which the mean C_s falls with each exposure."""
    return _count_angles_rising(-results.measured["speckle_contrast_mean"])


def simulated_contrast_falls(results: Results) -> float:
    """Return 1 if the simulated mean C_s falls with each exposure, else 0."""
    return float(np.all(np.diff(results.simulated["speckle_contrast_mean"].values) < 0))


def intensity_grows(results: Results) -> float:
    """Return the number of angles at which the mean sum of a crop grows with each exposure."""
    return _count_angles_rising(results.measured["sum_mean"])


def image_sd_change(results: Results) -> float:
    """Return the change of the standard deviation of a crop with exposure, divided by the change of its mean [1].

    A change is ln(value at the longest / value at the shortest exposure), averaged over measured frames.
    """
    images = _crops(results, "crops")
    deviation, mean = images.std(("y", "x")), images.mean(("y", "x"))
    sd_change, mean_change = (
        np.log(values.isel(exposure=-1) / values.isel(exposure=0)).mean() for values in (deviation, mean)
    )
    return float(sd_change / mean_change)


def simulated_contrast_below(results: Results) -> float:
    """Return measured minus simulated mean C_s in measured standard deviations, averaged over conditions [1]."""
    gap = results.measured["speckle_contrast_mean"] - results.simulated["speckle_contrast_mean"]
    return float((gap / results.measured["speckle_contrast_sd"]).mean())


def maximum_sd_angles(results: Results) -> float:
    """Return 1 if the maximum of a crop scatters most at `ANGLES_OF_LARGEST_MAXIMUM_SD`, else 0.

    The scatter at an angle is the largest standard deviation among its exposures.
    """
    sd = results.measured["maximum_sd"].max("exposure")
    largest = sd["angle"].values[np.argsort(sd.values)[-len(ANGLES_OF_LARGEST_MAXIMUM_SD) :]]
    return float({float(angle) for angle in largest} == ANGLES_OF_LARGEST_MAXIMUM_SD)


def amplitudes_lower_at_shortest(results: Results) -> float:
    """Return the number of angles at which the mean fitted amplitude is lowest at the shortest exposure."""
    amplitude = results.measured["amplitude_mean"]
    return float((amplitude.isel(exposure=0) < amplitude.isel(exposure=LONGER).min("exposure")).sum())


def simulated_amplitude_larger(results: Results) -> float:
    """Return at how many conditions of the longer exposures the simulated mean amplitude is above the measured one."""
    gap = results.simulated["amplitude_mean"] - results.measured["amplitude_mean"]
    return float((gap.isel(exposure=LONGER) > 0).sum())


def width_gap_in_sd(results: Results) -> float:
    """Return the largest difference of simulated and measured mean width in measured standard deviations [1]."""
    gap = np.abs(results.measured["sigma_mean_mean"] - results.simulated["sigma_mean_mean"])
    return float((gap / results.measured["sigma_mean_sd"]).max())


def sum_sd_similar(results: Results) -> float:
    """Return the largest divided by the smallest standard deviation of the sum of a crop among exposures [1].

    The standard deviation of an exposure is the root mean square of those of its angles.
    """
    return _ratio_of_extremes(results.measured["sum_sd"])


def simulated_sums_above(results: Results) -> float:
    """Return by how much the simulated mean sum exceeds the measured one, averaged over conditions [%]."""
    return 100 * float((results.simulated["sum_mean"] / results.measured["sum_mean"] - 1).mean())


def variance_sigma_spike(results: Results) -> float:
    """Return the variance of σ_g at 1 µs divided by its minimum (Fig. 13, printed p1 and p2) [1]."""
    _, variance = variance_over_exposure(results)
    return float(variance[0] / variance.min())


def variance_sigma_rises(results: Results) -> float:
    """Return 1 if the variance of σ_g rises with exposure beyond its minimum, else 0 (Fig. 13, printed p1 and p2)."""
    _, variance = variance_over_exposure(results)
    return float(np.all(np.diff(variance[np.argmin(variance) :]) > 0))


def variance_peak_rises(results: Results) -> float:
    """Return 1 if the variance of µ_p,max rises with exposure, else 0 (Fig. 13, printed p1 and p2)."""
    variance, _ = variance_over_exposure(results)
    return float(np.all(np.diff(variance) > 0))


def _crops(results: Results, name: str) -> xr.DataArray:
    """Return crops [angle, exposure, repeat, y, x] in DN; `name` is "crops" (measured) or "simulated/crops"."""
    return results.open_file(name)["image"].sel(centring=CENTRING)


def _read_longest_exposure(results: Results, folder: str) -> list[tuple[np.ndarray, float, float, float]]:
    """Return (image [y, x] in DN, fitted centre x, y in it [px], fitted width [px]) of crops at the longest exposure.

    `folder` is "" for the measured and "simulated/" for the simulated crops.
    """
    crops = results.open_file(f"{folder}crops").sel(centring=CENTRING).isel(exposure=-1)
    fits = results.open_file(f"{folder}fits").sel(centring=CENTRING, fit="least_squares").isel(exposure=-1)
    images = crops["image"].transpose("angle", "repeat", "y", "x").values
    # Fitted centres are coordinates on the sensor, where `left` and `top` are the place of the crop.
    parameters = (fits["x_centre"] - crops["left"], fits["y_centre"] - crops["top"], fits["sigma_mean"])
    x0, y0, sigma_px = (values.transpose("angle", "repeat").values for values in parameters)
    cells = np.ndindex(images.shape[:2])
    return [(images[cell], float(x0[cell]), float(y0[cell]), float(sigma_px[cell])) for cell in cells]


def _edge_width(image: np.ndarray, x0: float, y0: float, sigma_px: float) -> float:
    """Return the radial distance [px] between `EDGE_LEVELS` of the plateau, in the mean profile around the centre.

    The level of the plateau is the mean of the profile up to the radius `PLATEAU_HALF_SIDE` · `sigma_px`. `x0`, `y0`
    is the centre [px] in `image` [y, x] in DN.
    """
    rows, columns = np.indices(image.shape)
    radius = np.hypot(columns - x0, rows - y0).astype(int).ravel()
    # Mean light at radii from 0, 1, 2 … px to the next one.
    profile = np.bincount(radius, image.ravel()) / np.maximum(np.bincount(radius), 1)
    plateau = profile[: max(1, round(PLATEAU_HALF_SIDE * sigma_px))].mean()
    # First radius at which the profile is below each level.
    inner, outer = (float(np.argmax(profile < level * plateau)) for level in EDGE_LEVELS)
    return outer - inner


def _count_angles_rising(values: xr.DataArray) -> float:
    """Return the number of angles at which values [angle, exposure] rise from each exposure to the next."""
    return float((values.diff("exposure") > 0).all("exposure").sum())


def _root_mean_square(sd: xr.DataArray) -> np.ndarray:
    """Return the root mean square [exposure] over angles of standard deviations [angle, exposure], in their unit."""
    return np.sqrt((sd**2).mean("angle").values)


def _ratio_of_extremes(sd: xr.DataArray) -> float:
    """Return the largest divided by the smallest `_root_mean_square` among exposures, of `sd` [angle, exposure]."""
    by_exposure = _root_mean_square(sd)
    return float(by_exposure.max() / by_exposure.min())
