"""The bound of Fig. 13 as the paper seems to have computed it: the information of the brightest pixel alone.

The mean of the brightest pixel is ν = a µ_p,max/σ_g² (Eq. 28) with a constant a. µ_p,max, the number of photons,
follows p_b² (Eq. 13), where p_b = p1 ln(t/1 s) + p2 is the beam propagation at an exposure t (Eq. 8). The width σ_g of
the spot is p_b plus the laser's own width (Eq. 7). The Fisher information of a Poisson variable about its mean is 1/ν
(Eq. 36), so that the diagonal of Eq. 37 gives

    Var(µ_p,max) = σ_g² µ_p,max / a ∝ p_b² σ_g²,    Var(σ_g) = σ_g⁴ / (4 a µ_p,max) ∝ σ_g⁴ / p_b².

With p1 and p2 in px, the ratio of the largest to the smallest value between 1 µs and 1 s agrees with the print for both
variances. Their absolute scale depends on a, which does not follow from the print. They are no bound for both
parameters together: one pixel cannot determine two.
"""

import numpy as np

from spotcheck.dataset.instrument import Instrument
from spotcheck.model import propagation
from spotcheck.model.baseline import build_baseline
from spotcheck.paper.results import Results

# p1 and p2 as printed [px] (Section 6.1).
PRINTED_P1_PX, PRINTED_P2_PX = 2.48, 34.55
# Printed extremes of both variances: smallest and largest (Section 6.2.7) [1 and m²].
PRINTED_PEAK_VARIANCE, PRINTED_SIGMA_VARIANCE = (3e7, 2.65e14), (2e-18, 1.25e-16)
# Range of exposure times [s] over which the printed extremes are reproduced, and the number of points.
SHORTEST_S, LONGEST_S, POINTS = 1e-6, 1.0, 601


def relative_variances(propagation_px: np.ndarray, sigma_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the variances of µ_p,max and σ_g [exposure], each divided by an unknown constant: p_b² σ_g² and σ_g⁴/p_b².

    Parameters
    ----------
    propagation_px : beam propagation p_b [exposure] in px (Eq. 8); positive.
    sigma_px : width σ_g of the spot [exposure] in px (Eq. 7).
    """
    return (propagation_px * sigma_px) ** 2, sigma_px**4 / propagation_px**2


def variance_over_exposure(results: Results) -> tuple[np.ndarray, np.ndarray]:
    """Return both `relative_variances` [exposure] with the printed p1 and p2, at exposures from 1 µs to 1 s."""
    _, peak_variance, sigma_variance = printed_curves(results.dataset.instrument)
    return peak_variance, sigma_variance


def printed_curves(instrument: Instrument) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return exposures [s], ascending from 1 µs to 1 s, and both `relative_variances` [exposure] as printed.

    p1 and p2 are the printed ones; `instrument` gives the laser's own width on the sensor.
    """
    exposure_s = np.geomspace(SHORTEST_S, LONGEST_S, POINTS)
    propagation_px = propagation.beam_propagation(exposure_s, PRINTED_P1_PX, PRINTED_P2_PX)
    laser_px = build_baseline(instrument, exposure_s).laser_px
    sigma_px = propagation.spot_sigma(propagation_px, laser_px)
    return (exposure_s, *relative_variances(propagation_px, sigma_px))


def variance_peak_ratio(results: Results) -> float:
    """Return the largest divided by the smallest variance of µ_p,max from 1 µs to 1 s [1]."""
    variance, _ = variance_over_exposure(results)
    return float(variance.max() / variance.min())


def variance_sigma_ratio(results: Results) -> float:
    """Return the largest divided by the smallest variance of σ_g from 1 µs to 1 s [1]."""
    _, variance = variance_over_exposure(results)
    return float(variance.max() / variance.min())
