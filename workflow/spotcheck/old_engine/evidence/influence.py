"""The numbers of the frames with their covariance, and how much each cell of the spot has to say in them.

Where the model is right, cells of the spot differ in what they say by noise alone; where the light or the sensor is
otherwise than modelled, they differ by more, and what follows from their sum is no better known than they agree.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine.evidence.pixels import AZIMUTHS, cells_of
from spotcheck.old_engine.nuisance import normal
from spotcheck.old_engine.nuisance.fit import (
    NUMBERS,
    Fitted,
    coefficients_of,
    contrasts,
    count_of,
    rows_of,
    splines_of,
)
from spotcheck.old_engine.nuisance.parameters import changes_of, nudged_of
from spotcheck.old_engine.observe.pixels import Expectation, Frame, told

# Cells: the azimuths of all sectors, and the radii [σ] within which a third and two thirds of a Gaussian's light lie.
RADII = (0.90, 1.48)
CELLS = AZIMUTHS * (len(RADII) + 1)
# Variance of what nobody knows of the numbers of one light against those of another, logs and centres in σ.
UNKNOWN = 1.0


class FrameNumbers(NamedTuple):
    """`values` [number, frame]: log of the peak [DN], log of σ_g [px], centre x, y [px]; their covariance [frame ×
    number, frame × number], a frame's numbers side by side, without what all frames have in common (the shape's); and
    the part of each number that each cell brings [frame × number, cell], without columns where it was not asked for."""

    values: np.ndarray
    covariance: np.ndarray
    influence: np.ndarray


def numbers_of(fitted: Fitted, influence: np.ndarray | None = None, more: np.ndarray | None = None) -> FrameNumbers:
    """The frames' numbers after a fit. `influence` as `influence_of` gives it; `more`: covariance [frame × number,
    frame × number], centres in σ, of what the weights do not know, such as noise that the pixels of a row share."""
    values = np.stack(fitted.model.numbers)
    frames = values.shape[1]
    basis, model = contrasts(fitted.model), fitted.model
    covariance = basis @ fitted.covariance[: basis.shape[1], : basis.shape[1]] @ basis.T
    if count_of(model) > 1 and model.lights is not None:
        # Of lights that each have a shape of their own nobody knows which is brighter or wider.
        alike = model.lights.which[:, None] == model.lights.which
        covariance = covariance + UNKNOWN * np.kron(alike, np.eye(NUMBERS))
    if more is not None:
        covariance = covariance + basis @ (basis.T @ more @ basis) @ basis.T
    width = np.exp(values[1])
    unit = np.stack([np.ones(frames), np.ones(frames), width, width], 1).ravel()
    cells = np.zeros((len(unit), 0)) if influence is None else influence * unit[:, None]
    return FrameNumbers(values, covariance * np.outer(unit, unit), cells)


def as_cells_agree(numbers: FrameNumbers, condition: np.ndarray) -> FrameNumbers:
    """Numbers with errors as large as cells of the spot disagree: fields that neighbouring pixels share, which weights
    take for noise of each, are told by no other means. What all frames of one condition [frame] have in common is no
    noise."""
    cells, left = numbers.influence.shape[1], numbers.influence.shape[1] - NUMBERS
    _, group, count = np.unique(condition, return_inverse=True, return_counts=True)
    alike = count[group] > 1
    if left <= 0 or not alike.any():
        return numbers
    own = numbers.influence.reshape(len(condition), NUMBERS, cells)
    common = np.stack([own[group == k].mean(axis=0) for k in range(len(count))])[group]
    freedom = np.where(alike, 1 - 1 / count[group], 1.0)[:, None]
    scatter = (cells**2 / left * np.var(own - common, axis=2) / freedom)[alike].sum(axis=0)
    known = np.diag(numbers.covariance).reshape(-1, NUMBERS)[alike].sum(axis=0)
    root = np.tile(np.sqrt(np.maximum(scatter / known, 1.0)), len(condition))
    return numbers._replace(covariance=numbers.covariance * np.outer(root, root))


def influence_of(frames: Sequence[Frame], fitted: Fitted) -> np.ndarray:
    """Steps of the frames' numbers [frame × number, cell], centres in σ, that each cell of the spot asks for: the
    solution of the normal equations for the scores of its pixels, those of all frames together."""
    model, few = fitted.model, NUMBERS * len(frames)
    step, side = splines_of(model)
    ready = Expectation(frames, model)
    nudged = nudged_of(frames, ready, fitted.free)
    shape, others = np.zeros((CELLS, coefficients_of(model).size, 1)), np.zeros((few + len(nudged), CELLS))
    for k, frame in enumerate(frames):
        seen = ready.of(frame, k)
        tells = told(frame, seen)
        cell = cells_of(seen.u, seen.v, RADII)
        parts = [*(ready.by_numbers(frame, k, seen) * tells.light)]
        parts += [mean * tells.mean + variance * tells.variance
                  for mean, variance in changes_of(frame, k, seen, nudged)]  # fmt: skip
        rows = [*range(NUMBERS * k, NUMBERS * (k + 1)), *range(few, few + len(nudged))]
        for row, part in zip(rows, parts, strict=True):
            others[row] += np.bincount(cell.ravel(), part.ravel(), CELLS)
        light = np.exp(model.numbers.log_peak[k]) * seen.factor * tells.light
        for c in range(CELLS):
            own = np.where(cell == c, light, 0.0)[None]
            for u, v, weight in seen.copies:
                normal.project(u, v, step, side, weight * own, shape[c, rows_of(model, k)])
    basis = contrasts(model, len(nudged))
    left = basis.T @ others - fitted.schur.absorbed.T @ shape[:, :, 0].T
    return (basis @ normal.solve(fitted.schur.left, left))[:few] if left.size else np.zeros((few, CELLS))
