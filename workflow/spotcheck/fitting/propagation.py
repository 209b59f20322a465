"""p1 and p2: regression of fitted widths on ln t (Section 3.3), and the peak that makes the maxima agree."""

import numpy as np
from scipy.optimize import brentq

from spotcheck.fitting.spotfit import fit_spots
from spotcheck.model.baseline import Baseline
from spotcheck.sensor import ReadingDistribution, SensorModel


def regress(width_px: np.ndarray, exposure_s: np.ndarray, laser_px: float) -> tuple[np.ndarray, np.ndarray]:
    """p1, p2 [px] of each site by a straight line of σ̄ − M σ_la/s_px on ln(t / 1 s), as the paper's polyfit (Section
    3.3).

    `width_px` [..., exposure]; sites with fewer than two widths give NaN.
    """
    flat = width_px.reshape(-1, len(exposure_s))
    out = np.full((len(flat), 2), np.nan)
    for k, widths in enumerate(flat):
        known = np.isfinite(widths)
        if known.sum() >= 2:
            out[k] = np.polyfit(np.log(exposure_s[known]), widths[known] - laser_px, 1)
    shape = width_px.shape[:-1]
    return out[:, 0].reshape(shape), out[:, 1].reshape(shape)


def peak_from_maxima(
    baseline: Baseline, p1: float, p2: float, exposure_s, maximum, sensor: SensorModel | None, side: int
) -> float:
    """Peak [DN] of the Gaussian at the longest exposure for which simulated and measured maxima agree on average.

    `maximum` [exposure] in DN are means over frames. The longer half of the exposures decides (those from the median
    on): at short ones faint sites reach no plateau, and the paper calls its shortest insufficient. Exposures that
    read full scale say nothing and are left out. NaN when none is left.
    """
    exposure_s, maximum = np.asarray(exposure_s, float), np.asarray(maximum, float)
    ceiling = sensor.full_scale_dn if sensor else np.inf
    use = np.isfinite(maximum) & (maximum < 0.995 * ceiling)
    if not use.any() or not np.isfinite([p1, p2]).all():
        return np.nan
    use &= exposure_s >= np.median(exposure_s[use])

    def excess(peak: float) -> float:
        total = 0.0
        for t, measured in zip(exposure_s[use], maximum[use], strict=True):
            light = law_light(baseline, p1, p2, peak, t, side)
            distribution = ReadingDistribution(sensor, exposure_s=t) if sensor else None
            total += (distribution.expected_maximum(light) if distribution else float(light.max())) - measured
        return total

    guess = float(np.average(maximum[use]))
    low, high = guess / 8, guess * 8
    if not excess(low) < 0 < excess(high):
        return np.nan
    return float(brentq(excess, low, high, xtol=1e-3))


def law_light(baseline: Baseline, p1: float, p2: float, peak: float, exposure_s: float, side: int) -> np.ndarray:
    """Return the light [DN] of a spot of the baseline's law in the middle of side × side pixels."""
    pixel = np.arange(side, dtype=float)
    peak, sigma = peak * baseline.relative_peak(exposure_s, p1, p2), baseline.sigma(exposure_s, p1, p2)
    return baseline.declared_light(pixel[None, :], pixel[:, None], peak, side // 2, side // 2, sigma)


def simulate_and_fit(baseline: Baseline, p1: float, p2: float, peak: float, exposure_s, side: int) -> np.ndarray:
    """σ̄ [px] that the spot fit finds in the model's own mean image at each exposure.

    A Gaussian fitted to a top hat is some 4 % wider than the Gaussian under it: simulate → fit misses its own input.
    """
    light = (law_light(baseline, p1, p2, peak, t, side) for t in exposure_s)
    return fit_spots(light, weighting="equal", integrated=baseline.pixel_integration).sigma_mean
