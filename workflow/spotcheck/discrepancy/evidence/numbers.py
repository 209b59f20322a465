"""The frames' own numbers against the baseline's law: width and brightness of the exposure, one place for each site."""

from collections.abc import Sequence

import numpy as np
from scipy import linalg

from spotcheck.discrepancy.evidence.parts import Part, upper_tail
from spotcheck.discrepancy.nuisance.numbers import Numbered
from spotcheck.model.baseline import Baseline

STEPS = 20
# Relative step of slopes by the law's parameters.
NUDGE = 1e-6
NAMES = {"brightness": (0,), "width": (1,), "centre": (2, 3)}


def expected(baseline: Baseline, exposure_s: np.ndarray, law: np.ndarray) -> np.ndarray:
    """Logs of peak and width [frame, 2] by the law (p1, p2 [px], log of the peak at the longest exposure)."""
    p1, p2, log_peak = law
    relative = np.maximum(baseline.relative_peak(exposure_s, p1, p2), 1e-300)
    return np.stack([log_peak + np.log(relative), np.log(np.maximum(baseline.sigma(exposure_s, p1, p2), 1e-3))], 1)


def numbers_parts(numbered: Numbered, exposure_s: np.ndarray, site: np.ndarray) -> list[Part]:
    """Whether brightness, width and centre scatter more about their law than the frames' readings let them. Without a
    law of the light (`free`) each frame has a brightness and a width of its own, so that only centres are asked."""
    model, information = numbered.model, numbered.information
    own, baseline = model.numbers, model.baseline
    frames = len(own.x)
    value = np.stack([own.log_peak, own.log_width, own.x, own.y], 1)
    places = np.unique(site, return_inverse=True)[1].reshape(-1)
    known = np.array([np.linalg.cond(matrix) < 1e12 for matrix in information])
    if not known.any():
        return []
    information = np.where(known[:, None, None], information, 0.0)
    lawful = baseline.photon_budget != "free"
    law = _start(baseline, exposure_s, value) if lawful else np.zeros(0)
    free = _free(baseline, exposure_s) if lawful else np.zeros(0, int)
    slopes = np.zeros((frames, 4, free.size + 2 * (places.max() + 1) + (0 if lawful else 2 * frames)))
    first = free.size
    for axis in (0, 1):
        slopes[np.arange(frames), 2 + axis, first + 2 * places + axis] = 1
    if not lawful:
        beside = first + 2 * (places.max() + 1)
        for axis in (0, 1):
            slopes[np.arange(frames), axis, beside + 2 * np.arange(frames) + axis] = 1
    centre = np.zeros((places.max() + 1, 2))
    residual = np.zeros_like(value)
    for _ in range(STEPS if lawful else 2):
        mean = np.concatenate([value[:, :2] if not lawful else expected(baseline, exposure_s, law), centre[places]], 1)
        residual = value - mean
        for j, parameter in enumerate(free):
            step = np.zeros(3)
            step[parameter] = NUDGE * max(abs(law[parameter]), 1.0)
            slopes[:, :2, j] = (expected(baseline, exposure_s, law + step) - mean[:, :2]) / step[parameter]
        normal = np.einsum("fip,fij,fjq->pq", slopes, information, slopes)
        score = np.einsum("fip,fij,fj->p", slopes, information, residual)
        change = linalg.lstsq(normal, score)[0]
        law = law.copy()
        law[free] += change[: free.size]
        centre += change[first : first + centre.size].reshape(-1, 2)
        if float(change @ normal @ change) < 1e-8:
            break
    covariance = _left(information, known, slopes, normal)
    return _parts(residual, covariance, information, known, NAMES if lawful else {"centre": NAMES["centre"]})


def _start(baseline: Baseline, exposure_s: np.ndarray, value: np.ndarray) -> np.ndarray:
    width = np.exp(value[:, 1]) - baseline.laser_px
    p1, p2 = np.polyfit(np.log(exposure_s), width, 1) if np.ptp(exposure_s) > 0 else (0.0, float(np.median(width)))
    law = np.array([p1, p2, 0.0])
    law[2] = np.median(value[:, 0] - expected(baseline, exposure_s, law)[:, 0])
    return law


def _free(baseline: Baseline, exposure_s: np.ndarray) -> np.ndarray:
    """Which of p1, p2 and the peak are told: with one exposure p1 is 0."""
    return np.array([0, 1, 2]) if np.ptp(exposure_s) > 0 else np.array([1, 2])


def _left(information: np.ndarray, known: np.ndarray, slopes: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Covariance [frame × number, frame × number] of what the law leaves of the numbers."""
    frames = len(information)
    jacobian = slopes.reshape(4 * frames, -1)
    covariance = -jacobian @ np.linalg.pinv(normal, rcond=1e-12, hermitian=True) @ jacobian.T
    for k in np.flatnonzero(known):
        at = slice(4 * k, 4 * k + 4)
        covariance[at, at] += np.linalg.inv(information[k])
    return covariance


def _parts(residual, covariance, information, known, names) -> list[Part]:
    """Σ of squares of each quantity in its own errors, a quadratic form of normal numbers."""
    out = []
    for name, axes in names.items():
        at = np.array([4 * k + axis for k in np.flatnonzero(known) for axis in axes])
        alone = np.array([np.linalg.inv(information[k])[axis, axis] for k in np.flatnonzero(known) for axis in axes])
        z = residual.ravel()[at] / np.sqrt(alone)
        form = covariance[np.ix_(at, at)] / np.sqrt(np.outer(alone, alone))
        first, second = float(np.trace(form)), 2 * float((form**2).sum())
        if first < 0.5:
            continue
        third = 8 * float((form @ form * form).sum())
        statistic = float((z @ z - first) / np.sqrt(second))
        worst = int(at[np.argmax(np.abs(z))]) // 4
        out.append(Part(f"numbers: {name}", statistic, upper_tail(statistic, third / second**1.5), f"frame {worst}"))
    return out


def exposures_of(frames: Sequence) -> np.ndarray:
    """Exposure [s] of every frame."""
    return np.array([float(np.ravel(own.view.exposure_s)[0]) for own in frames])
