"""The model at the pixels of frames, and derivatives of mean and variance of the readings.

A column is the pair of derivatives of mean and variance (dm, dv) of the readings by one unknown. Two columns have the
Fisher information Σ [dm₁ dm₂/v + dv₁ dv₂/(2 v²)], and a column has the score Σ [dm r/v + dv (r²/v − 1)/(2 v)] with the
residual r = y − m.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from spotcheck.discrepancy.frames import Pixels, conditions_of
from spotcheck.model.conditions import FrameConditions
from spotcheck.model.effect import AppliedEffect, RandomStep, Step
from spotcheck.model.forward import SENSOR_STAGES, TABULATED, ForwardModel
from spotcheck.model.light import Light
from spotcheck.model.stage import Stage
from spotcheck.sensor import ROUNDING_VARIANCE, ReadingDistribution, ReadingMoments

if TYPE_CHECKING:
    from spotcheck.discrepancy.joint_fit import FreeParameter, JointModel

# Spot parameters of a frame: ln peak, ln σ, x, y. They are the first unknowns of a fit, frame after frame.
SPOT_PARAMETERS = 4
# Pixels of the frames that are evaluated together: their arrays stay in the cache of a core.
BATCH_PIXELS = 100_000
# Steps of forward differences: ln σ [1] and centre [σ]; other parameters in terms of their scale. The score of a step h
# is that at h/2, which must stay far below a standard error.
SPOT_STEP, PARAMETER_STEP = 1e-6, 1e-5
# Scale of a parameter near 0 in terms of its range.
LEAST_SCALE = 1e-3
# Smallest variance [DN²] of a reading in the likelihood: one reading in 60 is off by 1. It does not depend on the read
# noise, which would be fitted to it. Exponent with which the floor fades.
LEAST_VARIANCE, FLOOR_EXPONENT = 0.2 * ROUNDING_VARIANCE, 12
# Cores that evaluate batches.
THREADS = min(os.cpu_count() or 1, 2)
# Stages whose effects change readings other than through the light.
SENSOR = set(SENSOR_STAGES) - {Stage.PIXEL_GAIN}

Column = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Evaluation:
    """The model at the pixels of some frames; arrays [frame, h, w], 0 in weight where a pixel is not used."""

    conditions: FrameConditions  # of the frames
    light: Light  # light of the frames [DN]
    distribution: ReadingDistribution  # of a reading given its light
    moments: ReadingMoments  # mean [DN] and variance [DN²] of readings and their slopes by the light
    residual: np.ndarray  # reading less mean [DN]
    weight: np.ndarray  # 1/variance [1/DN²]
    variance_score: np.ndarray  # derivative of ln L by the variance [1/DN²]
    field_share: np.ndarray  # part of the variance that a granular field has
    slopes: np.ndarray  # derivatives of the light by ln peak, ln σ, x, y [parameter, frame, h, w]; maybe left out

    @property
    def light_score(self) -> np.ndarray:
        """Derivative of ln L by the light of each pixel [1/DN]."""
        moments = self.moments
        return moments.mean_slope * self.residual * self.weight + moments.variance_slope * self.variance_score

    @property
    def light_information(self) -> np.ndarray:
        """Fisher information of each reading on its light [1/DN²]."""
        moments = self.moments
        return moments.mean_slope**2 * self.weight + (moments.variance_slope * self.weight) ** 2 / 2

    def score(self, column: Column) -> float:
        """Return the score of a column."""
        return float(np.sum(self.score_per_pixel(column)))

    def information_of(self, first: Column, second: Column) -> float:
        """Return the Fisher information between two columns."""
        means, variances = first[0] * second[0], first[1] * second[1]
        return float(np.sum(means * self.weight + variances * self.weight**2 / 2))

    def information_per_pixel(self, column: Column) -> np.ndarray:
        """Return the Fisher information of each reading on the unknown of a column."""
        return column[0] ** 2 * self.weight + (column[1] * self.weight) ** 2 / 2

    def score_per_pixel(self, column: Column) -> np.ndarray:
        """Return the score of each reading for a column."""
        return column[0] * self.residual * self.weight + column[1] * self.variance_score

    def light_equivalent(self, column: Column) -> np.ndarray:
        """Return what, times a change of the light, is the information between a column and that change."""
        moments, weight = self.moments, self.weight
        return moments.mean_slope * column[0] * weight + moments.variance_slope * column[1] * weight**2 / 2


def subtract_absorbed(
    at: Evaluation,
    part: slice,
    column: Column,
    absorbed: np.ndarray,
    others: Sequence[Column],
    of_shape: np.ndarray | None,
) -> Column:
    """Return a column less what nuisance parameters take of it.

    Parameters
    ----------
    at : Evaluation
        Model at the pixels of some frames.
    part : slice
        The frames.
    column : pair of arrays [frame, h, w]
        Derivatives of mean and variance by an unknown, or changes of them.
    absorbed : array [unknown]
        Share of each unknown: ln peak, ln σ, x, y of frame after frame, then those of `others`.
    others : sequence of columns
        Columns of the unknowns behind the spots.
    of_shape : array [frame, h, w] or None
        What a free shape takes [DN of light]; None beside the declared one.
    """
    of_spots = absorbed[4 * part.start : 4 * part.stop].reshape(-1, 4)
    light = np.einsum("fa,afhw->fhw", of_spots, at.slopes, optimize=True)
    light = light if of_shape is None else light + of_shape
    mean, variance = column
    mean, variance = mean - at.moments.mean_slope * light, variance - at.moments.variance_slope * light
    for share, (other_mean, other_variance) in zip(absorbed[len(absorbed) - len(others) :], others, strict=True):
        if share:
            mean, variance = mean - share * other_mean, variance - share * other_variance
    return mean, variance


def batches(pixels: Pixels) -> Iterator[slice]:
    """Yield parts of the frames whose pixels are evaluated together."""
    frames, rows, columns = pixels.readings.shape
    size = max(BATCH_PIXELS // (rows * columns), 1)
    for start in range(0, frames, size):
        yield slice(start, min(start + size, frames))


def map_batches(function: Callable[[slice], Any], pixels: Pixels) -> list[Any]:
    """Return the results of a function of each batch of frames."""
    return list(_results_of_batches(function, pixels))


def _results_of_batches(function: Callable[[slice], Any], pixels: Pixels) -> Iterator[Any]:
    """Yield the results of a function of each batch of frames, computed in threads."""
    parts = list(batches(pixels))
    if len(parts) == 1 or THREADS == 1:
        yield from map(function, parts)
        return
    with ThreadPoolExecutor(THREADS) as pool:
        yield from pool.map(function, parts)


def sum_batches(function: Callable[[slice], tuple[Any, ...]], pixels: Pixels) -> tuple[Any, ...]:
    """Return the sums over batches of frames of the numbers and arrays that a function returns."""
    results = _results_of_batches(function, pixels)
    total = list(next(results))
    for parts in results:
        for k, part in enumerate(parts):
            total[k] += part
    return tuple(total)


def evaluate(model: JointModel, pixels: Pixels, part: slice, with_slopes: bool = True) -> Evaluation:
    """Return the model at the pixels of some frames."""
    spots, design, selected = model.spots.select(part), model.design.select(part), pixels.select(part)
    conditions = conditions_of(design, spots, selected)
    forward = model.forward
    light = forward.light(conditions)
    distribution, moments = _moments_of(forward, conditions, light)
    variance = moments.variance + selected.extra_variance
    used = selected.is_used
    residual = np.where(used, selected.readings - moments.mean, 0.0)
    weight = np.where(used, 1 / variance, 0.0)
    variance_score = (residual**2 * weight - used) * weight / 2
    slopes = _spot_slopes(forward, conditions, light.spot) if with_slopes else np.zeros((0, *used.shape))
    return Evaluation(conditions, light, distribution, moments, residual, weight, variance_score, selected.field_share,
                      slopes)  # fmt: skip


def _moments_of(
    forward: ForwardModel, conditions: FrameConditions, light: Light
) -> tuple[ReadingDistribution, ReadingMoments]:
    """Return the distribution of readings given their light, and their moments.

    The variance v stays above its floor f as (vⁿ + fⁿ)^(1/n): smoothly, since fits stall at a kink. Moments are
    interpolated between the two values of a rounded parameter next to it, so that −2 ln L has a slope in it.
    """
    parts = []
    for weight, other in _rounded_neighbours(forward):
        inputs = other.sensor_input(conditions, light=light)
        parts.append((weight, other.moments(inputs)))
    moments = parts[0][1]
    if len(parts) > 1:
        (low, below), (high, above) = parts
        mixed = [low * first + high * second for first, second in zip(below, above, strict=True)]
        mixed[1] = mixed[1] + low * high * (above.mean - below.mean) ** 2
        moments = ReadingMoments(*mixed)
    n = FLOOR_EXPONENT
    variance = LEAST_VARIANCE * ((moments.variance / LEAST_VARIANCE) ** n + 1) ** (1 / n)
    slope = moments.variance_slope * (moments.variance / variance) ** (n - 1)
    moments = moments._replace(variance=variance, variance_slope=slope)
    return inputs.distribution, moments


def _rounded_neighbours(forward: ForwardModel) -> list[tuple[float, ForwardModel]]:
    """Return models with the values of a rounded parameter below and above it, with weights; or the model alone."""
    for applied in forward.effects:
        name = rounded_parameter(applied)
        if name:
            reading = forward.sensor.black_level_dn + applied.parameters[name]
            models = []
            for whole in (np.floor(reading), np.floor(reading) + 1):
                moved = applied.with_value(name, float(whole - forward.sensor.black_level_dn))
                effects = tuple(moved if other is applied else other for other in forward.effects)
                models.append((float(1 - abs(reading - whole)), replace(forward, effects=effects)))
            return models
    return [(1.0, forward)]


def rounded_parameter(applied: AppliedEffect) -> str:
    """Return the parameter of an effect that readings follow in whole steps only; "" if there is none."""
    steps = applied.effect.variants[applied.variant]
    return next((step.rounded for step in steps if isinstance(step, Step) and step.rounded), "")


def _spot_slopes(forward: ForwardModel, conditions: FrameConditions, spot: np.ndarray) -> np.ndarray:
    """Return the derivatives of the light by ln peak, ln σ, x and y [parameter, frame, h, w]."""
    step = SPOT_STEP * conditions.sigma_px
    moved = (
        replace(conditions, sigma_px=conditions.sigma_px * (1 + SPOT_STEP)),
        replace(conditions, x0=conditions.x0 + step),
        replace(conditions, y0=conditions.y0 + step),
    )
    sizes = (SPOT_STEP, step, step)
    slopes = [(forward.light(other).spot - spot) / size for other, size in zip(moved, sizes, strict=True)]
    return np.stack([spot, *slopes])


def columns_of(model: JointModel, at: Evaluation) -> list[Column]:
    """Return the column of each fitted parameter of sensor and effects."""
    return [_column(model, parameter, at) for parameter in model.free]


def _column(model: JointModel, parameter: FreeParameter, at: Evaluation) -> Column:
    value, step = model.value_of(parameter), difference_step(model, parameter)
    moved = model.with_value(parameter, value + step).forward
    stages = stages_of(model.effect_named(parameter.effect)) if parameter.effect else {Stage.READ_NOISE}
    if not stages & SENSOR:
        slope = (moved.light(at.conditions).total - at.light.total) / step
        return at.moments.mean_slope * slope, at.moments.variance_slope * slope
    mean, variance = change_of_moments(moved, at, has_same_light=stages <= SENSOR)
    return mean / step, variance / step


def change_of_moments(forward: ForwardModel, at: Evaluation, has_same_light: bool) -> Column:
    """Return mean and variance of another model less those of an evaluation."""
    light = at.light if has_same_light else forward.light(at.conditions)
    _, moments = _moments_of(forward, at.conditions, light)
    return moments.mean - at.moments.mean, moments.variance - at.moments.variance


def stages_of(applied: AppliedEffect) -> set[Stage]:
    """Return the stages at which an effect acts; granular light that pixels draw acts on tables, as the well does."""
    steps = applied.effect.variants[applied.variant]
    return {Stage.WELL if isinstance(step, RandomStep) and step.stage in TABULATED else step.stage for step in steps}


def difference_step(model: JointModel, parameter: FreeParameter) -> float:
    """Return the step of forward differences in a parameter; it points inwards at a bound."""
    value = model.value_of(parameter)
    width = parameter.high - parameter.low
    step = PARAMETER_STEP * max(abs(value), LEAST_SCALE * width if np.isfinite(width) else 1.0)
    return -step if value + step > parameter.high else step
