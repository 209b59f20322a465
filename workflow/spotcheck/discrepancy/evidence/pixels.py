"""What the pixels say of an effect, to first order, beside the light's shape and the frames' numbers.

An effect at its start changes mean and variance of every pixel by (m, w). What shape and numbers can make up for is
taken off: m̃ = m − s ℓ, w̃ = w − s' ℓ, with the light ℓ that fits best and the slopes s, s' of mean and variance by the
light. The score of the rest and its information, for readings of mean µ and variance V:

    U = Σ m̃ r / V + Σ w̃ (r² / V − 1) / 2V,    I = Σ m̃² / V + Σ w̃² / 2V²,    r = y − µ
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.nuisance import normal
from spotcheck.discrepancy.nuisance.fit import NUMBERS, Fitted, changes_of, contrasts, nudged_of
from spotcheck.discrepancy.observe.pixels import Expectation, Frame, told
from spotcheck.model.effect import Present
from spotcheck.model.light_shape import LightShape

# Cells in which an effect has to speak alike: azimuths, and radii [σ] that part them.
AZIMUTHS, RADIUS = 8, 1.2


class Score(NamedTuple):
    """Score and information of an effect in units of its start, by cell [frame, cell]."""

    score: np.ndarray
    information: np.ndarray

    @property
    def z(self) -> float:
        """The score in its standard errors."""
        return float(self.score.sum() / np.sqrt(max(self.information.sum(), 1e-300)))

    @property
    def size(self) -> float:
        """The effect's size in units of its start, to first order."""
        return float(self.score.sum() / max(self.information.sum(), 1e-300))


def scores_of(frames: Sequence[Frame], fitted: Fitted, trials: Sequence[Present]) -> list[Score]:
    """The score of each trial beside what is nuisance."""
    model = fitted.model
    plain = Expectation(frames, model)
    ready = [Expectation(frames, model._replace(present=(*model.present, own))) for own in trials]
    nudged = nudged_of(frames, model, fitted.free)
    shape, numbers = _made_up(frames, fitted, plain, ready, nudged)
    few = NUMBERS * len(frames)
    out = [Score(np.zeros((len(frames), 2 * AZIMUTHS)), np.zeros((len(frames), 2 * AZIMUTHS))) for _ in trials]
    learned = model.baseline.learned
    assert learned is not None
    side = len(learned.coefficients)
    for k, frame in enumerate(frames):
        seen = plain.of(frame, k)
        tells = told(frame, seen)
        slopes = plain.by_numbers(frame, k, seen)
        peak = np.exp(model.numbers.log_peak[k])
        cell = _cells(seen.u, seen.v).ravel()
        own = slice(NUMBERS * k, NUMBERS * (k + 1))
        changes = changes_of(frame, k, seen, nudged)
        for c, other in enumerate(ready):
            then = other.of(frame, k)
            known = numbers[few:, c]
            surface = LightShape(learned.step, shape[:, c].reshape(side, side))
            made_up = peak * surface(seen.u, seen.v).ravel() + numbers[own, c] @ slopes
            mean = (then.mean - seen.mean).ravel() - tells.slope * made_up
            variance = (then.variance - seen.variance).ravel() - tells.growth * made_up
            for size, change in zip(known, changes, strict=True):
                mean, variance = mean - size * change[0], variance - size * change[1]
            left = mean, variance
            out[c].score[k] = np.bincount(cell, tells.score(*left), 2 * AZIMUTHS)
            out[c].information[k] = np.bincount(cell, tells.information(left, left), 2 * AZIMUTHS)
    return out


def _cells(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Cell of each pixel."""
    turn = np.floor((np.arctan2(v, u) / (2 * np.pi) + 0.5) * AZIMUTHS).astype(int) % AZIMUTHS
    return turn + AZIMUTHS * (np.hypot(u, v) > RADIUS)


def _made_up(frames: Sequence[Frame], fitted: Fitted, plain: Expectation, ready: Sequence[Expectation], nudged):
    """Coefficients [coefficient, trial] of the shape and steps [number, trial] of the frames' numbers that make up best
    for each trial's change of the mean."""
    model = fitted.model
    learned = model.baseline.learned
    assert learned is not None
    side = len(learned.coefficients)
    shape = np.zeros((side * side, len(ready)))
    few = NUMBERS * len(frames)
    numbers = np.zeros((few + len(nudged), len(ready)))
    for k, frame in enumerate(frames):
        seen = plain.of(frame, k)
        tells = told(frame, seen)
        then = [other.of(frame, k) for other in ready]
        own = [((other.mean - seen.mean).ravel(), (other.variance - seen.variance).ravel()) for other in then]
        light = np.stack([tells.with_light(*change) for change in own])
        for d, change in enumerate(changes_of(frame, k, seen, nudged)):
            numbers[few + d] += [tells.information(change, one).sum() for one in own]
        numbers[NUMBERS * k : NUMBERS * (k + 1)] = plain.by_numbers(frame, k, seen) @ light.T
        u, v = (np.ascontiguousarray(part).ravel() for part in (seen.u, seen.v))
        normal.project(u, v, learned.step, side, np.exp(model.numbers.log_peak[k]) * light, shape)
    basis = contrasts(len(frames), len(nudged))
    parts = [fitted.schur.solve(shape[:, c], basis.T @ numbers[:, c]) for c in range(len(ready))]
    return np.stack([part[0] for part in parts], 1), basis @ np.stack([part[1] for part in parts], 1)
