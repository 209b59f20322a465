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
    shrink, previous_step, previous_decrement = 1.0, None, 0.0
    for _ in range(MAX_ITERATIONS):
        score, information, misfit = _sum_frames(frames, baseline, sensor, law, centres)
        cross_information, centre_information = information[:, :3, 3:], information[:, 3:, 3:]
        # Schur complement: the information on the law with unknown centres.
        weight = cross_information @ np.linalg.inv(centre_information)
        schur = (information[:, :3, :3] - weight @ cross_information.transpose(0, 2, 1)).sum(axis=0)
        if not np.isfinite(schur).all() or np.linalg.matrix_rank(schur, hermitian=True) < 3:
            return failure
        law_step = np.linalg.solve(schur, score[:, :3].sum(axis=0) - np.einsum("sij,sj->i", weight, score[:, 3:]))
        # The score of the centres after the step of the law.
        remaining_score = score[:, 3:] - np.einsum("sij,i->sj", cross_information, law_step)
        centre_step = np.linalg.solve(centre_information, remaining_score[..., None])[..., 0]
        # Step of p1, p2, peak, x0, y0 [site, 5]; the law is common to all sites.
        step = np.hstack([np.tile(law_step, (len(centres), 1)), centre_step])
        # Twice the gain in ln L that a full step promises: the squared distance to the root in standard errors.
        decrement = np.sum(score * step)
        if previous_step is not None:
            # Far from the root full steps overshoot; the slope that is left along the last step measures by how much.
            slope = np.sum(score * previous_step)
            shrink = shrink * previous_decrement / (previous_decrement - slope) if slope < previous_decrement else 1.0
            shrink = min(max(shrink, LEAST_SHRINK), 1.0)
        is_converged = decrement < CONVERGED_DECREMENT * max(misfit, 1.0)
        length = 1.0 if is_converged else shrink
        while not _is_valid(baseline, frames, law + length * law_step):
            length /= 2
            if length < SHORTEST_STEP:
                return failure
        law, centres = law + length * law_step, centres + length * centre_step
        if is_converged:
            return JointFit(law, np.sqrt(np.diag(np.linalg.inv(schur))), centres, True)
        shrink, previous_step, previous_decrement = length, step, decrement
    return failure


def _is_valid(baseline: Baseline, frames: Sequence[SiteFrame], law: np.ndarray) -> bool:
    """Return whether a law (p1, p2, peak) gives every frame a peak above 0 and a width above `NARROWEST_PX`."""
    times = np.array([frame.exposure_s for frame in frames])
    return bool(law[2] > 0 and np.min(baseline.sigma(times, *law[:2])) > NARROWEST_PX)


def _sum_frames(
    frames: Sequence[SiteFrame], baseline: Baseline, sensor: SensorModel, law: np.ndarray, centres: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return score and Fisher information of the frames of each site, and χ² per pixel of all frames.

    They are taken at a law (p1, p2, peak) and at centres on the sensor [site, (x, y)] in px. The score [site, 5] and
    the information [site, 5, 5] are those of p1, p2, peak, x0 and y0.
    """
    reading_law = build_reading_law(sensor)
    score, information = np.zeros((len(centres), 5)), np.zeros((len(centres), 5, 5))
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
        score[frame.site] += slopes.T @ theta_score
        information[frame.site] += slopes.T @ matrix @ slopes
        chi2, pixels = chi2 + frame_chi2, pixels + used
    return score, information, chi2 / max(pixels, 1)
