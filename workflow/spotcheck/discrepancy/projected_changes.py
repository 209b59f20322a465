"""Changes that effects make to the readings, projected off spots, sensor, fitted effects and a free light shape."""

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
from spotcheck.discrepancy.evidence import SECTORS, divide_spot
from spotcheck.discrepancy.joint_fit import JointFit, JointModel
from spotcheck.discrepancy.normal_equations import solve_positive
from spotcheck.discrepancy.shape_sums import ShapeSums
from spotcheck.model.effect import AppliedEffect


@dataclass(frozen=True)
class Projection:
    """Changes by T trials beside the nuisance parameters."""

    information: np.ndarray  # of each change beside them [trial]
    alone: np.ndarray  # without them [trial]
    absorbed: np.ndarray  # of each change, the part that spots, sensor and effects take [unknown, trial]
    of_shape: np.ndarray | None  # the part that a free shape takes [coefficient, trial]; None beside the declared one
    of_rest: np.ndarray  # the part that the effect at no strength takes [trial]


def change_by_strength(model: JointModel, applied: AppliedEffect, at: Evaluation) -> tuple[Column, Column | None]:
    """Return the change by the strength of an effect, and that by the rest of it.

    An effect with special cases, such as a slope on a level, acts also where its strength vanishes: a nuisance.
    """
    change = change_at(model, applied, at)
    if not applied.effect.special_cases:
        return change, None
    rest = change_at(model, applied.with_value(applied.effect.parameters[0].name, applied.effect.vanishes_at), at)
    return (change[0] - rest[0], change[1] - rest[1]), rest


def change_at(model: JointModel, applied: AppliedEffect, at: Evaluation) -> Column:
    """Return the change of mean and variance by an effect; readings are linear in small changes of the light."""
    if stages_of(applied) & SENSOR:
        return change_by(model, applied, at)
    forward = replace(model.forward, effects=(*model.forward.effects, applied))
    change = forward.light(at.conditions).total - at.light.total
    return at.moments.mean_slope * change, at.moments.variance_slope * change


def project_trials(fit: JointFit, trials: Sequence[AppliedEffect]) -> Projection:
    """Return the changes by trials beside the nuisance parameters of a fit."""
    model, equations, count = fit.model, fit.equations, len(trials)
    with_rest = [k for k, applied in enumerate(trials) if applied.effect.special_cases]

    def of_batch(part: slice) -> tuple[np.ndarray, ...]:
        at = evaluate(model, fit.pixels, part)
        sums, between = ChangeSums(fit, at, part, count + len(with_rest)), np.zeros(len(with_rest))
        for k, applied in enumerate(trials):
            change, rest = change_by_strength(model, applied, at)
            sums.add(k, change)
            if rest is not None:
                j = with_rest.index(k)
                between[j] = at.information_of(change, rest)
                sums.add(count + j, rest)
        return sums.cross, sums.alone, between, sums.of_shape

    cross, alone, between, shape_products = sum_batches(of_batch, fit.pixels)
    half = np.zeros((0, len(alone)))
    if equations.shape is not None:
        half = equations.shape.factor.half_solve(shape_products)
        cross = cross - equations.shape.cross.T @ half
    absorbed = solve_positive(equations.information, cross)
    information = alone - np.sum(half**2, axis=0) - np.sum(cross * absorbed, axis=0)
    of_rest = np.zeros(count)
    if with_rest:
        k, j = np.array(with_rest), count + np.arange(len(with_rest))
        between = between - np.sum(half[:, k] * half[:, j], axis=0) - np.sum(cross[:, k] * absorbed[:, j], axis=0)
        of_rest[k] = np.where(
            information[j] > SEPARABLE_SHARE * alone[j], between / np.maximum(information[j], 1e-300), 0
        )
        information[k] -= of_rest[k] * between
        absorbed[:, k] -= of_rest[k] * absorbed[:, j]
        half[:, k] -= of_rest[k] * half[:, j]
    of_shape = None
    if equations.shape is not None:
        shape = equations.shape
        of_shape = shape.factor.back_solve(half[:, :count] - shape.cross @ absorbed[:, :count])
    return Projection(information[:count], alone[:count], absorbed[:, :count], of_shape, of_rest)


def sum_trials(fit: JointFit, trials: Sequence[AppliedEffect], by: Projection) -> tuple[np.ndarray, np.ndarray]:
    """Return score and information of projected changes [trial, frame, place], with 16 sectors and rings as places."""
    model = fit.model

    def of_batch(part: slice) -> np.ndarray:
        at = evaluate(model, fit.pixels, part)
        fitted = differentiate_readings(model, at)
        light = None if by.of_shape is None else ShapeSums(model, at).values(by.of_shape)
        sector, ring = divide_spot(at)
        number = np.arange(len(at.weight))[:, None, None]
        label = np.broadcast_to(sector + SECTORS * (ring + 2 * number), at.weight.shape).ravel()
        out = np.zeros((2, len(trials), len(at.weight), 2 * SECTORS))
        for k, applied in enumerate(trials):
            change, rest = change_by_strength(model, applied, at)
            others, absorbed = fitted, by.absorbed[:, k]
            if rest is not None:
                others, absorbed = [*fitted, rest], np.append(absorbed, by.of_rest[k])
            change = subtract_absorbed(at, part, change, absorbed, others, None if light is None else light[k])
            for j, values in enumerate((at.score_per_pixel(change), at.information_per_pixel(change))):
                out[j, k] = np.bincount(label, values.ravel(), out[j, k].size).reshape(out[j, k].shape)
        return out

    score, information = np.concatenate(map_batches(of_batch, fit.pixels), axis=2)
    return score, information
