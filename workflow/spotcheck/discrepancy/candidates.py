"""Score tests of effects: estimate how much each starting point of each effect would lower −2 ln L, without a refit.

A start is an effect with the parameter values from which a fit would begin; its first parameter is its strength. Its
change is what it adds to the mean [DN] and variance [DN²] of the readings, a pair of arrays. A column is the pair of
their derivatives by an unknown. A `JointFit` has the fitted `model`, its `pixels` and the normal `equations`. Nuisance
parameters are all unknowns of this fit: the four spot parameters of each frame (ln peak, ln σ, x, y), the fitted
parameters of sensor and effects, and the coefficients of a free shape. A free shape is a light shape whose values at
nodes are fitted, in place of the declared shape of the instrument. A candidate is a start with its score test. Granular
light is a random field in the light that neighbouring pixels share.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from spotcheck.discrepancy.evaluation import (
    SENSOR,
    Column,
    Evaluation,
    change_of_moments,
    differentiate_readings,
    evaluate,
    stages_of,
    subtract_absorbed,
    sum_batches,
)
from spotcheck.discrepancy.frames import SPOT_PARAMETERS, conditions_of
from spotcheck.discrepancy.joint_fit import JointFit, JointModel
from spotcheck.discrepancy.normal_equations import solve_positive
from spotcheck.discrepancy.shape_grid import HALF_WIDTH
from spotcheck.discrepancy.shape_sums import ShapeSums
from spotcheck.discrepancy.site_draws import list_site_variants, start_draws
from spotcheck.model.effect import AppliedEffect, Effect, EffectScales, RandomStep
from spotcheck.model.stage import Stage

# Range of the multiple of a start's strength at which a fit begins. It is limited because the score test assumes that
# the change is proportional to the strength. Beside a free shape it is at most 1: the shape must change with it.
SIZES, SIZES_BESIDE_SHAPE = (0.3, 30.0), (0.3, 1.0)
# Least estimated multiple of a start's change for a clip: an effect that vanishes at an infinite strength, since it
# limits readings to a level. The multiple is about 1 if the clip is present.
LEAST_CLIP_SIZE = 0.15
# Least part of a change's Fisher information that nuisance parameters must leave; below, they can mimic the change.
SEPARABLE_SHARE = 1e-5
# A candidate is a shape finer than the nodes of the free shape if the part of its information that nuisance parameters
# leave exceeds the part of its change that differs between frames by this factor.
UNRESOLVED = 5.0
# Leading candidates for which the share of granular light in the variance is measured.
MOST_FIELD_SHARES = 24
# Sampling of a change for `varying_share`: most frames; points along each axis, and the largest distance [σ].
MOST_COMPARED, POINTS, FARTHEST = 16, 61, 7.0
# Smallest denominator of a ratio of sums that may be 0.
TINY = 1e-300
# Stages that change only brightness and width of the spot of a frame, which its spot parameters absorb.
SPOT_STAGES = {Stage.EXPOSURE, Stage.WIDTH, Stage.BRIGHTNESS}


@dataclass(frozen=True)
class Candidate:
    """A starting point of an effect and its score test."""

    start: AppliedEffect  # where a fit of the effect begins
    score: float  # expected drop of −2 ln L beside all nuisance parameters on the tested pixels, less 1 for noise; ≥ 0
    place: int  # position among the screened starts, which orders variants that tie
    share: float  # part of the information on its strength that the nuisance parameters leave, 0 to 1
    # Part of the readings' variance that is due to granular light, averaged with the information on the strength as
    # weight. Candidates behind the first `MOST_FIELD_SHARES` have the average over the information on the light.
    field_share: float
    draws: int = 0  # number of values that the variant draws at the sites, which are fitted as well


def changes_mean_image(effect: Effect) -> bool:
    """Return whether an effect changes the mean image of a single frame in more than its brightness and width.

    Effects all of whose steps draw random numbers do not.
    """
    steps = [step for steps in effect.variants.values() for step in steps]
    is_law = all(step.stage in SPOT_STAGES for step in steps)
    return bool(steps) and not is_law and not all(isinstance(step, RandomStep) for step in steps)


def list_fixed_variants(effect: Effect) -> list[Enum]:
    """Return the variants of an effect that draw no random numbers."""
    variants = effect.variants.items()
    return [variant for variant, steps in variants if not any(isinstance(step, RandomStep) for step in steps)]


def list_starts(
    effects: Sequence[Effect],
    scales: EffectScales,
    variants_of: Callable[[Effect], Sequence[Enum]] = list_fixed_variants,
) -> list[AppliedEffect]:
    """Return the distinct starting points of variants of effects, by default of those that draw no random numbers.

    Values are clipped to the bounds; parameters that a variant does not have are NaN.
    """
    # Keys are texts, since NaN is not equal to itself.
    unique: dict[str, AppliedEffect] = {}
    for effect in effects:
        low, high = effect.bounds(scales).T
        for variant in variants_of(effect):
            has_parameter = [parameter in effect.parameters_of(variant) for parameter in effect.parameters]
            for values in effect.starts(scales):
                clipped = np.clip(np.where(has_parameter, values, np.nan), low, high)
                start = AppliedEffect(effect, variant, tuple(clipped))
                unique.setdefault(repr((effect.name, variant, start.values)), start)
    return list(unique.values())


def screen_candidates(fit: JointFit, starts: Sequence[AppliedEffect]) -> list[Candidate]:
    """Return the candidates of starting points, the most promising first.

    Starts that nuisance parameters can mimic, or whose estimated strength is impossible, are left out.

    Parameters
    ----------
    fit : JointFit
        Present model, fitted to the pixels of the test.
    starts : sequence of AppliedEffect
        Starting points of effects that the model does not contain.

    Notes
    -----
    A start changes the readings. The amplitude of this change, in units of the start, has the score U and the Fisher
    information I, both after projection on the nuisance parameters. Its estimate is U/I; −2 ln L then drops by U²/I.
    """
    changes = project_changes(fit, starts)
    candidates = []
    rows = zip(starts, changes.score, changes.information, changes.alone, strict=True)
    for place, (start, score, information, alone) in enumerate(rows):
        if not (np.isfinite(score) and information > SEPARABLE_SHARE * alone > 0):
            continue
        scaled = scale_start(start, float(score / information), fit.model)
        if scaled is not None:
            drop, share = float(max(score * score / information - 1, 0.0)), float(information / alone)
            candidates.append(Candidate(scaled, drop, place, share, fit.pixels.mean_field_share))
    candidates.sort(key=lambda candidate: -candidate.score)
    if fit.pixels.mean_field_share == 0 or not candidates:
        return candidates
    places = [candidate.place for candidate in candidates[:MOST_FIELD_SHARES]]
    shares = measure_field_shares(fit, [starts[place] for place in places], changes.select(places))
    leading = [replace(c, field_share=float(share)) for c, share in zip(candidates, shares, strict=False)]
    return [*leading, *candidates[len(places) :]]


def screen_drawn_variants(fit: JointFit, effects: Sequence[Effect], scales: EffectScales) -> list[Candidate]:
    """Return the candidates of variants that modulate the light by a draw that is new at each site.

    The draws are estimated first, by start. By noise alone each of them raises the expected drop by about 1, which is
    subtracted. At a single site other variants have such a draw as a parameter.
    """
    sites, candidates = fit.model.design.sites, []
    if sites == 1:
        return []
    for start in list_starts(effects, scales, list_site_variants):
        design = start_draws(fit.model.with_effect(start, scales), fit.pixels).design
        with_draws = replace(fit, model=replace(fit.model, design=design))
        for candidate in screen_candidates(with_draws, [start]):
            candidates.append(replace(candidate, score=max(candidate.score - sites, 0.0), draws=sites))
    return candidates


def scale_start(start: AppliedEffect, size: float, model: JointModel) -> AppliedEffect | None:
    """Return the start with the strength at which its change would be `size` times as large.

    The multiple is limited to `SIZES`, or to `SIZES_BESIDE_SHAPE` if the model has a free shape. A clip stays as it is.
    None for a negative size of an effect that has one sign only, or a clip of at most `LEAST_CLIP_SIZE`.
    """
    effect = start.effect
    strength = effect.parameters[0].name
    value = start.parameters[strength]
    if not np.isfinite(effect.vanishes_at):
        return start if size > LEAST_CLIP_SIZE else None
    if size < 0 and value_is_one_sided(start):
        return None
    limits = SIZES if model.grid is None else SIZES_BESIDE_SHAPE
    size = float(np.sign(size) * np.clip(abs(size), *limits))
    return start.with_value(strength, effect.vanishes_at + size * (value - effect.vanishes_at))


def value_is_one_sided(start: AppliedEffect) -> bool:
    """Return whether the strength of an effect is bounded below by the value at which the effect vanishes."""
    low = start.effect.parameters[0].low
    return not callable(low) and low == start.effect.vanishes_at


class ChangeSums:
    """Fisher information between changes of the readings and the unknowns of a fit, summed over a batch of frames.

    Unknowns are the four spot parameters of each frame, then the fitted parameters of sensor and effects. The
    coefficients of a free shape are kept apart.

    Parameters
    ----------
    fit : JointFit
        Fit that has the unknowns.
    evaluation : Evaluation
        Its model at the pixels of the batch: `slopes` are derivatives of the light by the spot parameters.
    batch : slice
        Frames of the evaluation.
    count : int
        Number of changes.

    Attributes
    ----------
    alone : array [change]
        Information of each change on itself.
    cross : array [unknown, change]
        Information between each unknown and each change.
    of_shape : array [coefficient, change]
        Information between each coefficient of the free shape and each change; no rows without a free shape.
    """

    def __init__(self, fit: JointFit, evaluation: Evaluation, batch: slice, count: int) -> None:
        self._evaluation, self._batch = evaluation, batch
        self._fitted_columns = differentiate_readings(fit.model, evaluation)
        self._shape_sums = None if fit.model.grid is None else ShapeSums(fit.model, evaluation)
        self._spot_unknowns = SPOT_PARAMETERS * fit.equations.frame_count
        self.alone = np.zeros(count)
        self.cross = np.zeros((fit.equations.size, count))
        self.of_shape = np.zeros((0 if self._shape_sums is None else self._shape_sums.nodes**2, count))

    def add(self, k: int, change: Column) -> None:
        """Set the sums of change number k, a pair of changes of mean [DN] and variance [DN²], each [frame, h, w]."""
        evaluation, columns = self._evaluation, self._fitted_columns
        self.alone[k] = evaluation.information_of(change, change)
        # Σ slope × equivalent is the information between a spot parameter and the change.
        equivalent = evaluation.light_equivalent(change)
        batch_spots = slice(SPOT_PARAMETERS * self._batch.start, SPOT_PARAMETERS * self._batch.stop)
        self.cross[batch_spots, k] = np.einsum("afhw,fhw->fa", evaluation.slopes, equivalent).ravel()
        self.cross[self._spot_unknowns :, k] = [evaluation.information_of(change, column) for column in columns]
        if self._shape_sums is not None:
            self.of_shape[:, k] = self._shape_sums.products(equivalent[None])[:, 0]


@dataclass(frozen=True)
class ProjectedChanges:
    """Score tests of the changes by starts, after projection on the nuisance parameters."""

    score: np.ndarray  # derivative of ln L by the amplitude of each change, after projection [start]
    information: np.ndarray  # Fisher information on this amplitude, after projection [start]
    alone: np.ndarray  # Fisher information without nuisance parameters [start]
    # Steps of the spot parameters, and of the fitted parameters of sensor and effects, that reproduce each change best
    # [unknown, start].
    absorbed: np.ndarray
    # L⁻¹ times the information between the coefficients of a free shape and each change [coefficient, start]; L L' is
    # the information of the coefficients. None without a free shape.
    half_shape: np.ndarray | None

    def select(self, starts: Sequence[int]) -> "ProjectedChanges":
        """Return the changes of the starts at some positions."""
        half_shape = None if self.half_shape is None else self.half_shape[:, starts]
        by_start = (self.score[starts], self.information[starts], self.alone[starts], self.absorbed[:, starts])
        return ProjectedChanges(*by_start, half_shape)


def project_changes(fit: JointFit, starts: Sequence[AppliedEffect]) -> ProjectedChanges:
    """Project the changes by starts on the nuisance parameters of a fit, and return their score tests."""
    model, equations = fit.model, fit.equations

    def sum_batch(batch: slice) -> tuple[np.ndarray, ...]:
        """Return cross information, score, information alone and information with the shape, of one batch."""
        evaluation = evaluate(model, fit.pixels, batch)
        sums, score = ChangeSums(fit, evaluation, batch, len(starts)), np.zeros(len(starts))
        for k, start in enumerate(starts):
            change = change_by(model, start, evaluation)
            score[k] = evaluation.score(change)
            sums.add(k, change)
        return sums.cross, score, sums.alone, sums.of_shape

    cross, score, alone, of_shape = sum_batches(sum_batch, fit.pixels)
    information, half_shape = alone.copy(), None
    if equations.shape is not None:
        # Eliminate the coefficients of the free shape; `equations` are without them already.
        half_shape = equations.shape.factor.half_solve(of_shape)
        cross = cross - equations.shape.multiply_transposed(half_shape)
        score = score - half_shape.T @ equations.shape.score
        information -= np.sum(half_shape**2, axis=0)
    absorbed = solve_positive(equations.information, cross)
    score, information = score - absorbed.T @ equations.gradient, information - np.sum(cross * absorbed, axis=0)
    return ProjectedChanges(score, information, alone, absorbed, half_shape)


def measure_field_shares(fit: JointFit, starts: Sequence[AppliedEffect], changes: ProjectedChanges) -> np.ndarray:
    """Return the part of the readings' variance that is due to granular light, as a mean for each start [start].

    The mean over pixels is weighted with the projected Fisher information of the start's change.
    """
    model, equations = fit.model, fit.equations
    # Coefficients of the free shape that reproduce each change best, beside the other unknowns.
    coefficients = None
    if changes.half_shape is not None and equations.shape is not None:
        coefficients = equations.shape.factor.back_solve(
            changes.half_shape - equations.shape.multiply_cross(changes.absorbed)
        )

    def sum_batch(batch: slice) -> tuple[np.ndarray]:
        """Return the sums of field share × information, and of the information [2, start], of one batch."""
        evaluation = evaluate(model, fit.pixels, batch)
        columns = differentiate_readings(model, evaluation)
        light = [None] * len(starts) if coefficients is None else ShapeSums(model, evaluation).values(coefficients)
        sums = np.zeros((2, len(starts)))
        for k, start in enumerate(starts):
            change = change_by(model, start, evaluation)
            change = subtract_absorbed(evaluation, batch, change, changes.absorbed[:, k], columns, light[k])
            information = evaluation.information_per_pixel(change)
            sums[:, k] = np.sum(evaluation.field_share * information), np.sum(information)
        return (sums,)

    ((weighted_share, information),) = sum_batches(sum_batch, fit.pixels)
    return weighted_share / np.maximum(information, TINY)


def is_unresolved_shape(fit: JointFit, candidate: Candidate) -> bool:
    """Return whether a candidate is a shape of the light that is finer than the nodes of the free shape of the fit.

    A free shape absorbs any change that is the same in all frames, in units of peak and σ, if its nodes are close
    enough. The rest is the part that differs between frames. A much larger rest means that the nodes are too coarse.
    """
    # What is drawn anew at each site is no shape.
    if fit.model.grid is None or candidate.draws or stages_of(candidate.start) & SENSOR:
        return False
    return candidate.share > UNRESOLVED * varying_share(fit, candidate.start)


def varying_share(fit: JointFit, applied: AppliedEffect) -> float:
    """Return the part (0 to 1) of an effect's change of the light that no free shape could absorb.

    The change is sampled in units of peak and σ of each frame's spot. A free shape can absorb its mean over frames
    within `HALF_WIDTH`. The part is the squared rest over the squared change. Frames are weighted with their peak, to
    which their information is proportional under photon noise.
    """
    model, pixels = fit.model, fit.pixels
    frames = np.unique(np.linspace(0, len(model.spots.x) - 1, MOST_COMPARED).astype(int))
    spots, compared = model.spots.select(frames), pixels.select(frames)
    points = np.linspace(-FARTHEST, FARTHEST, POINTS)
    sigma = np.exp(spots.log_sigma)[:, None]
    x, y = spots.x[:, None] + sigma * points, spots.y[:, None] + sigma * points
    is_inside_x, is_inside_y = (
        (point > pixel.min(axis=1, keepdims=True)) & (point < pixel.max(axis=1, keepdims=True))
        for point, pixel in ((x, compared.x[:, 0]), (y, compared.y[:, :, 0]))
    )
    # Pixels of made-up crops, which lie at the same points of every spot in units of its σ.
    sampled = replace(compared, x=x[:, None, :], y=y[:, :, None], row_share=np.ones((len(frames), POINTS, 1)))
    conditions = conditions_of(model.design.select(frames), spots, sampled)
    with_effect = replace(model.forward, effects=(*model.forward.effects, applied))
    change = (with_effect.light(conditions).total - model.forward.light(conditions).total) / conditions.peak_dn
    weight = conditions.peak_dn * is_inside_x[:, None, :] * is_inside_y[:, :, None]
    mean = np.sum(weight * change, axis=0) / np.maximum(np.sum(weight, axis=0), TINY)
    mean[np.hypot(points[:, None], points) > HALF_WIDTH] = 0.0
    return float(np.sum(weight * (change - mean) ** 2) / max(np.sum(weight * change**2), TINY))


def change_by(model: JointModel, start: AppliedEffect, evaluation: Evaluation) -> Column:
    """Return the change of mean [DN] and variance [DN²] of the readings if an effect is added to a model [frame, h, w].

    The evaluation is that of the model.
    """
    forward = replace(model.forward, effects=(*model.forward.effects, start))
    return change_of_moments(forward, evaluation, has_same_light=stages_of(start) <= SENSOR)
