"""Joint maximum-likelihood fit of frame parameters, sensor and effects by damped Fisher scoring.

The fit minimises −2 ln L = Σ [(y − m)²/v + ln v] over the pixels, with mean m and variance v of a reading by the
forward model. `normal_equations` gives one step, this module the loop of steps and the test of convergence.
"""

from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.frames import Design, FrameParameters, Pixels
from spotcheck.discrepancy.normal_equations import NormalEquations, assemble
from spotcheck.discrepancy.shape_grid import ShapeGrid
from spotcheck.model.effect import AppliedEffect, EffectScales, RandomStep, keyword_names_of
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light_shape import LightShape

# Newton decrement of the effects beside all nuisance parameters below which a fit has converged [−2 ln L]: the effects
# are within 0.2 standard errors of the optimum.
EFFECT_TOLERANCE = 0.03
# The same of all parameters.
TOTAL_TOLERANCE = 0.1
# The same with a free shape: some 7,000 coefficients, far below what a gain must reach.
SHAPE_TOLERANCE = 1.5
# Steps that one factor of the shape's information serves; it is made anew where a step gains less than this part of its
# promise, or promises more than this.
FACTOR_STEPS, FACTOR_GAIN, FACTOR_DECREMENT = 4, 0.8, 1e3
# Most iterations of a fit.
ITERATIONS = 40
# Multiple of the drop of −2 ln L that a step promises which a fit may still reach.
REACHABLE_DROP = 2.0
# Part of the promised drop of −2 ln L that a step must keep.
LEAST_GAIN = 0.05
# Decrement below which a step may raise −2 ln L by rounding, and by how much.
ROUNDING_DECREMENT, ROUNDING_RISE = 0.3, 0.05
# Part of the diagonal of the information that is added where steps fail: at first, and from try to try.
FIRST_DAMPING, DAMPING_FACTOR, TRIES = 1e-3, 10.0, 9
# Largest steps of ln peak and ln σ [1], and of the centre [σ].
LARGEST_STEPS = (0.7, 0.4, 1.0)
# Largest peak of a spot [full scales]: its flanks at full scale would lie beyond 3 σ. Tables of brighter light take
# gigabytes.
LARGEST_PEAK = 100.0
# Least light of a free shape [peak]: no light is below 0, and a shape that may go far below makes room for false clips.
# The little that is left lets noise scatter about 0.
LEAST_LIGHT = -0.0005
# Part of the stated read noise that the fitted one is at least and at most.
READ_NOISE_RANGE = (0.5, 3.0)


@dataclass(frozen=True)
class FreeParameter:
    """A parameter of the sensor or of an effect that is fitted."""

    effect: str  # name of the effect; "" for the sensor
    name: str  # name of the parameter, or of the field of `SensorModel`
    low: float  # lowest value
    high: float  # highest value
    stated: float = np.nan  # value of the data sheet, with a normal prior about it; NaN for none
    stated_stderr: float = np.inf  # standard error of that value

    def prior_information(self) -> float:
        """Return the information that the data sheet brings; 0 for none."""
        return 1 / self.stated_stderr**2

    def prior_deviation(self, value: float) -> float:
        """Return a value less the stated one in stated errors; 0 without a prior."""
        return (value - self.stated) / self.stated_stderr if np.isfinite(self.stated_stderr) else 0.0


@dataclass(frozen=True)
class JointModel:
    """Parameters of a joint fit: the forward model, the spot of each frame, and what is fitted beside the spots."""

    forward: ForwardModel  # baseline, sensor and effects; without a law
    spots: FrameParameters  # spot of each frame
    design: Design  # conditions of the frames
    free: tuple[FreeParameter, ...] = ()  # fitted parameters of sensor and effects
    grid: ShapeGrid | None = None  # nodes of the free light shape that the baseline holds; None: it is not fitted

    @property
    def coefficients(self) -> np.ndarray:
        """Coefficients of the free light shape, row after row [coefficient, peak]."""
        learned = self.forward.baseline.learned
        assert learned is not None
        return learned.coefficients.ravel()

    @property
    def least_coefficients(self) -> np.ndarray:
        """Least values of the coefficients, at which the light is `LEAST_LIGHT` [coefficient, peak]."""
        assert self.grid is not None
        declared, places = replace(self.forward.baseline, learned=None), self.grid.places
        return LEAST_LIGHT - declared.spot(places[None, :], places[:, None], 1.0, 1.0).ravel()

    def with_coefficients(self, coefficients: np.ndarray) -> "JointModel":
        """Return the model with other coefficients of the light shape."""
        assert self.grid is not None
        learned = self.forward.baseline.learned
        finer = None if learned is None else learned.finer
        shape = LightShape(self.grid.step, coefficients.reshape(self.grid.nodes, self.grid.nodes), finer)
        return self.with_learned(shape)

    def with_learned(self, shape: LightShape | None) -> "JointModel":
        """Return the model with a learned shape of the light, or with the declared one alone."""
        return replace(self, forward=replace(self.forward, baseline=replace(self.forward.baseline, learned=shape)))

    def with_fine_structure(self, other: "JointModel") -> "JointModel":
        """Return the model with the structure between the nodes of another model's light shape."""
        learned, shape = self.forward.baseline.learned, other.forward.baseline.learned
        assert learned is not None and shape is not None
        return self.with_learned(replace(learned, finer=shape.finer))

    def with_free_shape(self, grid: ShapeGrid) -> "JointModel":
        """Return the model with a light shape that is fitted, from the declared one on."""
        return replace(self, grid=grid).with_coefficients(np.zeros(grid.nodes**2))

    def value_of(self, parameter: FreeParameter) -> float:
        """Return the value of a fitted parameter."""
        if not parameter.effect:
            return getattr(self.forward.sensor, parameter.name)
        return self.effect_named(parameter.effect).parameters[parameter.name]

    def effect_named(self, name: str) -> AppliedEffect:
        """Return an effect of the model."""
        return next(applied for applied in self.forward.effects if applied.effect.name == name)

    def with_value(self, parameter: FreeParameter, value: float) -> "JointModel":
        """Return the model with another value of a fitted parameter."""
        if not parameter.effect:
            sensor = replace(self.forward.sensor, **{parameter.name: value})
            return replace(self, forward=replace(self.forward, sensor=sensor))
        effects = tuple(
            applied.with_value(parameter.name, value) if applied.effect.name == parameter.effect else applied
            for applied in self.forward.effects
        )
        return replace(self, forward=replace(self.forward, effects=effects))

    def with_effect(self, applied: AppliedEffect, scales: EffectScales) -> "JointModel":
        """Return the model with an effect of which the parameters that moments of readings depend on are fitted."""
        bounds = dict(zip(applied.parameters, applied.effect.bounds(scales), strict=True))
        used: set[str] = set()
        for step in applied.effect.variants[applied.variant]:
            used |= set(keyword_names_of(step.function))
            used |= set(keyword_names_of(step.quadrature)) if isinstance(step, RandomStep) else set()
        names = [parameter.name for parameter in applied.effect.parameters_of(applied.variant)]
        free = tuple(
            FreeParameter(applied.effect.name, name, *map(float, bounds[name])) for name in names if name in used
        )
        forward = replace(self.forward, effects=(*self.forward.effects, applied))
        return replace(self, forward=forward, free=(*self.free, *free))

    def without_effect(self, name: str) -> "JointModel":
        """Return the model without an effect."""
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

    model: JointModel  # at the last step
    pixels: Pixels  # that were fitted
    equations: NormalEquations  # normal equations at the model
    has_converged: bool  # whether the Newton decrements are below their tolerances
    iterations: int  # number of steps

    @property
    def deviance(self) -> float:
        """−2 ln L but for a constant."""
        return self.equations.deviance

    def select(self, frames: np.ndarray) -> "JointFit":
        """Return model and pixels of some frames; the equations stay those of all."""
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
    """Fit spots, sensor and effects to the pixels.

    Parameters
    ----------
    model : JointModel
        Starting values.
    pixels : Pixels
        Readings of all frames of the model's design.
    tolerance : float
        Newton decrement of the effects beside all nuisance parameters below which the fit has converged; that of all
        parameters is scaled in proportion. Both grow with the larger of two dispersions: the mean squared standardised
        residual, and that of granular light.
    iterations : int
        Most steps.
    rival : float, optional
        −2 ln L of a model to compare with: the fit also ends, not converged, when a step promises less than 1 % of the
        drop below it.
    target : float, optional
        −2 ln L that a fit from a near start must reach: it also ends, not converged, when `REACHABLE_DROP` times
        the drop that a step promises does not lead there.
    """
    equations = assemble(model, pixels)
    damping, part, count, age = 0.0, 1.0, 0, 0
    total_tolerance = (TOTAL_TOLERANCE if model.grid is None else SHAPE_TOLERANCE) * tolerance / EFFECT_TOLERANCE
    while True:
        fixed = _held_parameters(model, equations)
        step = equations.solve(0.0, fixed)
        decrement, of_effects = equations.decrements(step, fixed)
        dispersion = max(equations.dispersion, pixels.dispersion, 1.0)
        has_converged = decrement < total_tolerance * dispersion and of_effects < tolerance * dispersion
        if (has_converged or count == iterations) and age > 0:
            # The information of an effect beside the shape may be a small difference, which a factor that was taken
            # over gets wrong.
            equations, age = assemble(model, pixels), 0
            continue
        if has_converged or _is_decided(equations.deviance, decrement, rival, target) or count == iterations:
            break
        is_old = model.grid is not None and (age + 1 >= FACTOR_STEPS or decrement > FACTOR_DECREMENT)
        moved, damping, part = _try_steps(model, pixels, equations, damping, part, fixed, is_old)
        if moved is None and age > 0:
            # A factor that was taken over is too old.
            equations, age = assemble(model, pixels), 0
            continue
        if moved is None:
            break
        gain, (model, new) = equations.deviance - moved[1].deviance, moved
        is_new = model.grid is not None and not new.has_factor_of(equations)
        if model.grid is not None and not is_new and (is_old or gain < FACTOR_GAIN * equations.promise(step)):
            new, is_new = assemble(model, pixels), True
        equations, count, age = new, count + 1, 0 if is_new else age + 1
    return JointFit(model, pixels, equations, bool(has_converged), count)


def _is_decided(deviance: float, decrement: float, rival: float | None, target: float | None) -> bool:
    """Return whether a fit ends by what it compares with; see `fit_jointly`."""
    is_ahead = rival is not None and decrement < 0.01 * (rival - deviance)
    return is_ahead or (target is not None and deviance - REACHABLE_DROP * decrement > target)


def _try_steps(
    model: JointModel,
    pixels: Pixels,
    equations: NormalEquations,
    damping: float,
    part: float,
    fixed: np.ndarray,
    is_old: bool,
) -> tuple[tuple[JointModel, NormalEquations] | None, float, float]:
    """Return model and equations after the first step that lowers −2 ln L enough, or None.

    Beside them: the damping of the next step, and the part of it to begin with. Damping does not shorten the step of a
    shape, so that beside a shape steps are halved instead. Where the shape's factor `is_old`, the first trial makes it
    anew.
    """
    decrement = equations.promise(equations.solve(0.0, fixed))
    for attempt in range(TRIES):
        step = equations.solve(damping, fixed)
        trial = _move(model, equations, part * step, part)
        new = assemble(trial, pixels, None if is_old and attempt == 0 else equations.shape)
        gain = equations.deviance - new.deviance
        is_rounding = decrement < ROUNDING_DECREMENT and gain > -ROUNDING_RISE
        if np.isfinite(gain) and (gain > LEAST_GAIN * part * equations.promise(step) or is_rounding):
            eased = damping / DAMPING_FACTOR**2 if attempt == 0 else damping
            return (trial, new), eased if eased > FIRST_DAMPING / 2 else 0.0, min(2 * part, 1.0)
        if model.grid is None:
            damping = max(damping * DAMPING_FACTOR, FIRST_DAMPING)
        else:
            part /= 2
    return None, damping, part


def _held_parameters(model: JointModel, equations: NormalEquations) -> np.ndarray:
    """Return which of all parameters are at a bound that their step would cross: these are fixed."""
    fixed = np.zeros(equations.size, bool)
    first = equations.size - len(model.free)
    for _ in range(3):
        step = equations.solve(0.0, fixed)
        for k, parameter in enumerate(model.free):
            value = model.value_of(parameter)
            is_outward = (value <= parameter.low and step[first + k] < 0) or (
                value >= parameter.high and step[first + k] > 0
            )
            fixed[first + k] |= is_outward
    return fixed


def _move(model: JointModel, equations: NormalEquations, step: np.ndarray, part: float) -> JointModel:
    """Return the model after a step, each parameter limited to what a linear step can know; `part` of the shape's."""
    if model.grid is not None:
        change = equations.shape_step(step / part)
        model = model.with_coefficients(np.maximum(model.coefficients + part * change, model.least_coefficients))
    frames = len(model.spots.x)
    of_spots = step[: 4 * frames].reshape(frames, 4).T
    sigma = np.exp(model.spots.log_sigma)
    limits = (LARGEST_STEPS[0], LARGEST_STEPS[1], LARGEST_STEPS[2] * sigma, LARGEST_STEPS[2] * sigma)
    rows = [
        values + np.clip(change, -limit, limit)
        for values, change, limit in zip(model.spots.as_rows(), of_spots, limits, strict=True)
    ]
    rows[0] = np.minimum(rows[0], np.log(LARGEST_PEAK * model.forward.sensor.full_scale_dn))
    model = replace(model, spots=FrameParameters(*rows))
    for parameter, change in zip(model.free, step[4 * frames :], strict=True):
        value = float(np.clip(model.value_of(parameter) + change, parameter.low, parameter.high))
        model = model.with_value(parameter, value)
    return model
