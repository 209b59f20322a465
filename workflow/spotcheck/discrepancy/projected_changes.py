"""Changes that effects make to the readings, projected off all nuisance parameters of a fit.

A change is the pair of changes of mean [DN] and variance [DN²] of the readings at each pixel, each [frame, h, w]. The
nuisance parameters are the spot parameters of each frame (ln peak, ln σ, x, y), the coefficients of a free light shape,
and the fitted parameters of sensor and effects. A trial is an effect with a strength, which is not in the model.
`ChangeSums` has the information of each change (`alone`), and that between changes and the unknowns of the fit: spots
and fitted parameters (`cross`), and coefficients (`of_shape`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.candidates import SEPARABLE_SHARE, ChangeSums, change_by
from spotcheck.discrepancy.evaluation import (
    SENSOR,
    Column,
    Evaluation,
    differentiate_readings,
    evaluate,
    map_batches,
    stages_of,
    subtract_absorbed,
    sum_batches,
)
from spotcheck.discrepancy.evidence import RINGS, SECTORS, divide_spot
from spotcheck.discrepancy.joint_fit import JointFit, JointModel
from spotcheck.discrepancy.normal_equations import solve_positive
from spotcheck.discrepancy.shape_sums import ShapeSums
from spotcheck.model.effect import AppliedEffect


@dataclass(frozen=True)
class Projection:
    """Changes by T trials, projected off the nuisance parameters."""

    information: np.ndarray  # Fisher information on each change with the nuisance parameters free [trial]
    alone: np.ndarray  # Fisher information with the nuisance parameters fixed [trial]
    # Multiples of the derivatives by spots, sensor and fitted effects that are subtracted from a change [unknown,
    # trial].
    absorbed: np.ndarray
    of_shape: np.ndarray | None  # the same for a free shape [coefficient, trial]; None beside the declared shape
    # The same for the special case of a trial, the effect at the strength where it vanishes [trial]; 0 without one.
    of_special_case: np.ndarray


def change_by_strength(
    model: JointModel, applied: AppliedEffect, evaluation: Evaluation
) -> tuple[Column, Column | None]:
    """Return the change by the strength of an effect, and the change by its special case; None without a special case.

    An effect may have a simpler effect as a special case: a pedestal with a slope has the even pedestal. The special
    case is what remains of the effect where its strength (the slope) vanishes; it is a nuisance.
    """
    change = change_at(model, applied, evaluation)
    if not applied.effect.special_cases:
        return change, None
    strength = applied.effect.parameters[0].name
    special_change = change_at(model, applied.with_value(strength, applied.effect.vanishes_at), evaluation)
    return (change[0] - special_change[0], change[1] - special_change[1]), special_change


def change_at(model: JointModel, applied: AppliedEffect, evaluation: Evaluation) -> Column:
    """Return the change of mean and variance by an effect of finite strength.

    Changes of the light are small: mean and variance follow them linearly. Effects of the sensor are evaluated in full.
    """
    if stages_of(applied) & SENSOR:
        return change_by(model, applied, evaluation)
    forward = replace(model.forward, effects=(*model.forward.effects, applied))
    change = forward.light(evaluation.conditions).total - evaluation.light.total
    return evaluation.moments.mean_slope * change, evaluation.moments.variance_slope * change


def project_trials(fit: JointFit, trials: Sequence[AppliedEffect]) -> Projection:
    """Return the changes by trials, projected off the nuisance parameters of a fit at its pixels.

    A trial is an effect at a strength. Special cases (`change_by_strength`) are nuisance parameters as well.
    """
    model, equations, count = fit.model, fit.equations, len(trials)
    with_special_case = [k for k, applied in enumerate(trials) if applied.effect.special_cases]

    def sum_batch(batch: slice) -> tuple[np.ndarray, ...]:
        """Return the sums of a batch of frames; special cases come behind the trials."""
        evaluation = evaluate(model, fit.pixels, batch)
        sums = ChangeSums(fit, evaluation, batch, count + len(with_special_case))
        shared = np.zeros(len(with_special_case))
        for k, applied in enumerate(trials):
            change, special_change = change_by_strength(model, applied, evaluation)
            sums.add(k, change)
            if special_change is not None:
                j = with_special_case.index(k)
                shared[j] = evaluation.information_of(change, special_change)
                sums.add(count + j, special_change)
        return sums.cross, sums.alone, shared, sums.of_shape

    cross, alone, shared, shape_products = sum_batches(sum_batch, fit.pixels)
    # `shared` is the information between each change and its special case. First the coefficients of a free shape are
    # projected off: L L' is their information, and `half` is L⁻¹ times their information with each change.
    shape = equations.shape
    half = np.zeros((0, len(alone)))
    if shape is not None:
        half = shape.factor.half_solve(shape_products)
        cross = cross - shape.multiply_transposed(half)
    absorbed = solve_positive(equations.information, cross)
    information = alone - np.sum(half**2, axis=0) - np.sum(cross * absorbed, axis=0)
    of_special_case = np.zeros(count)
    if with_special_case:
        # Last, each change is projected off its special case, unless the other nuisance parameters can mimic this case.
        k, j = np.array(with_special_case), count + np.arange(len(with_special_case))
        shared = shared - np.sum(half[:, k] * half[:, j], axis=0) - np.sum(cross[:, k] * absorbed[:, j], axis=0)
        is_separable = information[j] > SEPARABLE_SHARE * alone[j]
        of_special_case[k] = np.where(is_separable, shared / np.maximum(information[j], 1e-300), 0)
        information[k] -= of_special_case[k] * shared
        absorbed[:, k] -= of_special_case[k] * absorbed[:, j]
        half[:, k] -= of_special_case[k] * half[:, j]
    of_shape = None
    if shape is not None:
        of_shape = shape.factor.back_solve(half[:, :count] - shape.multiply_cross(absorbed[:, :count]))
    return Projection(information[:count], alone[:count], absorbed[:, :count], of_shape, of_special_case)


def sum_trials(fit: JointFit, trials: Sequence[AppliedEffect], projection: Projection) -> tuple[np.ndarray, np.ndarray]:
    """Return score and Fisher information of the projected changes by trials, divided by places on the spot.

    Parameters
    ----------
    fit : JointFit
        Fit without the trials.
    trials : sequence of AppliedEffect
        Trials.
    projection : Projection
        Result of `project_trials` for them, maybe on other pixels of the same frames.

    Returns
    -------
    score, information : array [trial, frame, place]
        Places are `SECTORS` sectors times `RINGS` rings about the centre of the spot.
    """
    model, of_shape = fit.model, projection.of_shape

    def sum_batch(batch: slice) -> np.ndarray:
        """Return score and information [2, trial, frame, place] of a batch of frames."""
        evaluation = evaluate(model, fit.pixels, batch)
        fitted = differentiate_readings(model, evaluation)
        shape_changes = None if of_shape is None else ShapeSums(model, evaluation).values(of_shape)
        sector, ring = divide_spot(evaluation)
        shape = evaluation.weight.shape
        frame = np.arange(shape[0])[:, None, None]
        label = np.broadcast_to(sector + SECTORS * (ring + RINGS * frame), shape).ravel()
        sums = np.zeros((2, len(trials), shape[0], RINGS * SECTORS))
        for k, applied in enumerate(trials):
            change, special_change = change_by_strength(model, applied, evaluation)
            others, absorbed = fitted, projection.absorbed[:, k]
            if special_change is not None:
                others, absorbed = [*fitted, special_change], np.append(absorbed, projection.of_special_case[k])
            by_shape = None if shape_changes is None else shape_changes[k]
            change = subtract_absorbed(evaluation, batch, change, absorbed, others, by_shape)
            for j, values in enumerate((evaluation.score_per_pixel(change), evaluation.information_per_pixel(change))):
                sums[j, k] = np.bincount(label, values.ravel(), sums[j, k].size).reshape(sums[j, k].shape)
        return sums

    score, information = np.concatenate(map_batches(sum_batch, fit.pixels), axis=2)
    return score, information
