"""Maximum likelihood of the baseline on all frames at once: p1, p2, the peak, and one centre a site.

A reading in electrons plus the variance of read noise and rounding is taken as Poisson (the usual sCMOS
approximation), with the mean of the full sensor model, clips included. Frames are read one at a time.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.model.baseline import Baseline, jacobian
from spotcheck.model.sensor import ROUNDING_VARIANCE, SensorModel, reading

MAX_ITERATIONS = 40
# Stop when no parameter moves by more than this part of its standard error.
STEP_TOLERANCE = 0.02


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


def fit_baseline(
    frames: Sequence[SiteFrame],
    baseline: Baseline,
    sensor: SensorModel,
    start: np.ndarray,
    centres: np.ndarray,
) -> JointFit:
    """Fisher scoring with damping from `start` = (p1, p2, peak) and `centres` [site, 2].

    Standard errors hold under the model; where it misses an effect they are too small.
    """
    shared, local = np.array(start, float), np.array(centres, float)
    damping, converged = 1e-3, False
    cost, information, score = _evaluate(frames, baseline, sensor, shared, local)
    for _ in range(MAX_ITERATIONS):
        step_shared, step_local = _step(information, score, damping)
        trial = shared + step_shared, local + step_local
        lowest = baseline.sigma(min(f.exposure_s for f in frames), *trial[0][:2])
        outcome = _evaluate(frames, baseline, sensor, *trial) if lowest > 0.3 and trial[0][2] > 0 else None
        # The undamped step decides: a damped one is small anywhere.
        small = np.all(np.abs(_step(information, score, 0.0)[0]) <= STEP_TOLERANCE * _errors(information))
        if outcome is not None and outcome[0] <= cost:
            (shared, local), (cost, information, score) = trial, outcome
            damping = max(damping / 10, 1e-9)
            if small:
                converged = True
                break
        elif small:
            converged = True
            break
        else:
            damping *= 10
            if damping > 1e9:
                break
    return JointFit(shared, _errors(information), local, converged)


def _evaluate(frames, baseline: Baseline, sensor: SensorModel, shared, local):
    """Negative log likelihood, and the blocks of Fisher information and score: shared, between, local."""
    gain, count = sensor.gain_dn_per_e, len(local)
    floor = sensor.read_noise_e**2 + ROUNDING_VARIANCE / gain**2
    cost = 0.0
    s_shared, s_local = np.zeros(3), np.zeros((count, 2))
    i_shared, i_between, i_local = np.zeros((3, 3)), np.zeros((count, 3, 2)), np.zeros((count, 2, 2))
    for frame in frames:
        data = frame.pixels()
        side = data.shape[0]
        x, y = (
            frame.left + np.arange(side, dtype=float)[None, :],
            frame.top + np.arange(side, dtype=float)[:, None],
        )

        def light(p1, p2, peak, x0, y0, x=x, y=y, exposure=frame.exposure_s):
            return baseline.light(x, y, exposure, p1, p2, peak, x0, y0)

        at = (*shared, *local[frame.site])
        moments = reading(light(*at), frame.exposure_s, sensor)
        valid = np.isfinite(data)
        expected = np.maximum((moments.mean - sensor.black_level_dn) / gain + floor, 1e-6)[valid]
        observed = np.maximum((data[valid] - sensor.black_level_dn) / gain + floor, 0.0)
        cost += float(np.sum(expected - observed * np.log(expected)))
        slopes = jacobian(light, at)[:, valid] * (moments.response[valid] / gain)
        weighted = slopes / expected
        score, information = weighted @ (observed - expected), weighted @ slopes.T
        s_shared += score[:3]
        s_local[frame.site] += score[3:]
        i_shared += information[:3, :3]
        i_between[frame.site] += information[:3, 3:]
        i_local[frame.site] += information[3:, 3:]
    return cost, (i_shared, i_between, i_local), (s_shared, s_local)


def _reduced(information, damping: float):
    """Information of the shared parameters with the centres eliminated (Schur complement), and what that needed."""
    i_shared, i_between, i_local = information
    inflate = 1 + damping
    local = i_local + damping * np.einsum("sij,ij->sij", i_local, np.eye(2)) + 1e-12 * np.eye(2)
    weight = np.einsum("sij,sjk->sik", i_between, np.linalg.inv(local))
    schur = i_shared + (inflate - 1) * np.diag(np.diag(i_shared)) - np.einsum("sij,skj->ik", weight, i_between)
    return schur, weight, local


def _step(information, score, damping: float):
    schur, weight, local = _reduced(information, damping)
    s_shared, s_local = score
    shared = np.linalg.solve(schur, s_shared - np.einsum("sij,sj->i", weight, s_local))
    rest = s_local - np.einsum("sij,i->sj", information[1], shared)
    return shared, np.linalg.solve(local, rest[..., None])[..., 0]


def _errors(information) -> np.ndarray:
    return np.sqrt(np.maximum(np.diag(np.linalg.pinv(_reduced(information, 0.0)[0])), 0.0))
