"""The law of a spot's width and peak over exposure time: p1 and p2 by regression, and the peak from the maxima.

The baseline (`Baseline`) is the model of the light that the instrument file declares. A site is a place on the sensor
with frames at several exposure times; the maximum of a frame is its largest reading.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq

from spotcheck.fitting.spotfit import fit_spots
from spotcheck.model.baseline import Baseline
from spotcheck.sensor import ReadingDistribution, SensorModel

# A mean maximum above this fraction of full scale counts as clipped.
CLIPPED_FRACTION = 0.995
# The peak is sought within this factor of the mean maximum, to this accuracy [DN].
SEARCH_FACTOR, PEAK_TOLERANCE_DN = 8, 1e-3


class WidthLaw(NamedTuple):
    """Law of a spot over the exposure time t: σ_g = M σ_la/s_px + p1 ln(t / 1 s) + p2 (Eqs. 7 and 8)."""

    p1: float  # slope of the width over ln t [px]
    p2: float  # width at 1 s without the laser's own width [px]
    peak: float  # peak of the Gaussian at the longest exposure [DN]

    def spot_at(self, baseline: Baseline, exposure_s) -> tuple[Any, Any]:
        """Return the peak [DN] and σ_g [px] at exposure times [s], both in the shape of the times."""
        peak = self.peak * baseline.relative_peak(exposure_s, self.p1, self.p2)
        return peak, baseline.sigma(exposure_s, self.p1, self.p2)


def regress_widths(width_px: np.ndarray, exposure_s: np.ndarray, laser_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Return p1 and p2 [px] of each site: slope and intercept of σ̄ − M σ_la/s_px over ln(t / 1 s) (Section 3.3).

    Parameters
    ----------
    width_px : fitted widths σ̄ [..., exposure] in px, one row for each site; NaN without a fit.
    exposure_s : exposure times t [exposure] in s.
    laser_px : the laser's own width on the sensor, M σ_la/s_px [px].

    Returns
    -------
    p1, p2 : arrays [...]
        NaN for a site with fewer than two widths.
    """
    site_widths = width_px.reshape(-1, len(exposure_s))
    lines = np.full((len(site_widths), 2), np.nan)
    for k, widths in enumerate(site_widths):
        is_known = np.isfinite(widths)
        if is_known.sum() >= 2:
            lines[k] = np.polyfit(np.log(exposure_s[is_known]), widths[is_known] - laser_px, 1)
    shape = width_px.shape[:-1]
    return lines[:, 0].reshape(shape), lines[:, 1].reshape(shape)


def find_peak(
    baseline: Baseline, p1: float, p2: float, exposure_s, maximum, sensor: SensorModel | None, side: int
) -> float:
    """Return the peak [DN] at the longest exposure for which simulated and measured maxima agree on average.

    Only the longer exposures count, from the median on: at short ones faint sites reach no plateau, and the paper calls
    its shortest exposure insufficient. Exposures whose maximum is at full scale are left out.

    Parameters
    ----------
    baseline : model of the light.
    p1, p2 : parameters of the width law [px]; with NaN the result is NaN.
    exposure_s, maximum : exposure times [exposure] in s, and the mean of the maxima of their frames in DN; NaN without
        a frame.
    sensor : model of the sensor; if None, the maximum of the light without noise is compared.
    side : rows and columns of the simulated images [px].

    Returns
    -------
    float
        Peak of the Gaussian [DN]; NaN if no exposure is left, or if no peak within a factor of eight of the mean
        maximum explains the maxima.
    """
    exposure_s, maximum = np.asarray(exposure_s, float), np.asarray(maximum, float)
    ceiling = sensor.full_scale_dn if sensor else np.inf
    is_used = np.isfinite(maximum) & (maximum < CLIPPED_FRACTION * ceiling)
    if not is_used.any() or not np.isfinite([p1, p2]).all():
        return np.nan
    is_used &= exposure_s >= np.median(exposure_s[is_used])

    def excess(peak: float) -> float:
        """Return the sum over exposures of simulated less measured maximum [DN]; it grows with the peak [DN]."""
        total = 0.0
        for t, measured in zip(exposure_s[is_used], maximum[is_used], strict=True):
            light = render_spot(baseline, WidthLaw(p1, p2, peak), t, side)
            distribution = ReadingDistribution(sensor, exposure_s=t) if sensor else None
            total += (distribution.expected_maximum(light) if distribution else float(light.max())) - measured
        return total

    guess = float(np.average(maximum[is_used]))
    low, high = guess / SEARCH_FACTOR, guess * SEARCH_FACTOR
    if not excess(low) < 0 < excess(high):
        return np.nan
    return float(brentq(excess, low, high, xtol=PEAK_TOLERANCE_DN))


def render_spot(baseline: Baseline, law: WidthLaw, exposure_s: float, side: int) -> np.ndarray:
    """Return the light [side, side] in DN of a centred spot of the law at one exposure time [s]."""
    pixel = np.arange(side, dtype=float)
    peak, sigma = law.spot_at(baseline, exposure_s)
    return baseline.declared_light(pixel[None, :], pixel[:, None], peak, side // 2, side // 2, sigma)


def fit_simulated_widths(baseline: Baseline, law: WidthLaw, exposure_s, side: int) -> np.ndarray:
    """Return the widths σ̄ [exposure] in px that the spot fit finds in noise-free images of the model.

    The images are [side, side], one for each of `exposure_s` [exposure] in s. A Gaussian fitted to a top hat is some
    4 % wider than the Gaussian under it, so the fit does not return the simulated width.
    """
    light = (render_spot(baseline, law, t, side) for t in exposure_s)
    return fit_spots(light, weighting="equal", integrated=baseline.pixel_integration).sigma_mean
