"""Maximum likelihood of the baseline on all frames at once: p1, p2, the peak, and one centre for each site.

The baseline is the model of the light that the instrument file declares. Its law gives peak and width of a spot over
the exposure time (`WidthLaw`), with the parameters p1 [px], p2 [px] and peak [DN]. A site is a place on the sensor with
frames at several exposure times.

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

# Steps of Fisher scoring.
MAX_ITERATIONS = 60
# Squared distance to the root of the score, in standard errors, below which the last step is taken. That step reduces
# the distance much further.
CONVERGED_DECREMENT = 1e-2
# Smallest width [px] of a frame that a step may lead to, and the smallest fraction of a step that is tried.
NARROWEST_PX, SHORTEST_STEP = 0.3, 1e-6
# Shortest step after an overshooting one, as a fraction of the full step.
LEAST_SHRINK = 0.05


@dataclass(frozen=True)
class SiteFrame:
    """One frame of the joint fit."""

    site: int  # index of its site in `JointFit.centres`
    exposure_s: float  # exposure time [s]
    left: int  # first column of the crop on the sensor [px]
    top: int  # first row of the crop on the sensor [px]
    read_pixels: Callable[[], np.ndarray]  # returns the crop [row, column] in DN


class JointFit(NamedTuple):
    """Result of the joint fit."""

    value: np.ndarray  # p1 [px], p2 [px], peak [DN]
    stderr: np.ndarray  # standard errors of `value`; NaN without convergence
    centres: np.ndarray  # centres on the sensor [site, (x, y)] in px
    has_converged: bool  # whether the root of the score was reached


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """Score and Fisher information of the law's parameters (p1, p2, peak) and of the sites' centres by all frames."""

    score: np.ndarray  # score of the law's parameters [3]
    centre_score: np.ndarray  # score of the centres [site, (x, y)]
    information: np.ndarray  # Fisher information of the law's parameters [3, 3]
    cross_information: np.ndarray  # information between the law's parameters and the centres [site, 3, 2]
    centre_information: np.ndarray  # information of the centres [site, 2, 2]
    misfit: float  # χ² per pixel

    def eliminate_centres(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the Schur complement S [3, 3] and the weights W [site, 3, 2] of the centres.

        With the blocks I, C, D of law, cross and centre information, W = C D⁻¹ and S = I − W Cᵀ, summed over sites. S
        is the information on the law with unknown centres.
        """
        weight = np.einsum("sij,sjk->sik", self.cross_information, np.linalg.inv(self.centre_information))
        return self.information - np.einsum("sij,skj->ik", weight, self.cross_information), weight

    def compute_slope(self, steps: tuple[np.ndarray, np.ndarray]) -> float:
        """Return the derivative of the log-likelihood along steps of the law [3] and of the centres [site, 2]."""
        return float(self.score @ steps[0] + np.sum(self.centre_score * steps[1]))


def fit_baseline(
    frames: Sequence[SiteFrame], baseline: Baseline, sensor: SensorModel, start: np.ndarray, centres: np.ndarray
) -> JointFit:
    """Fit p1, p2, the peak and the centres by maximum likelihood, with Fisher scoring.

    Standard errors hold under the model; if it misses an effect they are too small.

    Parameters
    ----------
    frames : frames of all sites.
    baseline, sensor : model of the spot and of the sensor.
    start : p1 [px], p2 [px] and peak [DN] to start from.
    centres : centres on the sensor [site, (x, y)] in px to start from.

    Returns
    -------
    JointFit
        If the fit did not converge or the frames do not determine all parameters: the start, with NaN errors.
    """
    law, centres = np.array(start, float), np.array(centres, float)
    failure = JointFit(law, np.full(3, np.nan), centres, False)
    shrink, previous_steps, previous_decrement = 1.0, None, 0.0
    for _ in range(MAX_ITERATIONS):
        equations = _sum_frames(frames, baseline, sensor, law, centres)
        schur, weight = equations.eliminate_centres()
        if not np.isfinite(schur).all() or np.linalg.matrix_rank(schur, hermitian=True) < 3:
            return failure
        law_step = np.linalg.solve(schur, equations.score - np.einsum("sij,sj->i", weight, equations.centre_score))
        # The score of the centres after the step of the law.
        remaining_score = equations.centre_score - np.einsum("sij,i->sj", equations.cross_information, law_step)
        steps = law_step, np.linalg.solve(equations.centre_information, remaining_score[..., None])[..., 0]
        # Twice the gain in ln L that a full step promises: the squared distance to the root in standard errors.
        decrement = equations.compute_slope(steps)
        if previous_steps is not None:
            # Far from the root full steps overshoot; the slope that is left along the last step measures by how much.
            slope = equations.compute_slope(previous_steps)
            shrink = shrink * previous_decrement / (previous_decrement - slope) if slope < previous_decrement else 1.0
            shrink = min(max(shrink, LEAST_SHRINK), 1.0)
        is_converged = decrement < CONVERGED_DECREMENT * max(equations.misfit, 1.0)
        length = 1.0 if is_converged else shrink
        while not _is_valid(baseline, frames, law + length * law_step):
            length /= 2
            if length < SHORTEST_STEP:
                return failure
        law, centres = law + length * law_step, centres + length * steps[1]
        if is_converged:
            return JointFit(law, np.sqrt(np.diag(np.linalg.inv(schur))), centres, True)
        shrink, previous_steps, previous_decrement = length, steps, decrement
    return failure


def _is_valid(baseline: Baseline, frames: Sequence[SiteFrame], law: np.ndarray) -> bool:
    """Return whether a law (p1, p2, peak) gives every frame a peak above 0 and a width above `NARROWEST_PX`."""
    times = np.array([frame.exposure_s for frame in frames])
    return bool(law[2] > 0 and np.min(baseline.sigma(times, *law[:2])) > NARROWEST_PX)


def _sum_frames(
    frames: Sequence[SiteFrame], baseline: Baseline, sensor: SensorModel, law: np.ndarray, centres: np.ndarray
) -> _NormalEquations:
    """Return the normal equations at a law (p1, p2, peak) and centres on the sensor [site, (x, y)] in px."""
    sites, reading_law = len(centres), build_reading_law(sensor)
    score, information = np.zeros(3), np.zeros((3, 3))
    centre_score, centre_information = np.zeros((sites, 2)), np.zeros((sites, 2, 2))
    cross_information = np.zeros((sites, 3, 2))
    chi2 = pixels = 0.0
    for frame in frames:

        def spot_in_pixels(p1, p2, peak, t=frame.exposure_s):
            """Return peak [DN] and 1/σ_g² [1/px²] of the spot of this frame, as pixels sample it."""
            amplitude, sigma = baseline.effective_gaussian(*WidthLaw(p1, p2, peak).spot_at(baseline, t))
            return np.array([amplitude, sigma**-2])

        amplitude, inverse_variance = spot_in_pixels(*law)
        x, y = centres[frame.site] - (frame.left, frame.top)
        dark = sensor.black_level_dn + sensor.gain_dn_per_e * sensor.dark_current_e_per_s * frame.exposure_s
        theta = np.array([amplitude, x, y, inverse_variance, 0.0, inverse_variance, dark])
        image = np.ascontiguousarray(sensor.linearize(frame.read_pixels()), dtype=float)
        theta_score, matrix, frame_chi2, used = score_spot(image, theta, LIKELIHOOD, reading_law, baseline.top_hat)
        # ∂(amplitude, x0, y0, a, b, c, offset)/∂(p1, p2, peak, x0, y0); the law changes a and c alike.
        slopes = np.zeros((7, 5))
        slopes[0, :3], slopes[3, :3] = jacobian(spot_in_pixels, law).T
        slopes[5, :3] = slopes[3, :3]
        slopes[1, 3] = slopes[2, 4] = 1.0
        frame_score, matrix = slopes.T @ theta_score, slopes.T @ matrix @ slopes
        score += frame_score[:3]
        information += matrix[:3, :3]
        centre_score[frame.site] += frame_score[3:]
        cross_information[frame.site] += matrix[:3, 3:]
        centre_information[frame.site] += matrix[3:, 3:]
        chi2, pixels = chi2 + frame_chi2, pixels + used
    misfit = chi2 / max(pixels, 1)
    return _NormalEquations(score, centre_score, information, cross_information, centre_information, misfit)
