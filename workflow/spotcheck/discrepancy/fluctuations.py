"""Fluctuations of brightness, width and centre from frame to frame and from site to site.

The frames of a site share the angle of the fibres, the declared conditions and the repeat. The gain of a fluctuation is
the drop of −2 ln L (REML) that its variance brings. Granular light scatters the fitted spots as well, so that a
fluctuation counts only if it exceeds this part (`SpotMeasurements.field_variance`).

A `LawSearch` has the fitted spots with their covariance (`measurements`) and the conditions of the frames (`design`).
Its `saturated_mean` has a free mean for each angle and exposure, so that it contains every law across frames.
`components` are the variance components that are needed beside it, and `variances` is their fit.
"""

from dataclasses import dataclass

import numpy as np

from spotcheck.discrepancy.criteria import FIELD_MULTIPLE, MIN_GAIN
from spotcheck.discrepancy.frames import CENTRE_X, CENTRE_Y, LOG_PEAK, LOG_SIGMA
from spotcheck.discrepancy.laws import LawSearch
from spotcheck.discrepancy.mixed_model import Interval, deviation_interval, fit_reml
from spotcheck.discrepancy.spot_components import LEAST_FREE, build_components

# A scatter of the centre must keep at least LEFT_SHARE of its gain, or MIN_GAIN if that is less, when the WORST_SHARE
# of the frames whose centres lie farthest off is left out. Otherwise a few outlying frames carry it.
WORST_SHARE, LEFT_SHARE = 0.1, 0.2


@dataclass(frozen=True)
class Fluctuation:
    """Scatter of one property of the spot."""

    deviation: Interval  # standard deviation: of ln peak or ln σ_g [1], or of the centre along an axis [px]
    gain: float  # drop of −2 ln L by it
    reasons: tuple[str, ...]  # reasons against it; empty if it is accepted


def measure_components(search: LawSearch) -> dict[str, Fluctuation]:
    """Return the scatter of each variance component of the spots, by its name in `build_components`.

    It is estimated beside the saturated mean of the search, so that no law adds to the scatter.
    """
    fluctuations = {}
    fit_of_kept = search.variances

    def assess(name: str, variance: float, estimate_variance: float, gain: float) -> Fluctuation:
        """Return the fluctuation of a component from the estimate of its variance and the variance of that estimate."""
        by_field = search.measurements.field_variance[LOG_SIGMA if name.endswith("width") else LOG_PEAK]
        return Fluctuation(deviation_interval(variance, estimate_variance), gain, _reasons(gain, variance, by_field))

    for k, name in enumerate(fit_of_kept.names):
        others = {key: matrix for key, matrix in search.components.items() if key != name}
        gain = search.deviance_of(others) - fit_of_kept.deviance
        fluctuations[name] = assess(name, fit_of_kept.variance[k], fit_of_kept.covariance[k, k], gain)
    possible = build_components(search.design, search.noise) if search.can_estimate else {}
    for name, matrix in possible.items():
        if name not in fluctuations:
            # The search left this component out. The upper end of its interval is a limit.
            components = {**search.components, name: matrix}
            fit = fit_reml(search.observations, search.saturated_mean, search.noise, components)
            k, gain = fit.names.index(name), fit_of_kept.deviance - fit.deviance
            fluctuations[name] = assess(name, fit.variance[k], fit.covariance[k, k], gain)
    return fluctuations


def measure_jitter(search: LawSearch) -> Fluctuation | None:
    """Return the scatter [px] of the fitted centres about the mean centre of their site, the same along x and y.

    Each exposure has a mean shift of its own, since an imperfect light shape moves the fitted centre with the exposure.
    None if no site has two frames, or if fewer than `LEAST_FREE` degrees of freedom are left beside these means.
    """
    spots, design = search.measurements.spots, search.design
    site_indicators = (design.site[:, None] == np.unique(design.site)[None]).astype(float)
    mean_of_axis = np.hstack([site_indicators, search.factors["exposure"][:, 1:]])  # of x or y [frame, column]
    frames = len(spots.x)
    if site_indicators.sum(axis=0).max() < 2 or frames - np.linalg.matrix_rank(mean_of_axis) < LEAST_FREE:
        return None
    zero = np.zeros_like(mean_of_axis)
    mean, centres = np.block([[mean_of_axis, zero], [zero, mean_of_axis]]), np.concatenate([spots.x, spots.y])
    covariance = search.measurements.covariance_of(CENTRE_X, CENTRE_Y)

    def fit_scatter(is_kept: np.ndarray) -> tuple[Interval, float]:
        """Return the standard deviation [px] and the gain of the scatter of some frames [frame]."""
        rows = np.concatenate([is_kept, is_kept])
        noise = covariance[np.ix_(rows, rows)]
        with_scatter = fit_reml(centres[rows], mean[rows], noise, {"centre": np.eye(int(rows.sum()))})
        without = fit_reml(centres[rows], mean[rows], noise, {})
        interval = deviation_interval(with_scatter.variance[0], with_scatter.covariance[0, 0])
        return interval, without.deviance - with_scatter.deviance

    interval, gain = fit_scatter(np.ones(frames, bool))
    squares = (centres - mean @ np.linalg.lstsq(mean, centres, rcond=None)[0]) ** 2
    square_distance = squares[:frames] + squares[frames:]
    _, remaining_gain = fit_scatter(square_distance <= np.quantile(square_distance, 1 - WORST_SHARE))
    reasons = _reasons(gain, interval.value**2, max(search.measurements.field_variance[CENTRE_X:]))
    if gain >= MIN_GAIN and remaining_gain < min(MIN_GAIN, LEFT_SHARE * gain):
        reasons = (*reasons, "carried by a tenth of the frames")
    return Fluctuation(interval, gain, reasons)


def _reasons(gain: float, variance: float, by_field: float) -> tuple[str, ...]:
    """Return the reasons against a scatter; `by_field` is the variance that granular light causes, as `variance`."""
    reasons = [] if gain >= MIN_GAIN else [f"gain {gain:.0f} below the least"]
    if variance < FIELD_MULTIPLE * by_field:
        reasons.append("no more than granular light brings")
    return tuple(reasons)
