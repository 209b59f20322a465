"""Measure frames as the paper does: crop at the maximum, contrast, fitted Gaussian. Used by the settings search only.

It repeats what the analysis library does, on purpose and in its own way: the search must not look through the eyes
of the code that is later judged by its result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

CROP_PX = 240


@dataclass(frozen=True)
class Fit:
    """A Gaussian on an offset: amplitude and offset [DN], centre [px], the two widths [px]."""

    amplitude: float
    offset: float
    x_px: float
    y_px: float
    sigma_long_px: float
    sigma_short_px: float

    @property
    def sigma_px(self) -> float:
        """Width averaged over the directions [px]."""
        return 0.5 * (self.sigma_long_px + self.sigma_short_px)


def crop_at_maximum(frame: np.ndarray) -> np.ndarray:
    """240 x 240 px with the maximum at index 120; of several equal maxima the left-most, then the top-most."""
    rows, columns = np.nonzero(frame == frame.max())
    first = np.lexsort((rows, columns))[0]
    top, left = rows[first] - CROP_PX // 2, columns[first] - CROP_PX // 2
    if top < 0 or left < 0 or top + CROP_PX > frame.shape[0] or left + CROP_PX > frame.shape[1]:
        raise ValueError("the maximum lies too near the border for a crop")
    return frame[top : top + CROP_PX, left : left + CROP_PX].astype(float)


def contrast(crop: np.ndarray) -> float:
    """C_s: standard deviation over mean of the whole crop [1]."""
    return float(crop.std() / crop.mean())


def peak_share(crop: np.ndarray) -> float:
    """Pixels within 2 % of the maximum as a part of those above half of it [1]."""
    top = crop.max()
    return float(np.count_nonzero(crop > 0.98 * top) / np.count_nonzero(crop > 0.5 * top))


def psnr_db(crop: np.ndarray, reference: np.ndarray) -> float:
    """PSNR [dB] with the 16-bit data range that the paper's numbers need."""
    return float(10.0 * math.log10(65535.0**2 / np.mean((crop - reference) ** 2)))


def fit_gaussian(crop: np.ndarray, iterations: int = 60) -> Fit:
    """Unweighted least squares of A exp(−½ (a dx² + 2 b dx dy + c dy²)) + offset, all six and A free.

    Levenberg-Marquardt with the analytic Jacobian, in the elements of the inverse covariance: smooth for round spots,
    where a rotation angle is not.
    """
    y, x = np.mgrid[: crop.shape[0], : crop.shape[1]].astype(float)
    x, y, data = x.ravel(), y.ravel(), crop.ravel()
    p = _start(x, y, data)
    model, jacobian = _model(p, x, y)
    cost, damping = float(np.sum((data - model) ** 2)), 1e-3
    normal, slope = jacobian @ jacobian.T, jacobian @ (data - model)
    for _ in range(iterations):
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slope)
        trial = p + step
        if trial[3] <= 0.0 or trial[3] * trial[5] <= trial[4] ** 2:
            damping *= 10.0
            continue
        model, jacobian = _model(trial, x, y)
        new_cost = float(np.sum((data - model) ** 2))
        if new_cost > cost:
            damping *= 10.0
            continue
        gain, p, cost, damping = cost - new_cost, trial, new_cost, damping * 0.1
        if gain <= 1e-10 * cost:
            break
        normal, slope = jacobian @ jacobian.T, jacobian @ (data - model)
    short, long = np.linalg.eigvalsh(np.linalg.inv([[p[3], p[4]], [p[4], p[5]]]))
    return Fit(p[0], p[6], p[1], p[2], math.sqrt(long), math.sqrt(short))


def _start(x: np.ndarray, y: np.ndarray, data: np.ndarray) -> np.ndarray:
    offset = float(np.median(data))
    bright = data - offset > 0.3 * (data.max() - offset)
    weight = bright * (data - offset)
    x0, y0 = np.average(x, weights=weight), np.average(y, weights=weight)
    # The area above 30 % of a Gaussian's peak is 2 π σ² ln(1/0.3).
    inverse = 2.0 * math.pi * math.log(1.0 / 0.3) / max(int(np.count_nonzero(bright)), 4)
    return np.array([data.max() - offset, x0, y0, inverse, 0.0, inverse, offset])


def _model(p: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    amplitude, x0, y0, a, b, c, offset = p
    dx, dy = x - x0, y - y0
    jacobian = np.empty((7, x.size))
    shape = np.exp(-0.5 * (a * dx * dx + 2.0 * b * dx * dy + c * dy * dy))
    signal = amplitude * shape
    jacobian[0] = shape
    jacobian[1] = signal * (a * dx + b * dy)
    jacobian[2] = signal * (b * dx + c * dy)
    jacobian[3] = -0.5 * signal * dx * dx
    jacobian[4] = -signal * dx * dy
    jacobian[5] = -0.5 * signal * dy * dy
    jacobian[6] = 1.0
    return signal + offset, jacobian
