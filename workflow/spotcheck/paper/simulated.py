"""The paper's numbers of its simulation."""

import numpy as np

from spotcheck.paper.results import Results


def simulated_contrast_smallest(results: Results) -> float:
    """Return the smallest C_s over exposures [1]."""
    return float(results.simulated["speckle_contrast_mean"].min())


def simulated_contrast_largest(results: Results) -> float:
    """Return the largest C_s over exposures [1]."""
    return float(results.simulated["speckle_contrast_mean"].max())


def _plateau_gap(results: Results) -> np.ndarray:
    """Return |measured − simulated| mean maximum [angle, exposure] in DN."""
    gap = results.measured["maximum_mean"] - results.simulated["maximum_mean"]
    return np.abs(gap.transpose("angle", "exposure").values)


def plateau_gap_worst(results: Results) -> float:
    """Return the largest difference of mean maxima [DN]."""
    return float(_plateau_gap(results).max())


def plateau_gap_long(results: Results) -> float:
    """Return the largest difference of mean maxima at the two longer exposures [DN]."""
    return float(_plateau_gap(results)[:, 1:].max())


def simulated_widths_closer(results: Results) -> float:
    """Return 1 if the widths of the two longer exposures are closer than those of the two shorter."""
    width = results.simulated["sigma_mean_mean"].values
    return float(width[2] - width[1] < width[1] - width[0])


def _bound(results: Results, parameter: str) -> np.ndarray:
    """Return the bounds of Fig. 13 by the paper's law (DN), over exposures between the extremes and over photons."""
    bounds = results.open_file("bounds").sel(law="dn")
    exposure = results.metrics["exposure"].values
    over_exposure = bounds[f"var_{parameter}_over_exposure"].sel(fine_exposure=slice(exposure.min(), exposure.max()))
    variance = np.concatenate([over_exposure.values, bounds[f"var_{parameter}_over_photons"].values])
    return variance * float(bounds["pixel_pitch"]) ** 2 if parameter == "sigma" else variance


def variance_peak_smallest(results: Results) -> float:
    """Return the smallest bound on Var(µ_p,max) [1]."""
    return float(_bound(results, "peak").min())


def variance_peak_largest(results: Results) -> float:
    """Return the largest bound on Var(µ_p,max) [1]."""
    return float(_bound(results, "peak").max())


def variance_sigma_smallest(results: Results) -> float:
    """Return the smallest bound on Var(σ_g) in the image plane [m²]."""
    return float(_bound(results, "sigma").min())


def variance_sigma_largest(results: Results) -> float:
    """Return the largest bound on Var(σ_g) in the image plane [m²]."""
    return float(_bound(results, "sigma").max())
