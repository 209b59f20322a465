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
    score, information, raw = project_changes(fit.model, fit, starts)
    candidates = []
    for place, (start, u, i, whole) in enumerate(zip(starts, score, information, raw, strict=True)):
        if not (np.isfinite(u) and i > SEPARABLE_SHARE * whole > 0):
            continue
        scaled = scale_start(start, float(u / i), fit.model)
        if scaled is not None:
            candidates.append(Candidate(scaled, float(max(u * u / i - 1, 0.0)), place, float(i / whole)))
    return sorted(candidates, key=lambda candidate: -candidate.score)


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


def project_changes(
    model: JointModel, fit: JointFit, starts: Sequence[AppliedEffect]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return score, Fisher information beside the nuisance parameters, and that alone, of the change by each start."""
    frames, equations = len(model.spots.x), fit.equations

    def of_batch(part: slice) -> tuple[np.ndarray, ...]:
        at = evaluate(model, fit.pixels, part)
        fitted = columns_of(model, at)
        cross = np.zeros((equations.size, len(starts)))
        score, alone = np.zeros(len(starts)), np.zeros(len(starts))
        sums = None if model.grid is None else ShapeSums(model, at)
        of_shape = np.zeros((0 if sums is None else sums.nodes**2, len(starts)))
        for k, start in enumerate(starts):
            column = change_by(model, start, at)
            score[k] = at.score(column)
            alone[k] = at.information_of(column, column)
            equivalent = at.light_equivalent(column)
            cross[4 * part.start : 4 * part.stop, k] = np.einsum("afhw,fhw->fa", at.slopes, equivalent).ravel()
            cross[4 * frames :, k] = [at.information_of(column, other) for other in fitted]
            if sums is not None:
                of_shape[:, k] = sums.products(equivalent[None])[:, 0]
        return cross, score, alone, of_shape

    cross, score, alone, of_shape = sum_batches(of_batch, fit.pixels)
    beside = alone.copy()
    if equations.shape is not None:
        half = equations.shape.factor.half_solve(of_shape)
        cross = cross - equations.shape.cross.T @ half
        score = score - half.T @ equations.shape.score
        beside -= np.sum(half**2, axis=0)
    absorbed = solve_positive(equations.information, cross)
    return score - absorbed.T @ equations.gradient, beside - np.sum(cross * absorbed, axis=0), alone


def is_unresolved_shape(fit: JointFit, candidate: Candidate) -> bool:
    """Return whether a candidate is a shape of the light that is finer than the nodes of the free shape beside it.

    Of a change that is the same in every frame, in units of the spot, a free shape with nodes close enough would leave
    nothing. A candidate of which the free shape leaves much more than what differs between frames is such a change.
    """
    if fit.model.grid is None or stages_of(candidate.start) & SENSOR:
        return False
    return candidate.share > UNRESOLVED * varying_share(fit, candidate.start)


def varying_share(fit: JointFit, applied: AppliedEffect) -> float:
    """Return the part of an effect's change of the light that differs between frames in units of the spot, or lies
    beyond the nodes of the free shape; by squares in units of the peak, weighted with the peak as photons count."""
    model, pixels = fit.model, fit.pixels
    frames = np.unique(np.linspace(0, len(model.spots.x) - 1, MOST_COMPARED).astype(int))
    spots, some = model.spots.select(frames), pixels.select(frames)
    places = np.linspace(-FARTHEST, FARTHEST, PLACES)
    sigma = np.exp(spots.log_sigma)[:, None]
    x, y = spots.x[:, None] + sigma * places, spots.y[:, None] + sigma * places
    inside_x = (x > some.x[:, 0].min(axis=1, keepdims=True)) & (x < some.x[:, 0].max(axis=1, keepdims=True))
    inside_y = (y > some.y[:, :, 0].min(axis=1, keepdims=True)) & (y < some.y[:, :, 0].max(axis=1, keepdims=True))
    grid = replace(some, x=x[:, None, :], y=y[:, :, None], row_share=np.ones((len(frames), PLACES, 1)))
    conditions = conditions_of(model.design.select(frames), spots, grid)
    with_effect = replace(model.forward, effects=(*model.forward.effects, applied))
    change = (with_effect.light(conditions).total - model.forward.light(conditions).total) / conditions.peak_dn
    weight = conditions.peak_dn * inside_x[:, None, :] * inside_y[:, :, None]
    mean = np.sum(weight * change, axis=0) / np.maximum(np.sum(weight, axis=0), 1e-300)
    mean[np.hypot(places[:, None], places) > HALF_WIDTH] = 0.0
    return float(np.sum(weight * (change - mean) ** 2) / max(np.sum(weight * change**2), 1e-300))


def change_by(model: JointModel, start: AppliedEffect, at: Evaluation) -> Column:
    """Return the change of mean and variance that an effect makes on top of a model."""
    forward = replace(model.forward, effects=(*model.forward.effects, start))
    return change_of_moments(forward, at, has_same_light=stages_of(start) <= SENSOR)
