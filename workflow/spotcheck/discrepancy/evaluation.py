"""The model at the pixels of frames, and derivatives of mean and variance of the readings.

A reading y [DN] has the mean m [DN] and the variance v [DN²]. A column is the pair (dm, dv) of their derivatives by one
unknown. Two columns have the Fisher information Σ [dm₁ dm₂/v + dv₁ dv₂/(2 v²)]. A column has the score
Σ [dm r/v + dv (r²/v − 1)/(2 v)] with the residual r = y − m. Sums are over pixels.

Unknowns of a fit are the four spot parameters of each frame, the fitted parameters of sensor and effects
(`JointModel.free`), and the coefficients of a free light shape if the model has one. A `JointModel` has the values of
all unknowns: `forward` (light, sensor, effects) and `spots`, with the conditions of the frames, `design`. Granular
light is a random field in the light, such as speckle, that neighbouring pixels share. A batch is a slice of the frames;
h and w are the rows and columns of the pixels that a fit uses in each frame.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
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
from spotcheck.sensor import ROUNDING_VARIANCE, ReadingMoments

if TYPE_CHECKING:
    from spotcheck.discrepancy.joint_fit import FreeParameter, JointModel

# Pixels of a batch: few enough that its arrays stay in the cache of a core.
BATCH_PIXELS = 100_000
# Steps of forward differences: SPOT_STEP for ln σ [1] and the centre [σ], PARAMETER_STEP for other parameters, relative
# to their value. A forward difference of step h is the derivative at h/2: h must be far below a standard error.
SPOT_STEP, PARAMETER_STEP = 1e-6, 1e-5
# Least value that a step is relative to, as a part of the parameter's range.
LEAST_SCALE = 1e-3
# Smallest variance [DN²] of a reading in the likelihood: one reading in 60 is off by 1. It is a constant, since a fit
# would adapt the read noise to a floor that depends on it. FLOOR_EXPONENT is n in `_moments_of`. Variances of
# FLOOR_REACH times the floor differ from it by less than the rounding of numbers.
LEAST_VARIANCE, FLOOR_EXPONENT, FLOOR_REACH = 0.2 * ROUNDING_VARIANCE, 12, 20.0
# Sectors of the spot, and the radius [σ] that divides its information into two rings with about as much of it each.
SECTORS, RINGS, RING_RADIUS = 8, 2, 1.2
# Threads that evaluate batches.
THREADS = min(os.cpu_count() or 1, 2)
# Stages whose effects change readings other than through the light.
SENSOR = set(SENSOR_STAGES) - {Stage.PIXEL_GAIN}

# Derivatives of mean [DN] and variance [DN²] of the readings by an unknown, or finite changes of them [frame, h, w].
Column = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Evaluation:
    """The model at the pixels of a batch of frames; arrays [frame, h, w]. Unused pixels have a weight of 0."""

    conditions: FrameConditions  # of the frames
    light: Light  # light of the frames [DN]
    moments: ReadingMoments  # mean [DN] and variance [DN²] of readings, and derivatives of both by the light
    residual: np.ndarray  # reading less mean [DN]
    weight: np.ndarray  # 1/variance [1/DN²]
    variance_score: np.ndarray  # derivative of ln L by the variance [1/DN²]
    field_share: np.ndarray  # part of the variance that is due to granular light, 0 to 1
    # Derivatives of the light by the spot parameters [spot parameter, frame, h, w]; none (length 0) if not asked for.
    slopes: np.ndarray

    @property
    def log_variance(self) -> np.ndarray:
        """ln v of each reading, with v in DN²; 0 for unused pixels. −2 ln L is Σ (r²/v + ln v) up to a constant."""
        return -np.log(self.weight, where=self.weight > 0, out=np.zeros(self.weight.shape))

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
        """Return the score: the derivative of ln L by the unknown of a column, summed over the pixels."""
        return float(np.sum(self.score_per_pixel(column)))

    def information_of(self, first: Column, second: Column) -> float:
        """Return the Fisher information between the unknowns of two columns, summed over the pixels."""
        means, variances = first[0] * second[0], first[1] * second[1]
        return float(np.sum(means * self.weight + variances * self.weight**2 / 2))

    def information_per_pixel(self, column: Column) -> np.ndarray:
        """Return the Fisher information of each reading on the unknown of a column [frame, h, w]."""
        return column[0] ** 2 * self.weight + (column[1] * self.weight) ** 2 / 2

    def score_per_pixel(self, column: Column) -> np.ndarray:
        """Return the derivative of each reading's ln L by the unknown of a column [frame, h, w]."""
        return column[0] * self.residual * self.weight + column[1] * self.variance_score

    def light_equivalent(self, column: Column) -> np.ndarray:
        """Return the array e [frame, h, w] that relates a column to the light.

        For a derivative d of the light by another unknown, Σ e d is the Fisher information between both unknowns.
        """
        moments, weight = self.moments, self.weight
        return moments.mean_slope * column[0] * weight + moments.variance_slope * column[1] * weight**2 / 2


def divide_spot(conditions: FrameConditions) -> tuple[np.ndarray, np.ndarray]:
    """Return sector (0 … 7, of 45° each) and ring (0 inside, 1 outside) of each pixel about the centre of its spot.

    Both are [frame, h, w].
    """
    dx, dy = conditions.pixels.x - conditions.x0, conditions.pixels.y - conditions.y0
    turn = (np.arctan2(dy, dx) + np.pi) / (2 * np.pi)
    sector = np.minimum((turn * SECTORS).astype(int), SECTORS - 1)
    return sector, (np.hypot(dx, dy) > RING_RADIUS * conditions.sigma_px).astype(int)


def map_batches(function: Callable[[slice], Any], pixels: Pixels) -> list[Any]:
    """Call a function with each batch of frames, in threads; return the results in the order of the frames."""
    return list(_run_batches(function, pixels))


def _run_batches(function: Callable[[slice], Any], pixels: Pixels) -> Iterator[Any]:
    """Yield the results of a function of each batch of frames, in their order; computed in threads.

    A batch has about `BATCH_PIXELS` pixels, and at least one frame.
    """
    frames, rows, columns = pixels.readings.shape
    size = max(BATCH_PIXELS // (rows * columns), 1)
    batches = [slice(start, min(start + size, frames)) for start in range(0, frames, size)]
    if len(batches) == 1 or THREADS == 1:
        yield from map(function, batches)
        return
    with ThreadPoolExecutor(THREADS) as pool:
        yield from pool.map(function, batches)


def sum_batches(function: Callable[[slice], tuple[Any, ...]], pixels: Pixels) -> tuple[Any, ...]:
    """Call a function with each batch of frames, and return the sum over batches of each number or array it returns.

    Arrays of the first result are overwritten by the sums.
    """
    results = _run_batches(function, pixels)
    sums = list(next(results))
    for terms in results:
        for k, term in enumerate(terms):
            sums[k] += term
    return tuple(sums)


def evaluate(model: JointModel, pixels: Pixels, batch: slice, with_slopes: bool = True) -> Evaluation:
    """Evaluate a model at the pixels of a batch of frames.

    Parameters
    ----------
    model : JointModel
        Model of all frames.
    pixels : Pixels
        Pixels of all frames.
    batch : slice
        Frames to evaluate.
    with_slopes : bool
        Whether derivatives of the light by the spot parameters are needed (`Evaluation.slopes`).
    """
    spots, design, selected = model.spots.select(batch), model.design.select(batch), pixels.select(batch)
    conditions, forward = conditions_of(design, spots, selected), model.forward
    light = forward.light(conditions)
    moments = _moments_of(forward, conditions, light)
    variance = moments.variance + selected.extra_variance
    used = selected.is_used
    residual = np.where(used, selected.readings - moments.mean, 0.0)
    weight = np.where(used, 1 / variance, 0.0)
    variance_score = (residual**2 * weight - used) * weight / 2
    slopes = _spot_slopes(forward, conditions, light.spot) if with_slopes else np.zeros((0, *used.shape))
    return Evaluation(conditions, light, moments, residual, weight, variance_score, selected.field_share, slopes)


def _moments_of(forward: ForwardModel, conditions: FrameConditions, light: Light) -> ReadingMoments:
    """Return the moments of readings given their light [frame, h, w].

    The variance v is kept above the floor f = `LEAST_VARIANCE` as (vⁿ + fⁿ)^(1/n): smoothly, since fits stall at a
    kink. If readings follow a parameter in whole steps only, moments are interpolated between both neighbouring whole
    values. Otherwise −2 ln L would be a staircase in this parameter.
    """
    neighbours = [
        (weight, neighbour.moments(neighbour.sensor_input(conditions, light=light)))
        for weight, neighbour in _rounded_neighbours(forward)
    ]
    moments = neighbours[0][1]
    if len(neighbours) > 1:
        (low_weight, below), (high_weight, above) = neighbours
        mixture = [low_weight * first + high_weight * second for first, second in zip(below, above, strict=True)]
        # A mixture of two distributions also has the variance of their means.
        mixture[1] = mixture[1] + low_weight * high_weight * (above.mean - below.mean) ** 2
        moments = ReadingMoments(*mixture)
    if np.min(moments.variance) > FLOOR_REACH * LEAST_VARIANCE:
        return moments
    n = FLOOR_EXPONENT
    variance = LEAST_VARIANCE * ((moments.variance / LEAST_VARIANCE) ** n + 1) ** (1 / n)
    slope = moments.variance_slope * (moments.variance / variance) ** (n - 1)
    return moments._replace(variance=variance, variance_slope=slope)


def _rounded_neighbours(forward: ForwardModel) -> list[tuple[float, ForwardModel]]:
    """Return (weight, model) with the rounded parameter at the whole reading below, and at the one above it.

    The weights sum to 1 and interpolate linearly. A model without a rounded parameter is returned alone, with weight 1.
    """
    for applied in forward.effects:
        name = rounded_parameter(applied)
        if name:
            black_level_dn = forward.sensor.black_level_dn
            reading = black_level_dn + applied.parameters[name]
            models = []
            for whole in (np.floor(reading), np.floor(reading) + 1):
                rounded = applied.with_value(name, float(whole - black_level_dn))
                effects = tuple(rounded if other is applied else other for other in forward.effects)
                models.append((float(1 - abs(reading - whole)), replace(forward, effects=effects)))
            return models
    return [(1.0, forward)]


def rounded_parameter(applied: AppliedEffect) -> str:
    """Return the name of the parameter [DN] that readings follow in whole steps only; "" if there is none."""
    steps = applied.effect.variants[applied.variant]
    return next((step.rounded for step in steps if isinstance(step, Step) and step.rounded), "")


def _spot_slopes(forward: ForwardModel, conditions: FrameConditions, spot: np.ndarray) -> np.ndarray:
    """Return the derivatives of the light by the spot parameters [spot parameter, frame, h, w].

    `spot` is the light of the spot [frame, h, w], which is also its derivative by ln peak.
    """
    centre_step = SPOT_STEP * conditions.sigma_px
    displaced = (
        (replace(conditions, sigma_px=conditions.sigma_px * (1 + SPOT_STEP)), SPOT_STEP),
        (replace(conditions, x0=conditions.x0 + centre_step), centre_step),
        (replace(conditions, y0=conditions.y0 + centre_step), centre_step),
    )
    return np.stack([spot, *((forward.light(other).spot - spot) / step for other, step in displaced)])


def differentiate_readings(model: JointModel, evaluation: Evaluation) -> list[Column]:
    """Return the column of each fitted parameter of sensor and effects, in the order of `model.free`."""
    return [_differentiate(model, parameter, evaluation) for parameter in model.free]


def _differentiate(model: JointModel, parameter: FreeParameter, evaluation: Evaluation) -> Column:
    """Return the column of one fitted parameter, by a forward difference."""
    value, step = model.value_of(parameter), difference_step(model, parameter)
    moved = model.with_value(parameter, value + step).forward
    # Any parameter of the sensor acts behind the light, as the read noise does.
    stages = stages_of(model.effect_named(parameter.effect)) if parameter.effect else {Stage.READ_NOISE}
    if not stages & SENSOR:
        light_slope = (moved.light(evaluation.conditions).total - evaluation.light.total) / step
        return evaluation.moments.mean_slope * light_slope, evaluation.moments.variance_slope * light_slope
    mean, variance = change_of_moments(moved, evaluation, has_same_light=stages <= SENSOR)
    return mean / step, variance / step


def change_of_moments(forward: ForwardModel, evaluation: Evaluation, has_same_light: bool) -> Column:
    """Return mean [DN] and variance [DN²] of the readings of another model less those of an evaluation [frame, h, w].

    `has_same_light`: the other model has the light of the evaluation, which is then not computed again.
    """
    light = evaluation.light if has_same_light else forward.light(evaluation.conditions)
    moments = _moments_of(forward, evaluation.conditions, light)
    return moments.mean - evaluation.moments.mean, moments.variance - evaluation.moments.variance


def stages_of(applied: AppliedEffect) -> set[Stage]:
    """Return the stages at which an effect changes the moments of readings.

    A random light of single pixels counts as `Stage.WELL`: its draw is averaged in the table of the sensor's response.
    """
    steps = applied.effect.variants[applied.variant]
    return {Stage.WELL if isinstance(step, RandomStep) and step.stage in TABULATED else step.stage for step in steps}


def difference_step(model: JointModel, parameter: FreeParameter) -> float:
    """Return the step of forward differences in a parameter, in its unit; negative at the upper bound."""
    value = model.value_of(parameter)
    width = parameter.high - parameter.low
    step = PARAMETER_STEP * max(abs(value), LEAST_SCALE * width if np.isfinite(width) else 1.0)
    return -step if value + step > parameter.high else step
