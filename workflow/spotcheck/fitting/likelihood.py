"""Maximum likelihood of the baseline on all frames at once: p1, p2, the peak, and one centre a site.

Every frame is one pass of the spot fit (`scoring`), at the peak and the width that the law gives it; score and
information of the law's parameters follow by the chain rule. So the sensor's law of a reading is the same as there,
with clipped pixels by the probability of being clipped. Frames are read one at a time.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.fitting.reading_kernel import law_of
from spotcheck.fitting.scoring import LIKELIHOOD, one_pass
from spotcheck.model.baseline import Baseline, jacobian
from spotcheck.sensor import SensorModel

MAX_ITERATIONS = 60
# Distance to the root in standard errors, squared, before the last step, which shrinks it much further.
DECREMENT = 1e-2


class SiteFrame(NamedTuple):
    """One frame for the joint fit: which site, exposure [s], position [px] of the crop on the sensor, and its
    pixels."""

    site: int
    exposure_s: float
    left: int
    top: int
    pixels: Callable[[], np.ndarray]


class JointFit(NamedTuple):
    """p1 [px], p2 [px], peak [DN] with standard errors, the centres [site, (x, y)] on the sensor, and whether it
    converged."""

    value: np.ndarray
    stderr: np.ndarray
    centres: np.ndarray
    converged: bool


class Sums(NamedTuple):
    """Score and Fisher information of the shared parameters, between them and the centres, and of the centres [site];
    χ² per pixel."""

    score: np.ndarray
    site_score: np.ndarray
    information: np.ndarray
    between: np.ndarray
    site_information: np.ndarray
    misfit: float


def fit_baseline(
    frames: Sequence[SiteFrame],
    baseline: Baseline,
    sensor: SensorModel,
    start: np.ndarray,
    centres: np.ndarray,
) -> JointFit:
    """Fisher scoring from `start` = (p1, p2, peak) and `centres` [site, 2].

    Standard errors hold under the model; where it misses an effect they are too small.
    """
    shared, local = np.array(start, float), np.array(centres, float)
    nothing = JointFit(shared, np.full(3, np.nan), local, False)
    shrink, before, promised = 1.0, None, 0.0
    for _ in range(MAX_ITERATIONS):
        sums = _evaluate(frames, baseline, sensor, shared, local)
        schur, weight = _reduced(sums)
        if not np.isfinite(schur).all() or np.linalg.matrix_rank(schur, hermitian=True) < 3:
            return nothing
        step = np.linalg.solve(schur, sums.score - np.einsum("sij,sj->i", weight, sums.site_score))
        rest = sums.site_score - np.einsum("sij,i->sj", sums.between, step)
        steps = step, np.linalg.solve(sums.site_information, rest[..., None])[..., 0]
        decrement = _along(sums, steps)
        if before is not None:
            # Where the model is far off full steps overshoot; the slope along the last step says by how much.
            slope = _along(sums, before)
            shrink = float(np.clip(shrink * promised / (promised - slope), 0.05, 1.0)) if slope < promised else 1.0
        done = decrement < DECREMENT * max(sums.misfit, 1.0)
        length = 1.0 if done else shrink
        while not _possible(baseline, frames, shared + length * steps[0]):
            length /= 2
            if length < 1e-6:
                return nothing
        shared, local = shared + length * steps[0], local + length * steps[1]
        if done:
            return JointFit(shared, np.sqrt(np.diag(np.linalg.inv(schur))), local, True)
        shrink, before, promised = length, steps, decrement
    return nothing


def _along(sums: Sums, steps: tuple[np.ndarray, np.ndarray]) -> float:
    return float(sums.score @ steps[0] + np.sum(sums.site_score * steps[1]))


def _possible(baseline: Baseline, frames: Sequence[SiteFrame], shared: np.ndarray) -> bool:
    """Whether every frame has light and a width."""
    times = np.array([f.exposure_s for f in frames])
    return bool(shared[2] > 0 and np.min(baseline.sigma(times, *shared[:2])) > 0.3)


def _evaluate(frames, baseline: Baseline, sensor: SensorModel, shared: np.ndarray, local: np.ndarray) -> Sums:
    count, law = len(local), law_of(sensor)
    score, site_score = np.zeros(3), np.zeros((count, 2))
    information, between, site_information = np.zeros((3, 3)), np.zeros((count, 3, 2)), np.zeros((count, 2, 2))
    chi2 = pixels = 0.0

    for frame in frames:

        def spot(p1, p2, peak, t=frame.exposure_s):
            """Peak [DN] and 1/σ_g² [1/px²] of this frame, as pixels sample it."""
            own = baseline.sampled(peak * baseline.relative_peak(t, p1, p2), baseline.sigma(t, p1, p2))
            return np.array([own[0], own[1] ** -2])

        amplitude, curvature = spot(*shared)
        x, y = local[frame.site] - (frame.left, frame.top)
        dark = sensor.black_level_dn + sensor.gain_dn_per_e * sensor.dark_current_e_per_s * frame.exposure_s
        theta = np.array([amplitude, x, y, curvature, 0.0, curvature, dark])
        image = np.ascontiguousarray(sensor.linearize(frame.pixels()), dtype=float)
        own, matrix, own_chi2, used = one_pass(image, theta, LIKELIHOOD, law, baseline.top_hat)
        slopes = jacobian(spot, shared).T
        # From (amplitude, x0, y0, a, b, c, offset) to (p1, p2, peak) and (x0, y0): the law moves a and c alike.
        chart = np.zeros((7, 5))
        chart[0, :3], chart[3, :3], chart[5, :3] = slopes[0], slopes[1], slopes[1]
        chart[1, 3] = chart[2, 4] = 1.0
        own, matrix = chart.T @ own, chart.T @ matrix @ chart
        score += own[:3]
        information += matrix[:3, :3]
        site_score[frame.site] += own[3:]
        between[frame.site] += matrix[:3, 3:]
        site_information[frame.site] += matrix[3:, 3:]
        chi2, pixels = chi2 + own_chi2, pixels + used
    return Sums(score, site_score, information, between, site_information, chi2 / max(pixels, 1))


def _reduced(sums: Sums) -> tuple[np.ndarray, np.ndarray]:
    """Information of the shared parameters with the centres eliminated (Schur complement), and what that needed."""
    weight = np.einsum("sij,sjk->sik", sums.between, np.linalg.inv(sums.site_information))
    return sums.information - np.einsum("sij,skj->ik", weight, sums.between), weight
