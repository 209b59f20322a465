"""Fluctuations of brightness, width and centre from frame to frame and from site to site."""

from dataclasses import dataclass

import numpy as np

from spotcheck.discrepancy.criteria import FIELD_MULTIPLE, MIN_GAIN
from spotcheck.discrepancy.laws import LEAST_FREE, LawSearch
from spotcheck.discrepancy.mixed_model import Interval, deviation_interval, fit_reml

# Part of the frames on which alone a scatter of the centre must not rest, and of its gain that must stay without them.
WORST_SHARE, LEFT_SHARE = 0.1, 0.2


@dataclass(frozen=True)
class Fluctuation:
    """Scatter of one property of the spot."""

    deviation: Interval  # standard deviation: of ln peak or ln σ [1], or of the centre along an axis [px]
    gain: float  # drop of −2 ln L by it
    reasons: tuple[str, ...]  # against it; empty: it is there


def measure_components(search: LawSearch) -> dict[str, Fluctuation]:
    """Return the scatter of each variance component beside a saturated mean, by its name."""
    found = {}
    full = search.variances

    def assess(name: str, variance: float, variance_of_it: float, gain: float) -> Fluctuation:
        of_brightness, of_width, *_ = search.numbers.field_variance
        by_field = of_width if name.endswith("width") else of_brightness
        return Fluctuation(deviation_interval(variance, variance_of_it), gain, _reasons(gain, variance, by_field))

    for k, name in enumerate(full.names):
        others = {key: matrix for key, matrix in search.components.items() if key != name}
        gain = search.deviance_of(others) - full.deviance
        found[name] = assess(name, full.variance[k], full.covariance[k, k], gain)
    for name, matrix in search.all_components().items() if search.can_estimate else ():
        if name not in found:
            # A component that was left out: its upper end is a limit.
            beside = {**search.components, name: matrix}
            fit = fit_reml(search.observations, search.saturated_mean, search.noise, beside)
            k, gain = fit.names.index(name), full.deviance - fit.deviance
            found[name] = assess(name, fit.variance[k], fit.covariance[k, k], gain)
    return found


def measure_jitter(search: LawSearch) -> Fluctuation | None:
    """Return the scatter of the centre about that of its site, or None if no site has two frames.

    The mean of each exposure is free, since an imperfect shape moves it.
    """
    spots, design = search.numbers.spots, search.design
    site = (design.site[:, None] == np.unique(design.site)[None]).astype(float)
    of_axis = np.hstack([site, search.levels[:, 1:]])
    frames = len(spots.x)
    if site.sum(axis=0).max() < 2 or frames - np.linalg.matrix_rank(of_axis) < LEAST_FREE:
        return None
    zero = np.zeros_like(of_axis)
    mean, centres = np.block([[of_axis, zero], [zero, of_axis]]), np.concatenate([spots.x, spots.y])
    covariance = search.numbers.covariance_of(2, 3)

    def fit(kept: np.ndarray) -> tuple[Interval, float]:
        both = np.concatenate([kept, kept])
        noise = covariance[np.ix_(both, both)]
        with_scatter = fit_reml(centres[both], mean[both], noise, {"centre": np.eye(int(both.sum()))})
        without = fit_reml(centres[both], mean[both], noise, {})
        interval = deviation_interval(with_scatter.variance[0], with_scatter.covariance[0, 0])
        return interval, without.deviance - with_scatter.deviance

    interval, gain = fit(np.ones(frames, bool))
    square = (centres - mean @ np.linalg.lstsq(mean, centres, rcond=None)[0]) ** 2
    distance = square[:frames] + square[frames:]
    _, left = fit(distance <= np.quantile(distance, 1 - WORST_SHARE))
    reasons = _reasons(gain, interval.value**2, max(search.numbers.field_variance[2:]))
    if gain >= MIN_GAIN and left < min(MIN_GAIN, LEFT_SHARE * gain):
        reasons = (*reasons, "carried by a tenth of the frames")
    return Fluctuation(interval, gain, reasons)


def _reasons(gain: float, variance: float, by_field: float) -> tuple[str, ...]:
    reasons = [] if gain >= MIN_GAIN else [f"gain {gain:.0f} below the least"]
    if variance < FIELD_MULTIPLE * by_field:
        reasons.append("no more than granular light brings")
    return tuple(reasons)
