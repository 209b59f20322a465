"""Draws of effects that are new at each site and shape the mean image, such as the phase of stripes.

They are nuisance parameters like the centres of spots: the value of each site maximises the likelihood of its frames.
`Design.draws` holds the estimates.
"""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from spotcheck.discrepancy.evaluation import change_of_moments, evaluate, map_batches
from spotcheck.discrepancy.frames import Pixels
from spotcheck.model.effect import AppliedEffect, Effect, RandomStep, Scope, Step
from spotcheck.model.stage import Stage

if TYPE_CHECKING:
    from spotcheck.discrepancy.joint_fit import JointModel

# Nodes of the quadrature of a draw that are tried as starts, and steps of Fisher scoring from the best one.
STARTS, FIRST_STEPS = 8, 2
# Step of the forward difference by a draw, as a part of the distance of two starts.
DIFFERENCE = 1e-4
# Least information on a draw, beside which it stays where it is.
LEAST_INFORMATION = 1e-300


def list_site_variants(effect: Effect) -> list[Enum]:
    """Return the variants of an effect whose only step modulates the light by a draw that is new at each site."""

    def is_drawn(step: Step | RandomStep) -> bool:
        """Return whether a step modulates the light by such a draw."""
        return isinstance(step, RandomStep) and step.scope is Scope.SITE and step.stage is Stage.MODULATION

    return [variant for variant, steps in effect.variants.items() if len(steps) == 1 and is_drawn(steps[0])]


def is_drawn_at_sites(applied: AppliedEffect) -> bool:
    """Return whether an effect modulates the light by a draw that is new at each site."""
    return applied.variant in list_site_variants(applied.effect)


def start_draws(model: JointModel, pixels: Pixels) -> JointModel:
    """Return the model with the draws of its effects estimated from the best of several starts at each site."""
    for applied in filter(is_drawn_at_sites, model.forward.effects):
        values = _start_values(applied)
        deviances = [_sum_by_site(_with_draws(model, applied, value), pixels)[0] for value in values]
        model = _with_draws(model, applied, values[np.argmin(deviances, axis=0)][_site_numbers(model)])
    for _ in range(FIRST_STEPS):
        model = improve_draws(model, pixels)
    return model


def improve_draws(model: JointModel, pixels: Pixels) -> JointModel:
    """Return the model after one step of Fisher scoring of the draws of its effects at each site."""
    for applied in filter(is_drawn_at_sites, model.forward.effects):
        farthest = _farthest_step(applied)
        _, score, information = _sum_by_site(model, pixels, applied)
        change = np.clip(score / np.maximum(information, LEAST_INFORMATION), -farthest, farthest)
        draws = model.design.draws[applied.effect.name]
        model = _with_draws(model, applied, draws + change[_site_numbers(model)])
    return model


def _with_draws(model: JointModel, applied: AppliedEffect, values: np.ndarray | float) -> JointModel:
    """Return the model with the draws of an effect, a number or one for each frame."""
    draws = np.broadcast_to(values, model.design.site.shape).astype(float)
    return replace(model, design=replace(model.design, draws={**model.design.draws, applied.effect.name: draws}))


def _site_numbers(model: JointModel) -> np.ndarray:
    """Return the number of the site of each frame, from 0 on [frame]."""
    return np.unique(model.design.site, return_inverse=True)[1].ravel()


def _sum_by_site(
    model: JointModel, pixels: Pixels, applied: AppliedEffect | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return −2 ln L of the frames of each site up to a constant, and score and information of the draw of an effect.

    All are [site]; score and information are 0 without an effect.
    """
    difference = DIFFERENCE if applied is None else DIFFERENCE * _farthest_step(applied)

    def sum_frames(batch: slice) -> np.ndarray:
        """Return the three sums over the pixels of each frame of a batch [3, frame]."""
        evaluation = evaluate(model, pixels, batch, with_slopes=False)
        deviance = np.sum(evaluation.residual**2 * evaluation.weight + evaluation.log_variance, axis=(1, 2))
        if applied is None:
            return np.array([deviance, 0 * deviance, 0 * deviance])
        name, conditions = applied.effect.name, evaluation.conditions
        moved = replace(conditions, draws={**conditions.draws, name: conditions.draws[name] + difference})
        change = change_of_moments(model.forward, replace(evaluation, conditions=moved), has_same_light=False)
        score, information = evaluation.score_per_pixel(change), evaluation.information_per_pixel(change)
        sums = (score / difference, information / difference**2)
        return np.array([deviance, *(values.sum(axis=(1, 2)) for values in sums)])

    number = _site_numbers(model)
    deviance, score, information = (
        np.bincount(number, of_frames) for of_frames in np.concatenate(map_batches(sum_frames, pixels), axis=1)
    )
    return deviance, score, information


def _start_values(applied: AppliedEffect) -> np.ndarray:
    """Return the values of a draw from which its estimate starts [start]."""
    (step,) = applied.steps_at(Stage.MODULATION)
    values = step.quadrature()[0]
    return values[:: max(len(values) // STARTS, 1)]


def _farthest_step(applied: AppliedEffect) -> float:
    """Return the largest step of a draw: the distance of two starts."""
    values = _start_values(applied)
    return float(abs(values[1] - values[0]))
