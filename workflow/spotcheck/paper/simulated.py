"""The paper's numbers of its simulation.

`check_numbers` calls each public function by its name, which is the `id` of an entry in published.yaml. Variables
NAME_mean are means over repeats: [angle, exposure] in `results.measured`, and also averaged over angles [exposure] in
`results.simulated`. Exposures ascend. C_s is the speckle contrast.
"""

import numpy as np

from spotcheck.paper.results import Results


def simulated_contrast_smallest(results: Results) -> float:
    """Return the smallest mean C_s of simulated crops among the exposures [1]."""
    return float(results.simulated["speckle_contrast_mean"].min())


def simulated_contrast_largest(results: Results) -> float:
    """Return the largest mean C_s of simulated crops among the exposures [1]."""
    return float(results.simulated["speckle_contrast_mean"].max())


def _plateau_gap(results: Results) -> np.ndarray:
    """Return the absolute difference of measured and simulated mean maximum of a crop [angle, exposure] in DN."""
    gap = results.measured["maximum_mean"] - results.simulated["maximum_mean"]
    return np.abs(gap.transpose("angle", "exposure").values)


def plateau_gap_worst(results: Results) -> float:
    """Return the largest absolute difference of measured and simulated mean maximum [DN]."""
    return float(_plateau_gap(results).max())


def plateau_gap_long(results: Results) -> float:
    """Return the largest absolute difference of measured and simulated mean maximum at the longer exposures [DN]."""
    return float(_plateau_gap(results)[:, 1:].max())


def simulated_widths_closer(results: Results) -> float:
    """Return 1 if the mean width grows less from the second to the third exposure than from the first to the second.

    The result is 0 otherwise.
    """
    first_step, second_step = np.diff(results.simulated["sigma_mean_mean"].values)[:2]
    return float(second_step < first_step)


def _variance_bounds(results: Results, parameter: str) -> np.ndarray:
    """Return the lower bounds on the variance of a parameter of the spot at all points of Fig. 13 [point].

    `parameter` is "peak" for µ_p,max, whose bounds are numbers [1], or "sigma" for σ_g, whose bounds are in m². The
    first points are a curve over the exposure, within the range of the dataset. The others are a curve over the number
    of photons. bounds.nc has the bounds by several distributions of readings, its dimension `law`. With "dn", that of
    the paper, a mean in DN is the mean of a Poisson distribution (Eq. 31).
    """
    bounds = results.open_file("bounds").sel(law="dn")
    exposure = results.metrics["exposure"].values
    over_exposure = bounds[f"var_{parameter}_over_exposure"].sel(fine_exposure=slice(exposure.min(), exposure.max()))
    variance = np.concatenate([over_exposure.values, bounds[f"var_{parameter}_over_photons"].values])
    # The variance of the width is in px², the pitch in m.
    return variance * float(bounds["pixel_pitch"]) ** 2 if parameter == "sigma" else variance


def variance_peak_smallest(results: Results) -> float:
    """Return the smallest lower bound on Var(µ_p,max), the variance of the peak [1]."""
    return float(_variance_bounds(results, "peak").min())


def variance_peak_largest(results: Results) -> float:
    """Return the largest lower bound on Var(µ_p,max), the variance of the peak [1]."""
    return float(_variance_bounds(results, "peak").max())


def variance_sigma_smallest(results: Results) -> float:
    """Return the smallest lower bound on Var(σ_g), the variance of the width in the image plane [m²]."""
    return float(_variance_bounds(results, "sigma").min())


def variance_sigma_largest(results: Results) -> float:
    """Return the largest lower bound on Var(σ_g), the variance of the width in the image plane [m²]."""
    return float(_variance_bounds(results, "sigma").max())
