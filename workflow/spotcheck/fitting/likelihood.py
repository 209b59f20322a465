"""Maximum likelihood of the baseline on all frames at once: p1, p2, the peak, and one centre for each site.

Every frame is one pass of the spot fit (`spot_score`) at the peak and the width of the law. Score and Fisher
information of the law's parameters follow by the chain rule. The distribution of a reading is therefore that of the
spot fit, with clipped pixels by the probability of being clipped. Frames are read one at a time.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from spotcheck.fitting.reading_kernel import build_reading_law
from spotcheck.fitting.spot_score import LIKELIHOOD, score_spot
from spotcheck.fitting.width_law import WidthLaw
from spotcheck.model.baseline import Baseline, jacobian
from spotcheck.sensor import SensorModel

MAX_ITERATIONS = 60
# Squared distance to the root in standard errors below which the last step is taken, which reduces it much further.
CONVERGED_DECREMENT = 1e-2
# Smallest width [px] of a frame that a step may lead to, and the smallest fraction of a step that is tried.
NARROWEST_PX, SHORTEST_STEP = 0.3, 1e-6


@dataclass(frozen=True)
class SiteFrame:
    """One frame of the joint fit."""

    site: int  # index of its site
    exposure_s: float  # exposure time [s]
    left: int  # first column of the crop on the sensor [px]
    top: int  # first row of the crop on the sensor [px]
    read_pixels: Callable[[], np.ndarray]  # returns the crop [row, column] in DN


class JointFit(NamedTuple):
    """Result of the joint fit."""

    value: np.ndarray  # p1 [px], p2 [px], peak [DN]
    stderr: np.ndarray  # their standard errors; NaN without convergence
    centres: np.ndarray  # centres on the sensor [site, (x, y)] in px
    has_converged: bool  # whether the root of the score was reached


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """Sums over frames for the law's parameters (p1, p2, peak) and the centres of the sites."""

    score: np.ndarray  # score of the law's parameters [3]
    site_score: np.ndarray  # score of the centres [site, 2]
    information: np.ndarray  # Fisher information of the law's parameters [3, 3]
    cross_information: np.ndarray  # between the law's parameters and the centres [site, 3, 2]
    site_information: np.ndarray  # of the centres [site, 2, 2]
    misfit: float  # χ² per pixel

    def eliminate_centres(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the Schur complement, the information [3, 3] without the centres, and its weights [site, 3, 2]."""
        weight = np.einsum("sij,sjk->sik", self.cross_information, np.linalg.inv(self.site_information))
        return self.information - np.einsum("sij,skj->ik", weight, self.cross_information), weight

    def compute_slope(self, steps: tuple[np.ndarray, np.ndarray]) -> float:
        """Return the derivative of the log-likelihood along steps of the law and of the centres."""
        return float(self.score @ steps[0] + np.sum(self.site_score * steps[1]))


def fit_baseline(
    frames: Sequence[SiteFrame], baseline: Baseline, sensor: SensorModel, start: np.ndarray, centres: np.ndarray
) -> JointFit:
    """Return p1, p2, the peak and the centres of maximum likelihood by Fisher scoring.

    Standard errors hold under the model; if it misses an effect they are too small.

    Parameters
    ----------
    frames : frames of all sites.
    baseline, sensor : model of the spot and of the sensor.
    start : p1 [px], p2 [px] and peak [DN] to start from.
    centres : centres on the sensor [site, (x, y)] in px to start from.
    """
    law, sites = np.array(start, float), np.array(centres, float)
    failure = JointFit(law, np.full(3, np.nan), sites, False)
    shrink, previous_steps, expected_gain = 1.0, None, 0.0
    for _ in range(MAX_ITERATIONS):
        sums = _sum_frames(frames, baseline, sensor, law, sites)
        schur, weight = sums.eliminate_centres()
        if not np.isfinite(schur).all() or np.linalg.matrix_rank(schur, hermitian=True) < 3:
            return failure
        step = np.linalg.solve(schur, sums.score - np.einsum("sij,sj->i", weight, sums.site_score))
        rest = sums.site_score - np.einsum("sij,i->sj", sums.cross_information, step)
        steps = step, np.linalg.solve(sums.site_information, rest[..., None])[..., 0]
        decrement = sums.compute_slope(steps)
        if previous_steps is not None:
            # Far from the root full steps overshoot; the slope that is left along the last step measures by how much.
            slope = sums.compute_slope(previous_steps)
            is_reduced = slope < expected_gain
            shrink = float(np.clip(shrink * expected_gain / (expected_gain - slope), 0.05, 1.0)) if is_reduced else 1.0
        is_converged = decrement < CONVERGED_DECREMENT * max(sums.misfit, 1.0)
        length = 1.0 if is_converged else shrink
        while not _is_valid(baseline, frames, law + length * steps[0]):
            length /= 2
            if length < SHORTEST_STEP:
                return failure
        law, sites = law + length * steps[0], sites + length * steps[1]
        if is_converged:
            return JointFit(law, np.sqrt(np.diag(np.linalg.inv(schur))), sites, True)
        shrink, previous_steps, expected_gain = length, steps, decrement
    return failure


def _is_valid(baseline: Baseline, frames: Sequence[SiteFrame], law: np.ndarray) -> bool:
    """Return whether (p1, p2, peak) give every frame light and a width."""
    times = np.array([frame.exposure_s for frame in frames])
    return bool(law[2] > 0 and np.min(baseline.sigma(times, *law[:2])) > NARROWEST_PX)


def _sum_frames(
    frames: Sequence[SiteFrame], baseline: Baseline, sensor: SensorModel, law: np.ndarray, sites: np.ndarray
) -> _NormalEquations:
    """Return the normal equations at (p1, p2, peak) and the centres [site, 2]."""
    count, reading_law = len(sites), build_reading_law(sensor)
    score, site_score = np.zeros(3), np.zeros((count, 2))
    information, cross_information, site_information = (
        np.zeros(shape) for shape in ((3, 3), (count, 3, 2), (count, 2, 2))
    )
    chi2 = pixels = 0.0
    for frame in frames:

        def spot(p1, p2, peak, t=frame.exposure_s):
            """Peak [DN] and 1/σ_g² [1/px²] of this frame, as pixels sample it."""
            amplitude, sigma = baseline.effective_gaussian(*WidthLaw(p1, p2, peak).spot_at(baseline, t))
            return np.array([amplitude, sigma**-2])

        amplitude, curvature = spot(*law)
        x, y = sites[frame.site] - (frame.left, frame.top)
        dark = sensor.black_level_dn + sensor.gain_dn_per_e * sensor.dark_current_e_per_s * frame.exposure_s
        theta = np.array([amplitude, x, y, curvature, 0.0, curvature, dark])
        image = np.ascontiguousarray(sensor.linearize(frame.read_pixels()), dtype=float)
        theta_score, matrix, frame_chi2, used = score_spot(image, theta, LIKELIHOOD, reading_law, baseline.top_hat)
        # ∂(amplitude, x0, y0, a, b, c, offset)/∂(p1, p2, peak, x0, y0); the law changes a and c alike.
        slopes = np.zeros((7, 5))
        amplitude_slopes, curvature_slopes = jacobian(spot, law).T
        slopes[0, :3], slopes[3, :3], slopes[5, :3] = amplitude_slopes, curvature_slopes, curvature_slopes
        slopes[1, 3] = slopes[2, 4] = 1.0
        frame_score, matrix = slopes.T @ theta_score, slopes.T @ matrix @ slopes
        score += frame_score[:3]
        information += matrix[:3, :3]
        site_score[frame.site] += frame_score[3:]
        cross_information[frame.site] += matrix[:3, 3:]
        site_information[frame.site] += matrix[3:, 3:]
        chi2, pixels = chi2 + frame_chi2, pixels + used
    misfit = chi2 / max(pixels, 1)
    return _NormalEquations(score, site_score, information, cross_information, site_information, misfit)
