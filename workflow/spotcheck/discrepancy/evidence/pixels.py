"""What the pixels say of a change of the model, to first order, beside the light's shape and all that is fitted.

Another model changes mean and variance of every pixel by (m, w). What shape, frames' numbers and free parameters can
make up for is taken off; of the rest, for readings y of mean µ and variance V, score and information are

    U = Σ m (y − µ) / V + Σ w ((y − µ)² / V − 1) / 2V,    I = Σ m² / V + Σ w² / 2V².
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.nuisance import normal
from spotcheck.discrepancy.nuisance.fit import NUMBERS, Fitted, changes_of, contrasts, nudged_of, shared
from spotcheck.discrepancy.nuisance.taken import taken_up
from spotcheck.discrepancy.observe.pixels import Expectation, Frame, Model, told
from spotcheck.model.light_shape import LightShape

# Cells in which an effect has to speak alike: azimuths, and the radius [σ] that parts near from far.
AZIMUTHS, RADIUS = 8, 1.2
CELLS = 2 * AZIMUTHS


class Score(NamedTuple):
    """Score and information of a change in its own units; of its information what would be there were the shape known;
    by what −2 ln L drops if all of the change is made and nothing else; and what makes up for it: coefficients of the
    shape and steps of the numbers and free parameters."""

    score: float
    information: float
    if_known: float
    drop: float
    shape: np.ndarray
    others: np.ndarray

    @property
    def z(self) -> float:
        """The score in its standard errors."""
        return self.score / float(np.sqrt(max(self.information, 1e-300)))

    @property
    def size(self) -> float:
        """How much of the change there is, to first order."""
        return self.score / max(self.information, 1e-300)


def screen(frames: Sequence[Frame], fitted: Fitted, others: Sequence[Model], workers: int = 2) -> list[Score]:
    """Score and information of each other model."""
    plain, ready = Expectation(frames, fitted.model), [Expectation(frames, other) for other in others]
    nudged, lacks = nudged_of(frames, fitted.model, fitted.free), taken_up(frames, fitted)

    def part(which: np.ndarray) -> list[np.ndarray]:
        return _sums(frames, fitted, plain, ready, nudged, lacks, which)

    score, raw, drop, shape, numbers, pull, own = shared(part, len(frames), workers)
    basis = contrasts(len(frames), len(nudged))
    right = fitted.schur.solve(pull[:, 0], basis.T @ own[:, 0])
    out = []
    for c in range(len(others)):
        x, n = shape[:, c], basis.T @ numbers[:, c]
        inner, step = fitted.schur.solve(x, n)
        only = normal.solve(fitted.schur.left + fitted.schur.given, n) if n.size else n
        left = raw[c] - x @ inner - n @ step
        own_score = float(score[c] - x @ right[0] - n @ right[1])
        out.append(Score(own_score, float(left), float(raw[c] - n @ only), float(drop[c]), inner, basis @ step))
    return out


def _sums(
    frames: Sequence[Frame], fitted: Fitted, plain: Expectation, ready: Sequence[Expectation], nudged, lacks, which
):
    """Of some frames: scores and information [trial], what trials share with the shape [coefficient, trial] and with
    all else that is fitted [number, trial], and the scores of both."""
    model, count = fitted.model, len(ready)
    learned = model.baseline.learned
    assert learned is not None
    side, few = len(learned.coefficients), NUMBERS * len(frames)
    score, raw, drop = np.zeros(count), np.zeros(count), np.zeros(count)
    shape, pull = np.zeros((side * side, count)), np.zeros((side * side, 1))
    numbers, own = np.zeros((few + len(nudged), count)), np.zeros((few + len(nudged), 1))
    for k in which:
        frame = frames[k]
        seen = plain.of(frame, k)
        tells = told(frame, seen)
        changes = []
        for c, other in enumerate(ready):
            then = other.of(frame, k)
            drop[c] += tells.deviance - told(frame, then).deviance
            changes.append(((then.mean - seen.mean).ravel(), (then.variance - seen.variance).ravel()))
        score += [tells.score(*change).sum() + lacks[k] @ change[1] for change in changes]
        raw += [tells.information(change, change).sum() for change in changes]
        light = np.stack([tells.with_light(*change) for change in changes])
        slopes = plain.by_numbers(frame, k, seen)
        at = slice(NUMBERS * k, NUMBERS * (k + 1))
        pulled = tells.light + lacks[k] * tells.growth
        numbers[at], own[at, 0] = slopes @ light.T, slopes @ pulled
        for d, change in enumerate(changes_of(frame, k, seen, nudged)):
            numbers[few + d] += [tells.information(change, one).sum() for one in changes]
            own[few + d] += tells.score(*change).sum() + lacks[k] @ change[1]
        u, v = (np.ascontiguousarray(part).ravel() for part in (seen.u, seen.v))
        peak = np.exp(model.numbers.log_peak[k])
        normal.project(u, v, learned.step, side, peak * light, shape)
        normal.project(u, v, learned.step, side, peak * pulled[None], pull)
    assert learned is not None
    flat = learned.coefficients.ravel()
    if 0 in which:
        pull[:, 0] -= fitted.penalty * normal.product(normal.roughness(side), flat)
    return [score, raw, drop, shape, numbers, pull, own]


def by_cell(frames: Sequence[Frame], fitted: Fitted, other: Model, own: Score, workers: int = 2):
    """Score and information [frame, cell] of a change, in 8 azimuths, near and far from the spot's centre."""
    plain, then = Expectation(frames, fitted.model), Expectation(frames, other)
    nudged, lacks = nudged_of(frames, fitted.model, fitted.free), taken_up(frames, fitted)
    learned, few = fitted.model.baseline.learned, NUMBERS * len(frames)
    assert learned is not None
    surface = LightShape(learned.step, own.shape.reshape(learned.coefficients.shape))

    def part(which: np.ndarray) -> list[np.ndarray]:
        score, information = np.zeros((len(frames), CELLS)), np.zeros((len(frames), CELLS))
        for k in which:
            seen = plain.of(frames[k], k)
            tells, after = told(frames[k], seen), then.of(frames[k], k)
            made_up = np.exp(fitted.model.numbers.log_peak[k]) * surface(seen.u, seen.v).ravel()
            made_up = made_up + own.others[NUMBERS * k : NUMBERS * (k + 1)] @ plain.by_numbers(frames[k], k, seen)
            mean = (after.mean - seen.mean).ravel() - tells.slope * made_up
            variance = (after.variance - seen.variance).ravel() - tells.growth * made_up
            for size, change in zip(own.others[few:], changes_of(frames[k], k, seen, nudged), strict=True):
                mean, variance = mean - size * change[0], variance - size * change[1]
            cell = _cells(seen.u, seen.v).ravel()
            score[k] = np.bincount(cell, tells.score(mean, variance) + lacks[k] * variance, CELLS)
            information[k] = np.bincount(cell, tells.information((mean, variance), (mean, variance)), CELLS)
        return [score, information]

    return shared(part, len(frames), workers)


def _cells(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Cell of each pixel."""
    turn = np.floor((np.arctan2(v, u) / (2 * np.pi) + 0.5) * AZIMUTHS).astype(int) % AZIMUTHS
    return turn + AZIMUTHS * (np.hypot(u, v) > RADIUS)
