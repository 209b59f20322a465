"""Changes that effects make to the readings, projected off all nuisance parameters of a fit.

A change is the pair of changes of mean [DN] and variance [DN²] of the readings at each pixel, each [frame, h, w]. The
nuisance parameters are the unknowns of the fit: the spot parameters of each frame (ln peak, ln σ, x, y), the fitted
parameters of sensor and effects, and the coefficients of a free light shape. A column is the pair of derivatives of
mean and variance by one of them. A trial is an effect with a strength, which is not in the model.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.evaluation import (
    RINGS,
    SECTORS,
    SENSOR,
    Column,
    Evaluation,
    change_of_moments,
    differentiate_readings,
    divide_spot,
    evaluate,
    map_batches,
    stages_of,
    sum_batches,
)
from spotcheck.discrepancy.frames import SPOT_PARAMETERS
from spotcheck.discrepancy.joint_fit import JointFit, JointModel
from spotcheck.discrepancy.normal_equations import ShapePart, solve_positive
from spotcheck.discrepancy.shape_sums import ShapeSums
from spotcheck.model.effect import AppliedEffect

# Least part of a change's Fisher information that nuisance parameters must leave; below, they can mimic the change.
SEPARABLE_SHARE = 1e-5


@dataclass(frozen=True)
class Absorbed:
    """Steps of the unknowns of a fit that reproduce each of some changes best."""

    steps: np.ndarray  # steps of the spot parameters, then of the fitted parameters [unknown, change]
    coefficients: np.ndarray | None  # steps of a free shape's coefficients [coefficient, change]; None without a shape

    def subtract_from(
        self, changes: Iterable[Column], model: JointModel, evaluation: Evaluation, batch: slice, fitted: list[Column]
    ) -> Iterator[Column]:
        """Yield each change less what the unknowns absorb of it, at the pixels of a batch.

        The evaluation has the derivatives by spot parameters. `fitted` are the columns of the fitted parameters.
        """
        shape_light = None if self.coefficients is None else ShapeSums(model, evaluation).values(self.coefficients)
        moments, spots = evaluation.moments, slice(SPOT_PARAMETERS * batch.start, SPOT_PARAMETERS * batch.stop)
        for k, (mean, variance) in enumerate(changes):
            spot_steps = self.steps[spots, k].reshape(-1, SPOT_PARAMETERS)
            light = np.einsum("fa,afhw->fhw", spot_steps, evaluation.slopes, optimize=True)
            light = light if shape_light is None else light + shape_light[k]
            mean, variance = mean - moments.mean_slope * light, variance - moments.variance_slope * light
            for step, column in zip(self.steps[len(self.steps) - len(fitted) :, k], fitted, strict=True):
                if step:
                    mean, variance = mean - step * column[0], variance - step * column[1]
            yield mean, variance


@dataclass(frozen=True)
class Projection:
    """Score tests of the amplitudes of changes, after projection on the nuisance parameters."""

    score: np.ndarray  # derivative of ln L by each amplitude [change]
    information: np.ndarray  # Fisher information on each amplitude [change]
    alone: np.ndarray  # Fisher information with the nuisance parameters fixed [change]
    shared: np.ndarray  # information between a change and the one before it, where it was asked for; else 0 [change]
    steps: np.ndarray  # as in `Absorbed`
    # L⁻¹ times the information between the coefficients of a free shape and each change [coefficient, change]; L L' is
    # the information of the coefficients.
    half_shape: np.ndarray
    shape: ShapePart | None  # elimination of the shape; None without a free shape
    # Multiple of its special case that is subtracted from each trial, see `project_trials` [trial].
    of_special_case: np.ndarray | None = None

    def select(self, changes: Sequence[int] | np.ndarray) -> "Projection":
        """Return the changes at some positions."""
        names = ("score", "information", "alone", "shared", "steps", "half_shape")
        return replace(self, **{name: getattr(self, name)[..., changes] for name in names})

    def absorbed(self) -> Absorbed:
        """Return what is absorbed of the changes."""
        shape = self.shape
        return Absorbed(self.steps, None if shape is None else shape.solve_coefficients(self.half_shape, self.steps))


def project_changes(
    fit: JointFit,
    changes_of: Callable[[Evaluation], Iterable[Column]],
    count: int,
    with_previous: Sequence[int] = (),
) -> Projection:
    """Project changes on the nuisance parameters of a fit, and return their score tests.

    Parameters
    ----------
    fit : JointFit
        Fit without the changes.
    changes_of : callable
        Returns the changes of the readings at the pixels of an evaluation.
    count : int
        Number of changes.
    with_previous : sequence of int
        Positions of changes whose information with the change before them is needed (`Projection.shared`).
    """
    model, equations, shape = fit.model, fit.equations, fit.equations.shape
    coefficients = 0 if model.grid is None else model.grid.nodes**2

    def sum_batch(batch: slice) -> tuple[np.ndarray, ...]:
        """Return score, information, and information with the previous change [change], summed over a batch of frames.

        Then cross information of unknowns [unknown, change] and of the shape's coefficients [coefficient, change].
        """
        evaluation = evaluate(model, fit.pixels, batch)
        fitted = differentiate_readings(model, evaluation)
        shape_sums = ShapeSums(model, evaluation) if coefficients else None
        spots = slice(SPOT_PARAMETERS * batch.start, SPOT_PARAMETERS * batch.stop)
        score, alone, shared = np.zeros((3, count))
        cross, cross_shape = np.zeros((equations.size, count)), np.zeros((coefficients, count))
        previous = None
        for k, change in enumerate(changes_of(evaluation)):
            score[k], alone[k] = evaluation.score(change), evaluation.information_of(change, change)
            if previous is not None and k in with_previous:
                shared[k] = evaluation.information_of(previous, change)
            previous = change
            # Σ equivalent × derivative of the light by an unknown is the information between unknown and change.
            equivalent = evaluation.light_equivalent(change)
            cross[spots, k] = np.einsum("afhw,fhw->fa", evaluation.slopes, equivalent).ravel()
            cross[equations.size - len(fitted) :, k] = [evaluation.information_of(change, column) for column in fitted]
            if shape_sums is not None:
                cross_shape[:, k] = shape_sums.products(equivalent[None])[:, 0]
        return score, alone, shared, cross, cross_shape

    score, alone, shared, cross, cross_shape = sum_batches(sum_batch, fit.pixels)
    half_shape = cross_shape if shape is None else shape.factor.half_solve(cross_shape)
    if shape is not None:
        # Eliminate the coefficients of the free shape; `equations` are without them already.
        cross = cross - shape.multiply_transposed(half_shape)
        score = score - half_shape.T @ shape.score
    steps = solve_positive(equations.information, cross)
    score = score - steps.T @ equations.gradient
    information = alone - np.sum(half_shape**2, axis=0) - np.sum(cross * steps, axis=0)
    j = np.array(with_previous, int)
    shared[j] -= np.sum(half_shape[:, j - 1] * half_shape[:, j], axis=0)
    shared[j] -= np.sum(cross[:, j - 1] * steps[:, j], axis=0)
    return Projection(score, information, alone, shared, steps, half_shape, shape)


def change_by(model: JointModel, start: AppliedEffect, evaluation: Evaluation) -> Column:
    """Return the change of mean [DN] and variance [DN²] of the readings if an effect is added to a model [frame, h, w].

    The evaluation is that of the model.
    """
    forward = replace(model.forward, effects=(*model.forward.effects, start))
    return change_of_moments(forward, evaluation, has_same_light=stages_of(start) <= SENSOR)


# Trials of strengths


def change_at(model: JointModel, applied: AppliedEffect, evaluation: Evaluation) -> Column:
    """Return the change of mean and variance by an effect of finite strength.

    Changes of the light are small: mean and variance follow them linearly. Effects of the sensor are evaluated in full.
    """
    if stages_of(applied) & SENSOR:
        return change_by(model, applied, evaluation)
    forward = replace(model.forward, effects=(*model.forward.effects, applied))
    change = forward.light(evaluation.conditions).total - evaluation.light.total
    return evaluation.moments.mean_slope * change, evaluation.moments.variance_slope * change


def change_by_strength(model: JointModel, applied: AppliedEffect, evaluation: Evaluation) -> list[Column]:
    """Return the change by the strength of an effect, and the change by its special case if it has one.

    An effect may have a simpler effect as a special case: a pedestal with a slope has the even pedestal. The special
    case is what remains of the effect where its strength (the slope) vanishes; it is a nuisance.
    """
    change = change_at(model, applied, evaluation)
    if not applied.effect.special_cases:
        return [change]
    strength = applied.effect.parameters[0].name
    special_change = change_at(model, applied.with_value(strength, applied.effect.vanishes_at), evaluation)
    return [(change[0] - special_change[0], change[1] - special_change[1]), special_change]


def project_trials(fit: JointFit, trials: Sequence[AppliedEffect]) -> Projection:
    """Return the changes by trials, projected off the nuisance parameters of a fit at its pixels.

    Special cases (`change_by_strength`) are nuisance parameters as well.
    """
    has_special_case = np.array([bool(applied.effect.special_cases) for applied in trials], bool)
    # Position of each trial among the changes, and of each special case, which is next to its trial.
    position = np.arange(len(trials)) + np.cumsum(has_special_case) - has_special_case
    trial = position[has_special_case]
    special = trial + 1

    def changes_of(evaluation: Evaluation) -> Iterator[Column]:
        """Yield the changes by trials and special cases."""
        for applied in trials:
            yield from change_by_strength(fit.model, applied, evaluation)

    both = project_changes(fit, changes_of, len(trials) + len(special), list(special))
    # Each change is projected off its special case, unless the other nuisance parameters can mimic this case.
    is_separable = both.information[special] > SEPARABLE_SHARE * both.alone[special]
    multiple = np.where(is_separable, both.shared[special] / np.maximum(both.information[special], 1e-300), 0)
    both.information[trial] -= multiple * both.shared[special]
    for absorbed in (both.steps, both.half_shape):
        absorbed[:, trial] -= multiple * absorbed[:, special]
    of_special_case = np.zeros(len(trials))
    of_special_case[has_special_case] = multiple
    return replace(both.select(position), of_special_case=of_special_case)


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
    model, absorbed, multiples = fit.model, projection.absorbed(), projection.of_special_case
    assert multiples is not None

    def changes_of(evaluation: Evaluation) -> Iterator[Column]:
        """Yield the change by each trial, less its multiple of its special case."""
        for applied, multiple in zip(trials, multiples, strict=True):
            (mean, variance), *special_case = change_by_strength(model, applied, evaluation)
            for special_mean, special_variance in special_case:
                mean, variance = mean - multiple * special_mean, variance - multiple * special_variance
            yield mean, variance

    def sum_batch(batch: slice) -> np.ndarray:
        """Return score and information [2, trial, frame, place] of a batch of frames."""
        evaluation = evaluate(model, fit.pixels, batch)
        sector, ring = divide_spot(evaluation.conditions)
        shape = evaluation.weight.shape
        frame = np.arange(shape[0])[:, None, None]
        label = np.broadcast_to(sector + SECTORS * (ring + RINGS * frame), shape).ravel()
        sums = np.zeros((2, len(trials), shape[0], RINGS * SECTORS))
        fitted = differentiate_readings(model, evaluation)
        changes = absorbed.subtract_from(changes_of(evaluation), model, evaluation, batch, fitted)
        for k, change in enumerate(changes):
            for j, values in enumerate((evaluation.score_per_pixel(change), evaluation.information_per_pixel(change))):
                sums[j, k] = np.bincount(label, values.ravel(), sums[j, k].size).reshape(sums[j, k].shape)
        return sums

    score, information = np.concatenate(map_batches(sum_batch, fit.pixels), axis=2)
    return score, information
