"""Numbers of the paper's simulated side."""

import numpy as np

from spotcheck.paper.results import Results


def simulated_contrast_smallest(results: Results) -> float:
    """Smallest C_s over exposures [1]."""
    return float(results.simulated["speckle_contrast_mean"].min())


def simulated_contrast_largest(results: Results) -> float:
    """Largest C_s over exposures [1]."""
    return float(results.simulated["speckle_contrast_mean"].max())


def _plateau_gap(results: Results) -> np.ndarray:
    """|Measured − simulated| mean maximum [angle, exposure] in DN."""
    gap = results.measured["maximum_mean"] - results.simulated["maximum_mean"]
    return np.abs(gap.transpose("angle", "exposure").values)


def plateau_gap_worst(results: Results) -> float:
    """Largest difference of mean maxima [DN]."""
    return float(_plateau_gap(results).max())


def plateau_gap_long(results: Results) -> float:
    """Largest difference of mean maxima at the two longer exposures [DN]."""
    return float(_plateau_gap(results)[:, 1:].max())


def simulated_widths_closer(results: Results) -> float:
    """1 if the widths of the two longer exposures are closer than those of the two shorter."""
    width = results.simulated["sigma_mean_mean"].values
    return float(width[2] - width[1] < width[1] - width[0])


def _bound(results: Results, parameter: str) -> np.ndarray:
    """Bounds of Fig. 13 as the paper has them (DN), between the shortest and the longest exposure, and over photons."""
    bounds = results.file("bounds").sel(law="dn")
    exposure = results.metrics["exposure"].values
    inside = bounds[f"var_{parameter}_over_exposure"].sel(fine_exposure=slice(exposure.min(), exposure.max()))
    both = np.concatenate([inside.values, bounds[f"var_{parameter}_over_photons"].values])
    return both * float(bounds["pixel_pitch"]) ** 2 if parameter == "sigma" else both


def variance_peak_smallest(results: Results) -> float:
    """Smallest bound on Var(µ_p,max) [1]."""
    return float(_bound(results, "peak").min())


def variance_peak_largest(results: Results) -> float:
    """Largest bound on Var(µ_p,max) [1]."""
    return float(_bound(results, "peak").max())


def variance_sigma_smallest(results: Results) -> float:
    """Smallest bound on Var(σ_g) in the image plane [m²]."""
    return float(_bound(results, "sigma").min())


def variance_sigma_largest(results: Results) -> float:
    """Largest bound on Var(σ_g) in the image plane [m²]."""
    return float(_bound(results, "sigma").max())
