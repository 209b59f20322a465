"""Score tests: the drop of −2 ln L that each starting point of each effect promises, before anything is refitted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.evaluation import (
    SENSOR,
    Column,
    Evaluation,
    change_of_moments,
    columns_of,
    evaluate,
    stages_of,
    subtract_absorbed,
    sum_batches,
)
from spotcheck.discrepancy.frames import conditions_of
from spotcheck.discrepancy.joint_fit import JointFit, JointModel
from spotcheck.discrepancy.normal_equations import solve_positive
from spotcheck.discrepancy.shape_grid import HALF_WIDTH
from spotcheck.discrepancy.shape_sums import ShapeSums
from spotcheck.model.effect import AppliedEffect, Effect, EffectScales, RandomStep
from spotcheck.model.stage import Stage

# Multiples of a start's strength at which a fit may begin: the score test extrapolates a straight line. Beside a free
# shape a fit begins no farther out than the start, since the shape must move along with the effect.
SIZES, SIZES_BESIDE_SHAPE = (0.3, 30.0), (0.3, 1.0)
# Least multiple of a start whose effect is no straight line in its strength, such as a clip: about 1 is expected.
LEAST_FINITE_SIZE = 0.15
# Part of a column's information that must be left beside the nuisance parameters; else these can do the same.
SEPARABLE_SHARE = 1e-5
# Part of a candidate's information that a free shape leaves, over the part of the candidate that differs between
# frames, from which on it is a shape finer than the nodes.
UNRESOLVED = 5.0
# Leading candidates of which the part of a granular field is measured.
MOST_FIELD_SHARES = 24
# Frames that are compared for it; places along each side, and the farthest of them [σ].
MOST_COMPARED, PLACES, FARTHEST = 16, 61, 7.0
# Stages that change the spot of a frame as its own parameters do: effects there are laws across frames.
SPOT_STAGES = {Stage.EXPOSURE, Stage.WIDTH, Stage.BRIGHTNESS}


@dataclass(frozen=True)
class Candidate:
    """A starting point of an effect and its score test."""

    start: AppliedEffect  # where a fit of the effect begins
    score: float  # expected drop of −2 ln L on the tested pixels beside all nuisance parameters, less 1 for noise
    place: int  # position among all starting points: variants that tie are taken in this order
    share: float  # part of the information on its strength that the nuisance parameters leave
    # Part of the variance that a granular field has, over that information; the mean of the light for minor candidates.
    field_share: float


def changes_mean_image(effect: Effect) -> bool:
    """Return whether an effect changes the mean image of single frames other than their brightness and width."""
    steps = [step for steps in effect.variants.values() for step in steps]
    is_law = all(step.stage in SPOT_STAGES for step in steps)
    return bool(steps) and not is_law and not all(isinstance(step, RandomStep) for step in steps)


def list_starts(effects: Sequence[Effect], scales: EffectScales) -> list[AppliedEffect]:
    """Return the starting points of all deterministic variants of effects."""
    starts = []
    for effect in effects:
        bounds = effect.bounds(scales)
        for variant, steps in effect.variants.items():
            if any(isinstance(step, RandomStep) for step in steps):
                continue
            has = [parameter in effect.parameters_of(variant) for parameter in effect.parameters]
            distinct = {tuple(np.where(has, start, np.nan)): None for start in effect.starts(scales)}
            starts += [
                AppliedEffect(effect, variant, tuple(np.clip(values, bounds[:, 0], bounds[:, 1])))
                for values in distinct
            ]
    unique: dict[str, AppliedEffect] = {}
    for start in starts:
        unique.setdefault(repr((start.effect.name, start.variant, start.values)), start)
    return list(unique.values())


def screen_candidates(fit: JointFit, starts: Sequence[AppliedEffect]) -> list[Candidate]:
    """Return the score test of each starting point, the most promising first.

    Parameters
    ----------
    fit : JointFit
        Present model, fitted to the pixels of the test.
    starts : sequence of AppliedEffect
        Starting points of absent effects.

    Notes
    -----
    With score U and Fisher information I of the change that a start makes, both beside the nuisance parameters, the
    expected drop of −2 ln L is U²/I at U/I times the start's strength.
    """
    changes = project_changes(fit, starts)
    candidates = []
    rows = zip(starts, changes.score, changes.information, changes.alone, strict=True)
    for place, (start, u, i, whole) in enumerate(rows):
        if not (np.isfinite(u) and i > SEPARABLE_SHARE * whole > 0):
            continue
        scaled = scale_start(start, float(u / i), fit.model)
        if scaled is not None:
            score, share = float(max(u * u / i - 1, 0.0)), float(i / whole)
            candidates.append(Candidate(scaled, score, place, share, fit.pixels.mean_field_share))
    candidates.sort(key=lambda candidate: -candidate.score)
    if fit.pixels.mean_field_share == 0 or not candidates:
        return candidates
    places = [candidate.place for candidate in candidates[:MOST_FIELD_SHARES]]
    shares = measure_field_shares(fit, [starts[place] for place in places], changes.select(places))
    leading = [replace(c, field_share=float(share)) for c, share in zip(candidates, shares, strict=False)]
    return [*leading, *candidates[len(places) :]]


def scale_start(start: AppliedEffect, size: float, model: JointModel) -> AppliedEffect | None:
    """Return a start with its strength multiplied by an estimated size; None if the estimate cannot be the effect."""
    effect = start.effect
    strength = effect.parameters[0].name
    value = start.parameters[strength]
    if not np.isfinite(effect.vanishes_at):
        return start if size > LEAST_FINITE_SIZE else None
    if size < 0 and value_is_one_sided(start):
        return None
    limits = SIZES if model.grid is None else SIZES_BESIDE_SHAPE
    size = float(np.sign(size) * np.clip(abs(size), *limits))
    return start.with_value(strength, effect.vanishes_at + size * (value - effect.vanishes_at))


def value_is_one_sided(start: AppliedEffect) -> bool:
    """Return whether the strength of an effect cannot lie on the other side of where it vanishes."""
    low = start.effect.parameters[0].low
    return not callable(low) and low == start.effect.vanishes_at


class ChangeSums:
    """Sums over the pixels of some frames with changes of their readings, as the normal equations of a fit need them.

    Parameters
    ----------
    fit : JointFit
        Fit beside whose unknowns the changes are judged.
    at : Evaluation
        Its model at the pixels of the frames.
    part : slice
        The frames.
    count : int
        Number of changes.
    """

    def __init__(self, fit: JointFit, at: Evaluation, part: slice, count: int) -> None:
        self._at, self._part, self._fitted = at, part, columns_of(fit.model, at)
        self._shape = None if fit.model.grid is None else ShapeSums(fit.model, at)
        self._first_fitted = 4 * fit.equations.frames
        # Information of each change [change], with the unknowns beside a free shape [unknown, change], and with the
        # coefficients of that [coefficient, change].
        self.alone = np.zeros(count)
        self.cross = np.zeros((fit.equations.size, count))
        self.of_shape = np.zeros((0 if self._shape is None else self._shape.nodes**2, count))

    def add(self, k: int, change: Column) -> None:
        """Add change number k."""
        at, spots = self._at, slice(4 * self._part.start, 4 * self._part.stop)
        self.alone[k] = at.information_of(change, change)
        equivalent = at.light_equivalent(change)
        self.cross[spots, k] = np.einsum("afhw,fhw->fa", at.slopes, equivalent).ravel()
        self.cross[self._first_fitted :, k] = [at.information_of(change, column) for column in self._fitted]
        if self._shape is not None:
            self.of_shape[:, k] = self._shape.products(equivalent[None])[:, 0]


@dataclass(frozen=True)
class ProjectedChanges:
    """Changes by N starts beside the nuisance parameters."""

    score: np.ndarray  # of each change beside them [start]
    information: np.ndarray  # Fisher information beside them [start]
    alone: np.ndarray  # information without them [start]
    absorbed: np.ndarray  # what spots, sensor and fitted effects take of each change [unknown, start]
    # L⁻¹ times the information between the coefficients of a free shape and each start [coefficient, start], where L L'
    # is that of the coefficients; None beside the declared shape.
    half_shape: np.ndarray | None

    def select(self, starts: Sequence[int]) -> "ProjectedChanges":
        """Return the changes by some of the starts."""
        half = None if self.half_shape is None else self.half_shape[:, starts]
        parts = (self.score[starts], self.information[starts], self.alone[starts], self.absorbed[:, starts])
        return ProjectedChanges(*parts, half)


def project_changes(fit: JointFit, starts: Sequence[AppliedEffect]) -> ProjectedChanges:
    """Return the changes by starts beside the nuisance parameters of a fit."""
    model, equations = fit.model, fit.equations

    def of_batch(part: slice) -> tuple[np.ndarray, ...]:
        at = evaluate(model, fit.pixels, part)
        sums, score = ChangeSums(fit, at, part, len(starts)), np.zeros(len(starts))
        for k, start in enumerate(starts):
            change = change_by(model, start, at)
            score[k] = at.score(change)
            sums.add(k, change)
        return sums.cross, score, sums.alone, sums.of_shape

    cross, score, alone, of_shape = sum_batches(of_batch, fit.pixels)
    beside, half = alone.copy(), None
    if equations.shape is not None:
        half = equations.shape.factor.half_solve(of_shape)
        cross = cross - equations.shape.cross.T @ half
        score = score - half.T @ equations.shape.score
        beside -= np.sum(half**2, axis=0)
    absorbed = solve_positive(equations.information, cross)
    score, information = score - absorbed.T @ equations.gradient, beside - np.sum(cross * absorbed, axis=0)
    return ProjectedChanges(score, information, alone, absorbed, half)


def measure_field_shares(fit: JointFit, starts: Sequence[AppliedEffect], changes: ProjectedChanges) -> np.ndarray:
    """Return the part of the variance that a granular field has, in the mean over the information on each start."""
    model, equations = fit.model, fit.equations
    of_shape = None
    if changes.half_shape is not None and equations.shape is not None:
        of_shape = equations.shape.factor.back_solve(changes.half_shape - equations.shape.cross @ changes.absorbed)

    def of_batch(part: slice) -> tuple[np.ndarray]:
        at = evaluate(model, fit.pixels, part)
        fitted = columns_of(model, at)
        light = None if of_shape is None else ShapeSums(model, at).values(of_shape)
        sums = np.zeros((2, len(starts)))
        for k, start in enumerate(starts):
            change, of_light = change_by(model, start, at), None if light is None else light[k]
            change = subtract_absorbed(at, part, change, changes.absorbed[:, k], fitted, of_light)
            information = at.information_per_pixel(change)
            sums[:, k] = np.sum(at.field_share * information), np.sum(information)
        return (sums,)

    ((of_field, information),) = sum_batches(of_batch, fit.pixels)
    return of_field / np.maximum(information, 1e-300)


def is_unresolved_shape(fit: JointFit, candidate: Candidate) -> bool:
    """Return whether a candidate is a shape of the light that is finer than the nodes of the free shape beside it.

    A free shape with nodes close enough takes every change that is the same in all frames, in units of the spot. If the
    nodes leave much more of a candidate than differs between frames, they cannot draw it.
    """
    if fit.model.grid is None or stages_of(candidate.start) & SENSOR:
        return False
    return candidate.share > UNRESOLVED * varying_share(fit, candidate.start)


def varying_share(fit: JointFit, applied: AppliedEffect) -> float:
    """Return the part of an effect's change of the light that differs between frames in units of the spot, or lies
    beyond the nodes of the free shape; by squares in units of the peak, weighted with the peak as photons count."""
    model, pixels = fit.model, fit.pixels
    frames = np.unique(np.linspace(0, len(model.spots.x) - 1, MOST_COMPARED).astype(int))
    spots, compared = model.spots.select(frames), pixels.select(frames)
    places = np.linspace(-FARTHEST, FARTHEST, PLACES)
    sigma = np.exp(spots.log_sigma)[:, None]
    x, y = spots.x[:, None] + sigma * places, spots.y[:, None] + sigma * places
    is_inside_x, is_inside_y = (
        (place > pixel.min(axis=1, keepdims=True)) & (place < pixel.max(axis=1, keepdims=True))
        for place, pixel in ((x, compared.x[:, 0]), (y, compared.y[:, :, 0]))
    )
    sampled = replace(compared, x=x[:, None, :], y=y[:, :, None], row_share=np.ones((len(frames), PLACES, 1)))
    conditions = conditions_of(model.design.select(frames), spots, sampled)
    with_effect = replace(model.forward, effects=(*model.forward.effects, applied))
    change = (with_effect.light(conditions).total - model.forward.light(conditions).total) / conditions.peak_dn
    weight = conditions.peak_dn * is_inside_x[:, None, :] * is_inside_y[:, :, None]
    mean = np.sum(weight * change, axis=0) / np.maximum(np.sum(weight, axis=0), 1e-300)
    mean[np.hypot(places[:, None], places) > HALF_WIDTH] = 0.0
    return float(np.sum(weight * (change - mean) ** 2) / max(np.sum(weight * change**2), 1e-300))


def change_by(model: JointModel, start: AppliedEffect, at: Evaluation) -> Column:
    """Return the change of mean and variance that an effect makes on top of a model."""
    forward = replace(model.forward, effects=(*model.forward.effects, start))
    return change_of_moments(forward, at, has_same_light=stages_of(start) <= SENSOR)
