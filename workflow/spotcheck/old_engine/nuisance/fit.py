"""The light's shape, every frame's brightness, width and centre, and effects, fitted to all pixels at once.

Fisher's scoring on χ² + Σ ln variance + λ cᵀPc. The shape is common to all frames, in the coordinates of the spot; what
it shares with the frames' numbers (all brighter, all wider, all moved) is the shape's: the numbers' steps sum to 0.
Where the model learns no shape, the declared one stands and all numbers are free.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from spotcheck.old_engine.nuisance import normal
from spotcheck.old_engine.nuisance.parameters import (
    NUDGE,
    SENSOR,
    Free,
    Nudged,
    changed,
    changes_of,
    free_of_sheet,
    nudged_of,
    of_noise,
    values_of,
)
from spotcheck.old_engine.nuisance.threads import shared
from spotcheck.old_engine.observe.pixels import Expectation, Frame, Model, Numbers, told

NUMBERS = len(Numbers._fields)
# The dear matrices of the normal equations are made at so many first steps, then at every so many, and kept between.
RENEWED, AGAIN = 2, 4
# While χ² is so many times the number of readings, so many steps at most are led by means alone: far from a fit a large
# residual asks for more variance, and so for more light.
FAR, MEANS = 1.5, 6
# A step that makes χ² so many times as large leads astray, even there.
WORSE = 2.0
# A step that gains less than this in −2 ln L ends the fit; one that loses is halved so many times.
ENOUGH, HALVINGS = 0.5, 4
# The farthest that a step may change logs of peak and width, and a centre [σ]; of a parameter it is its own size.
FARTHEST = (0.5, 0.3, 1.0, 1.0)
# The farthest for the shape [peaks], and part of the median coefficient's information that every coefficient gets on
# top in a step: where all frames are clipped they tell next to nothing, and a straight line leads far off.
FARTHEST_SHAPE, HELD = 0.3, 1e-3
# Part of the way to a bound that a step may go.
TOWARDS = 0.9
# Part of that which is left each time that the matrices are made anew: what is held comes home slowly.
EASED = 0.1


class Sums(NamedTuple):
    """Of all pixels under a model: −2 ln L but for constants, and χ² over the readings' number; the scores of shape and
    of numbers and free parameters; of the latter X [coefficient, parameter], and D with numbers [number, parameter] and
    among themselves; and of the numbers, where they were asked for, G [coefficient, 4, 7], X [coefficient, number] and
    D [number, number]."""

    deviance: float
    chi2: float
    shape: np.ndarray
    others: np.ndarray
    behind: np.ndarray
    cross: np.ndarray
    own: np.ndarray
    gram: np.ndarray
    joined: np.ndarray
    dense: np.ndarray


class Fitted(NamedTuple):
    """The model, its free parameters, −2 ln L with the penalty, the factored normal equations, the penalty, and how
    many steps were taken."""

    model: Model
    free: tuple[Free, ...]
    total: float
    schur: normal.Schur
    penalty: float
    steps: int

    @property
    def covariance(self) -> np.ndarray:
        """Of the numbers' steps and, behind them, of the effects' free parameters."""
        return normal.covariance(self.schur.left)


def sums_of(
    frames: Sequence[Frame],
    model: Model,
    free: Sequence[Free] = (),
    *,
    curved: bool,
    by_variance: bool = True,
) -> Sums:
    """All sums under a model; `curved`: those of shape and numbers too; without `by_variance` means alone tell."""
    ready = Expectation(frames, model)
    others = nudged_of(frames, ready, free)

    def part(which: np.ndarray) -> Sums:
        return _part(frames, model, ready, others, which, curved, by_variance)

    sums = Sums(*shared(part, len(frames)))
    return sums._replace(chi2=sums.chi2 / sum(np.count_nonzero(np.isfinite(own.pixels)) for own in frames))


def _part(
    frames: Sequence[Frame],
    model: Model,
    ready: Expectation,
    nudged: Nudged,
    which: np.ndarray,
    curved: bool,
    by_variance: bool,
) -> Sums:
    """The sums of some frames."""
    (step, side), few, more = splines_of(model), NUMBERS * len(frames), len(nudged)
    size = coefficients_of(model).size
    shape, others = np.zeros((size, 1)), np.zeros(few + more)
    behind, cross, own = np.zeros((size, more)), np.zeros((few, more)), np.zeros((more, more))
    gram, joined, dense = (
        (np.zeros((size, 4, 7)), np.zeros((size, few)), np.zeros((few, few))) if curved else np.zeros((3, 0))
    )
    deviance = chi2 = 0.0
    for k in which:
        frame, light = frames[k], rows_of(model, k)
        seen = ready.of(frame, k)
        tells = told(frame, seen, by_variance=by_variance)
        deviance += tells.deviance
        chi2 += tells.chi2
        at, factor = slice(NUMBERS * k, NUMBERS * (k + 1)), np.exp(model.numbers.log_peak[k]) * seen.factor
        slopes = ready.by_numbers(frame, k, seen)
        flat = slopes.reshape(NUMBERS, -1)
        others[at] = flat @ tells.light.ravel()
        # The score is that of all copies of the spot; in the matrices, which only lead there, the first stands for all.
        for u, v, weight in seen.copies:
            normal.project(u, v, step, side, (weight * factor * tells.light)[None], shape[light])
        if curved:
            normal.gather(seen.u, seen.v, step, side, factor**2 * tells.sure_light, gram[light])
            block, sure = np.zeros((side * side, NUMBERS)), slopes * tells.sure_light
            normal.project(seen.u, seen.v, step, side, factor * sure, block)
            joined[light, at] = block
            dense[at, at] = sure.reshape(NUMBERS, -1) @ flat.T
        if nudged:
            changes = changes_of(frame, k, seen, nudged)
            others[few:] += [tells.score(*change) for change in changes]
            lights = np.stack([tells.with_light(*change) for change in changes])
            normal.project(seen.u, seen.v, step, side, factor * lights, behind[light])
            cross[at] = flat @ lights.reshape(more, -1).T
            own += [[tells.information(one, two) for two in changes] for one in changes]
    return Sums(deviance, chi2, shape[:, 0], others, behind, cross, own, gram, joined, dense)


def splines_of(model: Model) -> tuple[float, int]:
    """Step [σ] of the learned shapes' splines and how many lie along each axis: none where no shape is learned."""
    return (model.lights.step, model.lights.side) if model.lights is not None else (1.0, 0)


def coefficients_of(model: Model) -> np.ndarray:
    """Coefficients of the learned shapes, one behind the other."""
    return np.zeros(0) if model.lights is None else model.lights.coefficients.ravel()


def count_of(model: Model) -> int:
    """How many lights have a learned shape; 1 where none has."""
    return 1 if model.lights is None else len(model.lights.coefficients)


def rows_of(model: Model, k: int) -> slice:
    """Which of the coefficients are those of frame `k`."""
    return slice(0) if model.lights is None else model.lights.rows(k)


def roughness_of(model: Model) -> np.ndarray:
    """The penalty's matrix, banded, at a penalty of 1."""
    return normal.roughness(splines_of(model)[1], count_of(model))


def contrasts(model: Model, more: int = 0) -> np.ndarray:
    """Orthonormal steps of all frames' numbers [number, step], which sum to 0 over the frames of each light where its
    shape is learned; `more` numbers behind them are free."""
    apart = np.eye(len(model.numbers.x))
    if model.lights is not None:
        parts = []
        for light in np.unique(model.lights.which):
            own = np.flatnonzero(model.lights.which == light)
            parts.append(apart[:, own] @ np.linalg.svd(np.eye(own.size) - 1 / own.size)[0][:, : own.size - 1])
        apart = np.hstack(parts)
    return linalg.block_diag(np.kron(apart, np.eye(NUMBERS)), np.eye(more))


def fit(
    frames: Sequence[Frame],
    model: Model,
    penalty: float,
    free: Sequence[Free] = (),
    steps: int = 8,
    tilt: np.ndarray | float = 0.0,
    near: Fitted | None = None,
) -> Fitted:
    """Fit shape, numbers, free parameters and, behind them, what a sheet leaves open. `tilt` [parameter] is added to
    the parameters' scores (`sheet.tilt_of`); a fit that lies `near`, of the same frames, lends its matrices."""
    free = (*(own for own in free if own.effect != SENSOR), *free_of_sheet(model))
    rough = penalty * roughness_of(model)
    known, centre = (np.array([getattr(own, name) for own in free]) for name in ("precision", "centre"))
    basis = contrasts(model)
    apart, few = basis.shape[1], NUMBERS * len(frames)
    lent = near.schur.first(apart) if near is not None else None
    best, total, chi2, taken, halved = model, np.inf, np.inf, 0, 0
    lowest: tuple[float, Model, Sums | None] = np.inf, model, None
    shape, others, far, held = np.zeros(0), np.zeros(0), False, HELD
    for taken in range(1, steps + 2):
        renewed = lent is None or (near is None and taken <= RENEWED) or taken % AGAIN == 0
        sums = sums_of(frames, model, free, curved=renewed, by_variance=not far)
        by_means = far or (taken == 1 and sums.chi2 > FAR)
        if by_means and not far:
            sums = sums_of(frames, model, free, curved=renewed, by_variance=False)
        bent, off = normal.product(rough, coefficients_of(model)), centre - values_of(model, free)
        prior = float(known @ off**2) + 2 * float(np.sum(tilt * off))
        now = sums.deviance + float(coefficients_of(model) @ bent) + prior
        if now < lowest[0]:
            whole = (renewed or near is not None) and not by_means
            lowest = now, model, sums if whole else None
        worse = sums.chi2 > WORSE * chi2 if far else not now <= total
        if worse and halved < HALVINGS:
            shape, others, halved = shape / 2, others / 2, halved + 1
            model = stepped(best, shape, others, free)
            continue
        if lent is None or renewed:
            held = HELD if taken <= RENEWED else EASED * held
            lent = _reduced(model, sums, rough, basis, held)
        done = (total - now < ENOUGH and not far) or taken > steps
        if now <= total or far:
            best, total, chi2 = model, now, sums.chi2
        far = sums.chi2 > FAR and taken < MEANS
        if done:
            break
        score = np.concatenate([basis.T @ sums.others[:few], sums.others[few:] + known * off + tilt])
        shape, moved = _inside(model, free, _bordered(lent, sums, basis, known), sums.shape - bent, score)
        # What means do not tell waits while they lead.
        moves = [not (by_means and of_noise(model, own)) for own in free]
        others = np.concatenate([basis @ moved[:apart], moved[apart:] * moves])
        part = min(bold(others, free), FARTHEST_SHAPE / np.abs(shape).max(initial=FARTHEST_SHAPE))
        shape, others, halved = part * shape, part * others, 0
        model = stepped(best, shape, others, free)
    # Scores and errors need the matrices of the model that was found, or what shape takes exceeds what there is.
    total, best, last = lowest
    sums = last or sums_of(frames, best, free, curved=near is None)
    if lent is None or near is None:
        lent = _reduced(best, sums, rough, basis)
    return Fitted(best, free, total, _bordered(lent, sums, basis, known), penalty, taken)


def _inside(model: Model, free: Sequence[Free], schur: normal.Schur, shape: np.ndarray, score: np.ndarray):
    """The step of coefficients and of all other numbers. A parameter that would leave its bounds goes most of the way:
    at a strength of 0 the others would say nothing; one that is as good as there stays."""
    step, moved = schur.solve(shape, score)
    first, values = len(score) - len(free), values_of(model, free)
    low, high, near = (np.array([getattr(own, name) for own in free]) for name in ("low", "high", "nudge"))
    there = ((values - low < near) & (moved[first:] < 0)) | ((high - values < near) & (moved[first:] > 0))
    if there.any():
        moved = np.zeros(len(score))
        places = first + np.flatnonzero(there)
        rest = np.delete(np.arange(len(score)), places)
        step, moved[rest] = schur.without(places).solve(shape, score[rest])
    moved[first:] = np.clip(moved[first:], TOWARDS * (low - values), TOWARDS * (high - values))
    return step, moved


def _reduced(model: Model, sums: Sums, rough: np.ndarray, basis: np.ndarray, held: float = 0.0) -> normal.Schur:
    """Shape and numbers; `held`: so much of the median coefficient's information on top."""
    band = normal.banded(sums.gram, splines_of(model)[1]) + rough
    if held and band.size:
        band[0] += held * np.median(band[0])
    return normal.schur(band, sums.joined @ basis, basis.T @ sums.dense @ basis, count_of(model))


def _bordered(lent: normal.Schur, sums: Sums, basis: np.ndarray, known: np.ndarray) -> normal.Schur:
    """The same with the free parameters behind."""
    return lent.bordered(sums.behind, basis.T @ sums.cross, sums.own + np.diag(known))


def bold(numbers: np.ndarray, free: Sequence[Free]) -> float:
    """Which part of a step may be taken at once: beyond, its straight line leads nowhere."""
    last = len(numbers) - len(free)
    reach = np.concatenate([np.tile(FARTHEST, last // NUMBERS), [own.nudge / NUDGE for own in free]])
    return float(min(1.0, 1 / max(np.max(np.abs(numbers) / reach, initial=0.0), 1e-300)))


def stepped(model: Model, shape: np.ndarray, numbers: np.ndarray, free: Sequence[Free]) -> Model:
    """A model after a step of the shape's coefficients, of the frames' numbers (centres in σ) and of parameters."""
    own, last = model.numbers, NUMBERS * len(model.numbers.x)
    step = numbers[:last].reshape(-1, NUMBERS).T
    width = np.exp(own.log_width)
    moved = Numbers(own.log_peak + step[0], own.log_width + step[1], own.x + width * step[2], own.y + width * step[3])
    lights = model.lights
    if lights is not None:
        lights = lights._replace(coefficients=lights.coefficients + shape.reshape(lights.coefficients.shape))
    model = model._replace(lights=lights, numbers=moved)
    return changed(model, free, values_of(model, free) + numbers[last:])
