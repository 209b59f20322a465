"""Joint maximum-likelihood fit of spot parameters, sensor and effects by damped Fisher scoring.

The fit minimises −2 ln L = Σ [(y − m)²/v + ln v] over the pixels, with the mean m and the variance v of a reading by
the forward model. `normal_equations` gives one step. This module contains the loop of steps and the test of
convergence.

The unknowns are, in this order, the spot parameters of each frame (ln peak, ln σ_g, x, y) and the free parameters of
sensor and effects. A free light shape adds the coefficients of its nodes, which the equations eliminate. The Newton
decrement is the drop of −2 ln L that a full step would bring if −2 ln L were quadratic. `NormalEquations.promise` gives
this drop for any step. The factor is the Cholesky factor of the information on the coefficients of the shape.
"""

from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.frames import SPOT_PARAMETERS, Design, FrameParameters, Pixels
from spotcheck.discrepancy.normal_equations import NormalEquations, assemble
from spotcheck.discrepancy.shape_grid import ShapeGrid
from spotcheck.discrepancy.shape_sums import SPLINES
from spotcheck.discrepancy.site_draws import improve_draws
from spotcheck.model.effect import AppliedEffect, EffectScales, RandomStep, keyword_names_of
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light_shape import LightShape
from spotcheck.sensor.model import noise_line

# Newton decrement of the effects, beside all other unknowns, below which a fit has converged [−2 ln L]: the effects are
# within 0.2 standard errors of the optimum.
EFFECT_TOLERANCE = 0.03
# Newton decrement of all unknowns below which a fit has converged [−2 ln L].
TOTAL_TOLERANCE = 0.1
# The same with a free shape. It is larger, since there are some 7,000 coefficients, and still far below the drop of
# −2 ln L by which a shape or an effect is judged.
SHAPE_TOLERANCE = 1.5
# The Cholesky factor of the shape's information is expensive and serves up to FACTOR_STEPS steps. It is computed anew
# earlier if a step gains less than FACTOR_GAIN of its promise, or promises more than FACTOR_DECREMENT [−2 ln L].
FACTOR_STEPS, FACTOR_GAIN, FACTOR_DECREMENT = 4, 0.8, 1e3
# Most iterations of a fit.
ITERATIONS = 40
# A fit may still lower −2 ln L by this multiple of the Newton decrement; by more it cannot.
REACHABLE_DROP = 2.0
# A fit that is better than a rival model stops when its decrement is below this part of its lead in −2 ln L.
DECIDED_SHARE = 0.01
# Part of the promised drop of −2 ln L that a step must gain to be accepted.
LEAST_GAIN = 0.05
# Decrement below which a step may raise −2 ln L by rounding, and by how much.
ROUNDING_DECREMENT, ROUNDING_RISE = 0.3, 0.05
# Part of the diagonal of the information that is added when a step fails: first value, factor for each further failure,
# and most trials.
FIRST_DAMPING, DAMPING_FACTOR, TRIES = 1e-3, 10.0, 9
# Largest steps of the spot parameters: of ln peak and ln σ [1], and of the centre [σ].
LARGEST_STEPS = (0.7, 0.4, 1.0)
# Rounds in which parameters at a bound are found: fixing one may turn the step of another outwards.
BOUND_ROUNDS = 3
# Largest peak of a spot [full scales]: its flanks at full scale would lie beyond 3 σ. Tables of brighter light take
# gigabytes.
LARGEST_PEAK = 100.0
# Least light of a free shape [peak], and how many standard errors it may lie below 0, in the mean over a block of
# nodes. The lower of both counts. A shape that may go far below 0 lets false clips be fitted. A shape that may not
# scatter about 0 by its noise is too bright in the mean, and a pedestal beside it too low.
LEAST_LIGHT, LEAST_LIGHT_ERRORS = -0.0005, 4.0
# Range of the fitted read noise, relative to the stated one.
READ_NOISE_RANGE = (0.5, 3.0)


@dataclass(frozen=True)
class FreeParameter:
    """A parameter of the sensor or of an effect that is fitted."""

    effect: str  # name of the effect; "" for the sensor
    name: str  # name of the parameter, or of the field of `SensorModel`
    low: float  # lowest value
    high: float  # highest value
    stated: float = np.nan  # value of the data sheet, the centre of a normal prior; NaN without a prior
    stated_stderr: float = np.inf  # standard error of that value; infinite without a prior

    def prior_deviation(self, value: float) -> float:
        """Return the deviation of a value from the stated one, in standard errors of the latter; 0 without a prior."""
        return (value - self.stated) / self.stated_stderr if np.isfinite(self.stated_stderr) else 0.0


@dataclass(frozen=True)
class JointModel:
    """Values of all parameters of a joint fit, and which of them are fitted. The spot parameters always are.

    A free light shape is a spline, in units of each spot's peak and σ, that is added to the declared shape. Its values
    are those of `forward.baseline.learned`, which may also hold a learned shape that is not fitted.
    """

    forward: ForwardModel  # light, sensor and effects; without a law of brightness and width, which are spot parameters
    spots: FrameParameters  # spot parameters of each frame
    design: Design  # conditions of the frames
    free: tuple[FreeParameter, ...] = ()  # fitted parameters of sensor and effects
    grid: ShapeGrid | None = None  # nodes of the free light shape; None if no shape is fitted
    # Least mean light of a block of nodes of the free shape [peak]; `fit_jointly` sets it.
    least_light: float = LEAST_LIGHT

    @property
    def coefficients(self) -> np.ndarray:
        """Coefficients of the free light shape at its nodes, row after row [coefficient], in units of the peak."""
        learned = self.forward.baseline.learned
        assert learned is not None
        return learned.coefficients.ravel()

    def with_least_light(self, share: float) -> "JointModel":
        """Return the model with the least light of a fit to `share` of the pixels; no block of its shape lies below.

        The standard error of the mean light of a block is that of dark readings at all its pixels.
        """
        assert self.grid is not None
        sensor = self.forward.sensor
        pixels = (SPLINES * self.grid.step * np.exp(self.spots.log_sigma)) ** 2
        variance = float(noise_line(sensor).variance(np.asarray(sensor.black_level_dn)))
        information = share * float(np.sum(np.exp(2 * self.spots.log_peak) * pixels)) / variance
        least_light = min(LEAST_LIGHT, -LEAST_LIGHT_ERRORS / np.sqrt(information))
        return replace(self, least_light=least_light).with_bounded_light(False)

    def with_bounded_light(self, is_at_bound: np.ndarray | bool) -> "JointModel":
        """Return the model with blocks of nodes below the least light raised to it.

        Blocks that are at the bound [block row, block column] are lowered to it as well.
        """
        assert self.grid is not None
        missing_light = self.least_light - self.mean_light()
        missing_light = np.where(is_at_bound, missing_light, np.maximum(missing_light, 0.0))
        return self.with_coefficients(self.coefficients + self.grid.spread_blocks(missing_light))

    def mean_light(self) -> np.ndarray:
        """Return the mean light of blocks of nodes of the free shape, in peaks [block row, block column].

        It is 0 for blocks with nodes whose light is fixed at 0.
        """
        assert self.grid is not None
        declared, nodes = replace(self.forward.baseline, learned=None), self.grid.places
        light = declared.spot(nodes[None, :], nodes[:, None], 1.0, 1.0).ravel() + self.coefficients
        return np.where(self.grid.average_blocks(self.grid.is_outer) > 0, 0.0, self.grid.average_blocks(light))

    def with_coefficients(self, coefficients: np.ndarray) -> "JointModel":
        """Return the model with other coefficients of the free light shape [coefficient]; its fine structure stays."""
        assert self.grid is not None
        learned = self.forward.baseline.learned
        finer = None if learned is None else learned.finer
        shape = LightShape(self.grid.step, coefficients.reshape(self.grid.nodes, self.grid.nodes), finer)
        return self.with_learned(shape)

    def with_learned(self, shape: LightShape | None) -> "JointModel":
        """Return the model with a learned light shape on top of the declared one; None: with the declared one alone."""
        return replace(self, forward=replace(self.forward, baseline=replace(self.forward.baseline, learned=shape)))

    def with_fine_structure(self, other: "JointModel") -> "JointModel":
        """Return the model with the structure finer than the nodes of another model's learned light shape."""
        learned, other_shape = self.forward.baseline.learned, other.forward.baseline.learned
        assert learned is not None and other_shape is not None
        return self.with_learned(replace(learned, finer=other_shape.finer))

    def with_free_shape(self, grid: ShapeGrid) -> "JointModel":
        """Return the model with a free light shape on a grid.

        It starts as the declared shape, or as the free shape that the model has on another grid.
        """
        coefficients = np.zeros((grid.nodes, grid.nodes))
        if self.grid is not None:
            present = LightShape(self.grid.step, self.coefficients.reshape(self.grid.nodes, self.grid.nodes))
            coefficients = present(grid.places[None, :], grid.places[:, None])
        return replace(self, grid=grid).with_coefficients(coefficients.ravel())

    def value_of(self, parameter: FreeParameter) -> float:
        """Return the value of a free parameter, in its unit."""
        if not parameter.effect:
            return getattr(self.forward.sensor, parameter.name)
        return self.effect_named(parameter.effect).parameters[parameter.name]

    def is_at_bound(self, name: str) -> bool:
        """Return whether a fitted parameter of an effect is at its bound."""
        parameters = [parameter for parameter in self.free if parameter.effect == name]
        return any(not parameter.low < self.value_of(parameter) < parameter.high for parameter in parameters)

    def effect_named(self, name: str) -> AppliedEffect:
        """Return an effect of the model, which must have one of this name."""
        return next(applied for applied in self.forward.effects if applied.effect.name == name)

    def with_value(self, parameter: FreeParameter, value: float) -> "JointModel":
        """Return the model with another value of a free parameter."""
        if not parameter.effect:
            sensor = replace(self.forward.sensor, **{parameter.name: value})
            return replace(self, forward=replace(self.forward, sensor=sensor))
        effects = tuple(
            applied.with_value(parameter.name, value) if applied.effect.name == parameter.effect else applied
            for applied in self.forward.effects
        )
        return replace(self, forward=replace(self.forward, effects=effects))

    def with_effect(self, applied: AppliedEffect, scales: EffectScales) -> "JointModel":
        """Return the model with one more effect, some of whose parameters are free.

        Free are those on which mean or variance of a reading depend. A correlation length of random light, for
        instance, changes neither and stays fixed. `scales` give the bounds.
        """
        bounds = dict(zip(applied.parameters, applied.effect.bounds(scales), strict=True))
        names_used: set[str] = set()
        for step in applied.effect.variants[applied.variant]:
            names_used |= set(keyword_names_of(step.function))
            names_used |= set(keyword_names_of(step.quadrature)) if isinstance(step, RandomStep) else set()
        names = [parameter.name for parameter in applied.effect.parameters_of(applied.variant)]
        free = tuple(
            FreeParameter(applied.effect.name, name, *map(float, bounds[name])) for name in names if name in names_used
        )
        forward = replace(self.forward, effects=(*self.forward.effects, applied))
        return replace(self, forward=forward, free=(*self.free, *free))

    def without_effect(self, name: str) -> "JointModel":
        """Return the model without an effect and its free parameters."""
        effects = tuple(applied for applied in self.forward.effects if applied.effect.name != name)
        free = tuple(parameter for parameter in self.free if parameter.effect != name)
        return replace(self, forward=replace(self.forward, effects=effects), free=free)

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Names of the effects in the order in which they were added."""
        return tuple(applied.effect.name for applied in self.forward.effects)


@dataclass(frozen=True)
class JointFit:
    """Result of a joint fit."""

    model: JointModel  # model with the fitted values
    pixels: Pixels  # pixels that were fitted
    equations: NormalEquations  # normal equations at the fitted values
    has_converged: bool  # whether the Newton decrements are below their tolerances
    iterations: int  # number of accepted steps

    @property
    def deviance(self) -> float:
        """−2 ln L up to a constant, with priors and the penalty of a free shape."""
        return self.equations.deviance

    def select(self, frames: np.ndarray) -> "JointFit":
        """Return the fit with model and pixels of some frames [index]; the equations stay those of all frames."""
        model = replace(self.model, spots=self.model.spots.select(frames), design=self.model.design.select(frames))
        return replace(self, model=model, pixels=self.pixels.select(frames))


def fit_jointly(
    model: JointModel,
    pixels: Pixels,
    *,
    tolerance: float = EFFECT_TOLERANCE,
    iterations: int = ITERATIONS,
    rival: float | None = None,
    target: float | None = None,
) -> JointFit:
    """Return the fit of spots, sensor and effects to the pixels.

    It has not converged if it ended early, if its steps were used up, or if no trial step lowers −2 ln L.

    Parameters
    ----------
    model : JointModel
        Starting values.
    pixels : Pixels
        Readings of all frames of the model's design.
    tolerance : float
        Newton decrement of the effects, beside all other unknowns, below which the fit has converged. That of all
        unknowns is scaled in proportion. Both are multiplied by the largest of 1, `NormalEquations.dispersion` (mean
        squared standardised residual) and `Pixels.dispersion` (effect of granular light on the variance of a score).
    iterations : int
        Most steps.
    rival : float, optional
        −2 ln L of another model. The fit ends early if it leads and its decrement is below `DECIDED_SHARE` of the lead.
    target : float, optional
        −2 ln L to reach, for a start near the optimum. The fit ends early if `REACHABLE_DROP` decrements miss it.
    """
    total_tolerance = (TOTAL_TOLERANCE if model.grid is None else SHAPE_TOLERANCE) * tolerance / EFFECT_TOLERANCE
    model = model if model.grid is None else model.with_least_light(pixels.share)
    equations, damping, step_fraction, count, steps_since_factor = assemble(model, pixels), 0.0, 1.0, 0, 0
    while True:
        fixed = _find_blocked(model, equations)
        step = equations.solve(0.0, fixed)
        decrement, effect_decrement = equations.decrements(step, fixed)
        dispersion = max(equations.dispersion, pixels.dispersion, 1.0)
        has_converged = decrement < total_tolerance * dispersion and effect_decrement < tolerance * dispersion
        if (has_converged or count == iterations) and steps_since_factor > 0:
            # The information of an effect beside the shape may be a small difference, which needs a new factor.
            equations, steps_since_factor = assemble(model, pixels), 0
            continue
        if has_converged or _is_decided(equations.deviance, decrement, rival, target) or count == iterations:
            break
        is_old = model.grid is not None and (steps_since_factor + 1 >= FACTOR_STEPS or decrement > FACTOR_DECREMENT)
        accepted, damping, step_fraction = _try_steps(model, pixels, equations, damping, step_fraction, fixed, is_old)
        if accepted is None and steps_since_factor == 0:
            break
        if accepted is None:
            # The reused factor may be the reason for the failure.
            equations, steps_since_factor, step_fraction = assemble(model, pixels), 0, 1.0
            continue
        model, new = accepted
        gain = equations.deviance - new.deviance
        is_new = model.grid is not None and not new.has_factor_of(equations)
        if model.grid is not None and not is_new and (is_old or gain < FACTOR_GAIN * equations.promise(step)):
            new, is_new = assemble(model, pixels), True
        equations, count, steps_since_factor = new, count + 1, 0 if is_new else steps_since_factor + 1
    return JointFit(model, pixels, equations, bool(has_converged), count)


def _is_decided(deviance: float, decrement: float, rival: float | None, target: float | None) -> bool:
    """Return whether a fit may end early: far ahead of its rival, or out of reach of its target; see `fit_jointly`."""
    is_ahead = rival is not None and decrement < DECIDED_SHARE * (rival - deviance)
    return is_ahead or (target is not None and deviance - REACHABLE_DROP * decrement > target)


def _try_steps(
    model: JointModel,
    pixels: Pixels,
    equations: NormalEquations,
    damping: float,
    step_fraction: float,
    fixed: np.ndarray,
    is_old: bool,
) -> tuple[tuple[JointModel, NormalEquations] | None, float, float]:
    """Return (model, equations) after the first trial step that is accepted, the next damping and the next fraction.

    After a failed trial the damping is increased. Beside a free shape the step is halved instead, since damping does
    not shorten the step of the shape. None instead of the pair if all trials fail.

    Parameters
    ----------
    equations : NormalEquations
        Equations at `model`.
    damping : float
        Part of the diagonal of the information that is added to it.
    step_fraction : float
        Fraction of the step at the first trial.
    fixed : array of bool [unknown]
        Unknowns that do not move.
    is_old : bool
        Whether the factor of the shape's information is due: the first trial computes a new one.
    """
    decrement = equations.promise(equations.solve(0.0, fixed))
    for attempt in range(TRIES):
        step = equations.solve(damping, fixed)
        trial = improve_draws(_move(model, equations, step_fraction * step, step_fraction), pixels)
        new = assemble(trial, pixels, None if is_old and attempt == 0 else equations.shape)
        gain = equations.deviance - new.deviance
        is_rounding = decrement < ROUNDING_DECREMENT and gain > -ROUNDING_RISE
        if np.isfinite(gain) and (gain > LEAST_GAIN * step_fraction * equations.promise(step) or is_rounding):
            eased = damping / DAMPING_FACTOR**2 if attempt == 0 else damping
            return (trial, new), eased if eased > FIRST_DAMPING / 2 else 0.0, min(2 * step_fraction, 1.0)
        if model.grid is None:
            damping = max(damping * DAMPING_FACTOR, FIRST_DAMPING)
        else:
            step_fraction /= 2
    return None, damping, step_fraction


def _find_blocked(model: JointModel, equations: NormalEquations) -> np.ndarray:
    """Return which unknowns [unknown] are parameters at a bound that a full step would cross; the fit fixes these."""
    fixed = np.zeros(equations.size, bool)
    first = equations.size - len(model.free)
    for _ in range(BOUND_ROUNDS):
        step = equations.solve(0.0, fixed)
        for k, parameter in enumerate(model.free):
            value, change = model.value_of(parameter), step[first + k]
            fixed[first + k] |= (value <= parameter.low and change < 0) or (value >= parameter.high and change > 0)
    return fixed


def _move(model: JointModel, equations: NormalEquations, step: np.ndarray, step_fraction: float) -> JointModel:
    """Return the model after a step [unknown], which is `step_fraction` times the full one.

    Steps of spots are limited to `LARGEST_STEPS`, within which the linear model is useful. All parameters stay within
    their bounds. The coefficients of a free shape take the same fraction of their step; blocks at the least light stay
    or move there, others are raised to it.
    """
    if model.grid is not None and equations.shape is not None:
        change = equations.shape_step(step / step_fraction)
        model = model.with_coefficients(model.coefficients + step_fraction * change)
        model = model.with_bounded_light(equations.shape.is_at_bound)
    frames = len(model.spots.x)
    spot_steps = step[: SPOT_PARAMETERS * frames].reshape(frames, SPOT_PARAMETERS).T
    sigma = np.exp(model.spots.log_sigma)
    limits = (LARGEST_STEPS[0], LARGEST_STEPS[1], LARGEST_STEPS[2] * sigma, LARGEST_STEPS[2] * sigma)
    rows = [
        values + np.clip(change, -limit, limit)
        for values, change, limit in zip(model.spots.as_rows(), spot_steps, limits, strict=True)
    ]
    rows[0] = np.minimum(rows[0], np.log(LARGEST_PEAK * model.forward.sensor.full_scale_dn))
    model = replace(model, spots=FrameParameters(*rows))
    for parameter, change in zip(model.free, step[SPOT_PARAMETERS * frames :], strict=True):
        value = float(np.clip(model.value_of(parameter) + change, parameter.low, parameter.high))
        model = model.with_value(parameter, value)
    return model
