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
    map_batches,
    stages_of,
)
from spotcheck.discrepancy.joint_fit import JointFit, JointModel
from spotcheck.discrepancy.normal_equations import solve_positive
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
# Stages that change the spot of a frame as its own parameters do: effects there are laws across frames.
SPOT_STAGES = {Stage.EXPOSURE, Stage.WIDTH, Stage.BRIGHTNESS}


@dataclass(frozen=True)
class Candidate:
    """A starting point of an effect and its score test."""

    start: AppliedEffect  # where a fit of the effect begins
    score: float  # expected drop of −2 ln L on the tested pixels beside all nuisance parameters, less 1 for noise
    place: int  # position among all starting points: variants that tie are taken in this order


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
            candidates.append(Candidate(scaled, float(max(u * u / i - 1, 0.0)), place))
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
        equivalents = []
        for k, start in enumerate(starts):
            column = change_by(model, start, at)
            score[k] = at.score(column)
            alone[k] = at.information_of(column, column)
            equivalents.append(at.light_equivalent(column))
            cross[4 * part.start : 4 * part.stop, k] = np.einsum("afhw,fhw->fa", at.slopes, equivalents[-1]).ravel()
            cross[4 * frames :, k] = [at.information_of(column, other) for other in fitted]
        if model.grid is None:
            return cross, score, alone
        return cross, score, alone, ShapeSums(model, at).products(np.stack(equivalents))

    parts = map_batches(of_batch, fit.pixels)
    cross, score, alone = (sum(part[k] for part in parts) for k in range(3))
    beside = alone.copy()
    if equations.shape is not None:
        half = equations.shape.factor.half_solve(sum(part[3] for part in parts))
        cross = cross - equations.shape.cross.T @ half
        score = score - half.T @ equations.shape.score
        beside -= np.sum(half**2, axis=0)
    absorbed = solve_positive(equations.information, cross)
    return score - absorbed.T @ equations.gradient, beside - np.sum(cross * absorbed, axis=0), alone


def change_by(model: JointModel, start: AppliedEffect, at: Evaluation) -> Column:
    """Return the change of mean and variance that an effect makes on top of a model."""
    forward = replace(model.forward, effects=(*model.forward.effects, start))
    return change_of_moments(forward, at, has_same_light=stages_of(start) <= SENSOR)
