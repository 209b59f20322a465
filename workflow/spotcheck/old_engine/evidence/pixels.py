"""What the pixels say of a change of the model, to first order, beside the light's shape and all that is fitted.

Another model changes mean and variance of every pixel by (m, w). What shape, frames' numbers and free parameters can
make up for is taken off; of the rest, for readings y of mean µ and variance V, score and information are

    U = Σ m (y − µ) / V + Σ w ((y − µ)² / V − 1) / 2V,    I = Σ m² / V + Σ w² / 2V².
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine import criteria
from spotcheck.old_engine.model.light_shape import LightShape
from spotcheck.old_engine.nuisance import normal
from spotcheck.old_engine.nuisance.fit import (
    NUMBERS,
    Fitted,
    coefficients_of,
    contrasts,
    roughness_of,
    rows_of,
    splines_of,
)
from spotcheck.old_engine.nuisance.parameters import changes_of, nudged_of
from spotcheck.old_engine.nuisance.taken import lacking, variances_of
from spotcheck.old_engine.nuisance.threads import shared
from spotcheck.old_engine.observe.pixels import Expectation, Expected, Frame, Model, Told, deviance_of, told

# Cells in which an effect has to speak alike: azimuths, and the radius [σ] that parts near from far.
AZIMUTHS, RADIUS = 8, 1.2
CELLS = 2 * AZIMUTHS


class Score(NamedTuple):
    """Score and information of a change in its own units; of its information what would be there were the shape known;
    by what −2 ln L drops if all of the change is made and nothing else, and by what it would if all were linear; and
    what makes up for the change: coefficients of the shape and steps of the numbers and free parameters."""

    score: float
    information: float
    if_known: float
    drop: float
    linear: float
    shape: np.ndarray
    others: np.ndarray

    @property
    def z(self) -> float:
        """The score in its standard errors."""
        return self.score / float(np.sqrt(max(self.information, 1e-300)))

    @property
    def promise(self) -> float:
        """What −2 ln L would gain with as much of the change as is best; 0 where that is less than none. Where readings
        do not follow a straight line there is all or nothing."""
        if not self.straight:
            return max(self.drop, 0.0)
        return self.z**2 if self.size > 0 else 0.0

    @property
    def straight(self) -> bool:
        """Whether readings follow the change in a straight line."""
        return abs(self.drop - self.linear) <= criteria.FIRST_ORDER.value * abs(self.linear)

    @property
    def size(self) -> float:
        """How much of the change there is, to first order."""
        return self.score / max(self.information, 1e-300)


def screen(frames: Sequence[Frame], fitted: Fitted, others: Sequence[Model]) -> list[Score]:
    """Score and information of each other model."""
    ready = Ready(frames, fitted, others)

    def part(which: np.ndarray) -> list[np.ndarray]:
        return _sums(frames, ready, which)

    score, raw, drop, shape, numbers, pull, own = shared(part, len(frames))
    basis = contrasts(fitted.model, len(fitted.free))
    pull[:, 0] -= fitted.penalty * normal.product(roughness_of(fitted.model), coefficients_of(fitted.model))
    right = fitted.schur.solve(pull[:, 0], basis.T @ own)
    out = []
    for c in range(len(others)):
        x, n = shape[:, c], basis.T @ numbers[:, c]
        inner, step = fitted.schur.solve(x, n)
        only = normal.solve(fitted.schur.left + fitted.schur.given, n) if n.size else n
        left = raw[c] - x @ inner - n @ step
        own_score = float(score[c] - x @ right[0] - n @ right[1])
        known, linear = float(raw[c] - n @ only), float(2 * score[c] - raw[c])
        out.append(Score(own_score, float(left), known, float(drop[c]), linear, inner, basis @ step))
    return out


class Ready:
    """A fit and other models, made ready for a pass over the frames."""

    def __init__(self, frames: Sequence[Frame], fitted: Fitted, others: Sequence[Model]):
        self.fitted = fitted
        self.step, self.side = splines_of(fitted.model)
        self.peaks = np.exp(fitted.model.numbers.log_peak)
        self.plain = Expectation(frames, fitted.model)
        self.others = [Expectation(frames, other, self.plain) for other in others]
        self.nudged = nudged_of(frames, self.plain, fitted.free)
        self.variances = variances_of(fitted)

    def of(self, frame: Frame, k: int):
        """What a frame should read and tells, with what its variance's score lacks given back."""
        seen = self.plain.of(frame, k)
        tells = told(frame, seen)
        lacks = lacking(self.variances[k], float(self.peaks[k]), seen, tells)
        tells = tells._replace(variance=tells.variance + lacks, light=tells.light + lacks * seen.growth)
        return seen, tells

    def made_up(self, shape: np.ndarray, k: int, seen: Expected) -> np.ndarray | float:
        """Light [row, column] of frame `k` by which coefficients of all shapes change it [DN]."""
        if not self.side:
            return 0.0
        own = LightShape(self.step, shape[rows_of(self.fitted.model, k)].reshape(self.side, self.side))
        return self.peaks[k] * seen.factor * own(seen.u[None], seen.v[None])[0]


def _sums(frames: Sequence[Frame], ready: Ready, which: np.ndarray):
    """Of some frames: scores and information [trial], what trials share with the shape [coefficient, trial] and with
    all else that is fitted [number, trial], and the scores of both."""
    count, few, side = len(ready.others), NUMBERS * len(frames), ready.side
    size = coefficients_of(ready.fitted.model).size
    score, raw, drop = np.zeros(count), np.zeros(count), np.zeros(count)
    shape, pull = np.zeros((count, size)), np.zeros((size, 1))
    numbers, own = np.zeros((few + len(ready.nudged), count)), np.zeros(few + len(ready.nudged))
    for k in which:
        frame, at, light = frames[k], slice(NUMBERS * k, NUMBERS * (k + 1)), rows_of(ready.fitted.model, k)
        seen, tells = ready.of(frame, k)
        peak = ready.peaks[k] * seen.factor
        slopes = ready.plain.by_numbers(frame, k, seen).reshape(NUMBERS, -1)
        free = changes_of(frame, k, seen, ready.nudged)
        own[at] = slopes @ tells.light.ravel()
        own[few:] += [tells.score(*change) for change in free]
        for u, v, weight in seen.copies:
            normal.project(u, v, ready.step, side, (weight * peak * tells.light)[None], pull[light])
        before = deviance_of(frame, seen)
        for c, other in enumerate(ready.others):
            then = other.of(frame, k, seen)
            drop[c] += before - deviance_of(frame, then)
            change = then.mean - seen.mean, then.variance - seen.variance
            score[c] += tells.score(*change)
            raw[c] += tells.information(change, change)
            lights = tells.with_light(*change)
            numbers[at, c] = slopes @ lights.ravel()
            normal.project(seen.u, seen.v, ready.step, side, (peak * lights)[None], shape[c, light, None])
            numbers[few:, c] += [tells.information(change, one) for one in free]
    return [score, raw, drop, shape.T, numbers, pull, own]


class Field(NamedTuple):
    """A field of a model, as the likelihood of single pixels does not know it: its contrast, and how many pixels of it
    count as one: the sums of its correlations and of their squares."""

    contrast: float
    alike: float
    alike_squared: float


class ByCell(NamedTuple):
    """Score and information of a change [frame, cell], in 8 azimuths, near and far from the spot's centre; and of the
    score's variance what pixels bring each for itself, and what by fields that neighbours share."""

    score: np.ndarray
    information: np.ndarray
    alone: np.ndarray
    together: np.ndarray


def by_cell(
    frames: Sequence[Frame],
    fitted: Fitted,
    others: Sequence[Model],
    scores: Sequence[Score],
    fields: Sequence[Field] = (),
) -> list[ByCell]:
    """The changes to other models by their cells, of their `scores` on all frames."""
    ready = Ready(frames, fitted, others)

    def part(which: np.ndarray) -> list[np.ndarray]:
        out = np.zeros((len(others), 4, len(frames), CELLS))
        for k in which:
            seen, tells = ready.of(frames[k], k)
            slopes, cell = ready.plain.by_numbers(frames[k], k, seen), cells_of(seen.u, seen.v).ravel()
            free = changes_of(frames[k], k, seen, ready.nudged)
            for to, other, own in zip(out[:, :, k], ready.others, scores, strict=True):
                after = other.of(frames[k], k, seen)
                mean, variance = _left(ready, own, k, (after.mean - seen.mean, after.variance - seen.variance),
                                       seen, tells, slopes, free)  # fmt: skip
                told_here = _told_by(mean, variance, seen, tells, fields)
                to[:] = [np.bincount(cell, one.ravel(), CELLS) for one in told_here]
        return [out]

    (out,) = shared(part, len(frames))
    return [ByCell(*own) for own in out]


def _left(ready: Ready, own: Score, k: int, change, seen: Expected, tells: Told, slopes, free):
    """What is left of a change of mean and variance [row, column] beside all that makes up for it."""
    few = NUMBERS * len(ready.fitted.model.numbers.x)
    made_up = ready.made_up(own.shape, k, seen)
    made_up = made_up + np.tensordot(own.others[NUMBERS * k : NUMBERS * (k + 1)], slopes, 1)
    mean, variance = change[0] - tells.slope * made_up, change[1] - tells.growth * made_up
    for size, one in zip(own.others[few:], free, strict=True):
        mean, variance = mean - size * one[0], variance - size * one[1]
    return mean, variance


def _told_by(mean, variance, seen: Expected, tells: Told, fields: Sequence[Field]):
    """Score, information, and both parts of the score's variance [row, column] of a change."""
    by_mean, by_variance = mean**2 * tells.sure, variance**2 * tells.sure_variance
    together = np.zeros_like(by_mean)
    left = np.ones_like(by_mean), np.ones_like(by_mean)
    for field in fields:
        # The part of a reading's variance that the field has.
        has = np.clip((field.contrast * seen.slope * seen.spot) ** 2 * tells.sure, 0.0, 1.0)
        together += by_mean * has * field.alike + by_variance * has**2 * field.alike_squared
        left = left[0] - has, left[1] - has**2
    alone = by_mean * np.maximum(left[0], 0.0) + by_variance * np.maximum(left[1], 0.0)
    return mean * tells.mean + variance * tells.variance, by_mean + by_variance, alone, together


def cells_of(u: np.ndarray, v: np.ndarray, radii: Sequence[float] | np.ndarray = (RADIUS,)) -> np.ndarray:
    """Cell of each point about the spot, u and v in σ: its azimuth, those of each ring behind those further in."""
    turn = np.floor((np.arctan2(v, u) / (2 * np.pi) + 0.5) * AZIMUTHS).astype(int) % AZIMUTHS
    return turn + AZIMUTHS * np.searchsorted(radii, np.hypot(u, v))
