"""The records of an effect: name, parameters, and for each variant the functions that act at stages of the chain.

An effect is a deviation from the baseline model. A variant is one of several formulas for it, which files call `form`.
A stage is one link of the chain from laser to reading (`Stage`), and a step is a function at a stage. A random step
also takes a number or field that is drawn. A site is a place on the sample, at which frames may have several exposures.
One file holds one effect. All that other code must know about an effect is an attribute of `Effect`: nothing depends on
its name or on the text of a variant.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache
from typing import Any

import numpy as np

from spotcheck.model.stage import Stage
from spotcheck.sensor import SensorModel


class Need(Enum):
    """Requirements on the frames of a dataset for an effect to be measurable, in words."""

    EXPOSURES = "several exposures"
    THREE_EXPOSURES = "three exposures"
    ANGLES = "several angles"
    ORDER = "a known order of acquisition"
    FRAMES = "several frames of a condition"
    SITES = "several sites"
    LAW = "a law of the light in exposure"


# Properties of the spot whose change from frame to frame an effect may describe by a law (`Effect.law_of`).
PROPERTIES = ("brightness", "width")
# Number of nodes of Gauss–Hermite quadratures, which are then exact for polynomials up to degree 9.
HERMITE_NODES = 5
# Starting values [deg] for the direction of something that looks the same after half a turn, such as an ellipse.
DIRECTIONS = (0.0, 45.0, 90.0, 135.0)


class Scope(Enum):
    """The frames that get the same drawn number or field: a single frame, those of a site, or all of the sensor."""

    FRAME = "frame"
    SITE = "site"
    SENSOR = "sensor"


class Only(Enum):
    """The only variant of an effect; files leave its text out."""

    ONLY = ""


class Pedestal(Enum):
    """Variants of a pedestal: of light, with shot noise, or of the electronics, without."""

    LIGHT = "light"
    ELECTRONIC = "electronic"


@dataclass(frozen=True)
class EffectScales:
    """Scales of a dataset, from which effects derive bounds, negligible sizes and starting values."""

    sigma_px: float  # width σ_g [px] at the longest exposure
    peak_dn: float  # brightest light [DN]
    full_scale_dn: float  # largest reading [DN]
    crop_px: float  # side of the crops [px]
    shortest_s: float  # shortest exposure [s]
    read_noise_e: float  # stated read noise [e-]
    gain_dn_per_e: float  # gain K [DN/e-]
    width_exponent: float  # exponent [1] of the power of the exposure t nearest to the beam propagation p1 ln t + p2
    longest_s: float  # longest exposure [s]
    waves: tuple[tuple[float, float], ...] = ()  # stripes found in residuals: (period [px], direction [deg])
    copies: tuple[tuple[float, float], ...] = ()  # copies of the spot found in residuals: (dx, dy) [px]


# A number in the unit of a parameter, or a function that derives it from the scales of a dataset.
Bound = float | Callable[[EffectScales], float]


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect, with its unit and limits."""

    name: str  # name by which functions take it
    unit: str  # unit; "1" for none
    low: Bound = -np.inf  # lowest value; −∞ for a direction, which has no bounds
    high: Bound = np.inf  # highest value; ∞ for a direction
    negligible: Bound = 0.0  # distance from `Effect.vanishes_at` that a user would call zero
    is_variant_specific: bool = False  # whether only some variants have it; it is then reported as part of the variant


@dataclass(frozen=True, eq=False)
class Step:
    """A function at a stage. It takes the arguments of the stage and, by name, parameters of the effect."""

    stage: Stage  # stage at which it acts
    function: Callable[..., Any]  # arguments and result are those of the stage
    # Parameter [DN] on which readings depend in steps of 1 DN, since they are rounded afterwards; "" if none.
    rounded: str = ""

    def keyword_names(self) -> tuple[str, ...]:
        """Return the names of the arguments that its functions take by name."""
        return keyword_names_of(self.function)


@dataclass(frozen=True, eq=False)
class RandomStep:
    """A function at a stage that takes a random number or field as its last argument before the parameters."""

    stage: Stage  # stage at which it acts
    function: Callable[..., Any]  # arguments are those of the stage, then the drawn number or field
    scope: Scope  # frames that share a draw
    # (rng, shape (rows, columns) of the frame, parameters by name) → a number, or a field that broadcasts with frames
    draw: Callable[..., Any]
    # (parameters by name) → values [node] of the draw in a pixel and weights [node], which sum to 1. The weighted sum
    # of a function of the values is its mean over the draw.
    quadrature: Callable[..., tuple[np.ndarray, np.ndarray]]

    def keyword_names(self) -> tuple[str, ...]:
        """Return the names of the arguments that its functions take by name."""
        return keyword_names_of(self.function, self.draw, self.quadrature)


@dataclass(frozen=True, eq=False)
class Effect:
    """One effect.

    Parameters
    ----------
    name : a word of small letters, digits and underscores.
    sentence : what the effect does, for users; it starts with a small letter and has no full stop.
    parameters : parameters of all variants; the first is the strength, the size of the effect.
    variants : variant → its steps; a variant is a member of an enum, whose value is its text in files.
    starts : function from the scales of a dataset to one or more tuples of starting values of all parameters.
    reference : source of the formula.
    number : place in the vocabulary, from 1; 0 for the next free one. Random draws depend on it.
    vanishes_at : value of the strength without effect; infinity for a clip, NaN if it depends on the dataset.
    noun : quantity whose size is the strength, as in "no clip below 930 DN"; by default the name of the parameter.
    is_share : whether the strength is a share of something, which is written in per cent.
    is_static_shape : whether it changes the shape of the light in the same way in every frame.
    law_of : property of the spot whose change from frame to frame it describes, "brightness" or "width"; "" for none.
    acts_on_noise : whether it changes the noise and hardly the mean, so that it is found in the scatter of readings.
    needs : what the frames of a dataset must have for it to be measurable.
    special_cases : effects that it can imitate with certain values of its parameters, each by its name, or all laws of
        a property by one of `PROPERTIES`.
    replaces : parameters of the exposure law (p1, p2, peak_dn) that have no meaning beside it.
    hidden_in_flats : reason why flats and darks at several light levels cannot show it; "" if they can.
    instrument_keys : function of a sensor, the variant and the parameters by name. It returns the keys of
        instrument.yaml, with values, that make the baseline do the same as the effect; {} if there are none. None if
        no variant has such keys.
    """

    name: str
    sentence: str
    parameters: tuple[Parameter, ...]
    variants: Mapping[Enum, tuple[Step | RandomStep, ...]]
    starts: Callable[[EffectScales], Sequence[tuple[float, ...]]]
    reference: str = ""
    number: int = 0
    vanishes_at: float = 0.0
    noun: str = ""
    is_share: bool = False
    is_static_shape: bool = False
    law_of: str = ""
    acts_on_noise: bool = False
    needs: tuple[Need, ...] = ()
    special_cases: tuple[str, ...] = ()
    replaces: tuple[str, ...] = ()
    hidden_in_flats: str = "there is no spot"
    instrument_keys: Callable[..., Mapping[str, float]] | None = None

    @property
    def stages(self) -> tuple[Stage, ...]:
        """Stages at which any variant acts, in the order of the chain."""
        used = {step.stage for steps in self.variants.values() for step in steps}
        return tuple(stage for stage in Stage if stage in used)

    def parameters_of(self, variant: Enum) -> list[Parameter]:
        """Return the parameters that a variant has: general ones, and variant-specific ones that its functions take."""
        used = {name for step in self.variants[variant] for name in step.keyword_names()}
        return [p for p in self.parameters if not p.is_variant_specific or p.name in used]

    def variant_named(self, text: str | None) -> Enum | None:
        """Return the variant whose text in files is `text`; None if there is none."""
        return next((variant for variant in self.variants if variant.value == text), None)

    def apply(self, values: Mapping[str, float], form: str | None = None) -> "AppliedEffect":
        """Return the effect with a variant and the values of all parameters that the variant has.

        Parameters
        ----------
        values : values by the names of parameters, each in its unit.
        form : text of the variant in files; None for the only variant, or for the one whose text is empty.

        Raises
        ------
        ValueError
            If there is no such variant, or if it has other parameters; the message says what would be right.
        """
        forms = [variant.value for variant in self.variants]
        variant = self.variant_named(forms[0] if form is None and len(forms) == 1 else form or "")
        if variant is None:
            remedy = f"it must be one of {', '.join(forms)}" if len(forms) > 1 else "leave it out"
            raise ValueError(f"the form of {self.name} is {form or 'missing'}; {remedy}")
        names = [parameter.name for parameter in self.parameters_of(variant)]
        if set(values) != set(names):
            raise ValueError(f"{self.name} needs the parameters {', '.join(names)}, not {', '.join(values) or 'none'}")
        return AppliedEffect(self, variant, tuple(float(values.get(p.name, np.nan)) for p in self.parameters))

    def bounds(self, scales: EffectScales) -> np.ndarray:
        """Return the lowest and the highest value of each parameter [parameter, 2], in the unit of the parameter."""
        bounds = [(parameter.low, parameter.high) for parameter in self.parameters]
        return np.array([[end(scales) if callable(end) else end for end in pair] for pair in bounds], dtype=float)


@dataclass(frozen=True)
class AppliedEffect:
    """An effect in a model: with its variant and the values of its parameters (`Effect.apply`)."""

    effect: Effect
    variant: Enum  # one of its variants
    values: tuple[float, ...]  # values of all parameters, in their order; NaN for those that the variant does not have

    @property
    def parameters(self) -> dict[str, float]:
        """Values of all parameters by name; NaN for those that the variant does not have."""
        return {parameter.name: value for parameter, value in zip(self.effect.parameters, self.values, strict=True)}

    def with_value(self, name: str, value: float) -> "AppliedEffect":
        """Return the effect with one parameter set to a new value."""
        return replace(self, values=tuple((self.parameters | {name: value}).values()))

    def steps_at(self, stage: Stage) -> Iterator["AppliedStep"]:
        """Return the steps of the variant that act at a stage, in their order."""
        return (AppliedStep(step, self) for step in self.effect.variants[self.variant] if step.stage is stage)

    def instrument_keys(self, sensor: SensorModel) -> Mapping[str, float]:
        """Return keys of instrument.yaml, with values, that make a sensor act as the effect does; {} if none can."""
        function = self.effect.instrument_keys
        return {} if function is None else function(sensor, self.variant, **self.parameters)


@dataclass(frozen=True)
class AppliedStep:
    """A step with the parameters of its effect: a function of the arguments of its stage.

    Steps that compare equal return the same for equal arguments, so that cached tables can be reused for them.
    """

    step: Step | RandomStep  # the step without parameters
    applied: AppliedEffect  # the effect to which it belongs
    full_scale_dn: float = np.inf  # largest reading [DN], for functions that take it by name

    def __call__(self, *arguments: Any) -> Any:
        """Return the result of the step's function for the arguments of its stage."""
        return self.call(self.step.function, *arguments)

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return the result of one of the step's functions, such as a derivative or a draw.

        `arguments` are passed by position. Keyword-only arguments of the function get the parameters of the effect with
        the same names, NaN for those that the variant does not have, or `full_scale_dn`.
        """
        values = self.applied.parameters | {"full_scale_dn": self.full_scale_dn}
        return function(*arguments, **{name: values[name] for name in keyword_names_of(function)})

    @property
    def random_step(self) -> RandomStep | None:
        """The step if it takes a drawn number or field, else None."""
        return self.step if isinstance(self.step, RandomStep) else None

    def quadrature(self) -> tuple[np.ndarray, np.ndarray]:
        """Return values [node] and weights [node] of the draw (`RandomStep.quadrature`); for random steps only."""
        assert self.random_step is not None
        return self.call(self.random_step.quadrature)


@cache
def keyword_names_of(*functions: Callable[..., Any]) -> tuple[str, ...]:
    """Return the names of the keyword-only arguments of functions: parameters of an effect, or `full_scale_dn`."""
    return tuple(name for function in functions for name in inspect.getfullargspec(function).kwonlyargs)


def multiply(frame, value, factor):
    """Return a value, such as a peak or a light [DN], times the drawn `factor` [1]: a function of random steps."""
    return value * factor


def normal_draws(name: str, transform: Callable[..., Any] = np.asarray, size: Callable[..., Any] = lambda shape: ()):
    """Return the functions `draw` and `quadrature` of a `RandomStep` that draws transformed normal numbers.

    Parameters
    ----------
    name : str
        Parameter of the effect that is the standard deviation of the normal numbers; their mean is 0.
    transform : function
        Function from normal numbers to drawn values; by default the numbers themselves.
    size : function
        Function from the shape (rows, columns) of the frame to the shape of a draw; by default (), one number.
    """

    def draw(rng, shape, **parameters):
        """Return a draw for a frame of `shape` (rows, columns), as `RandomStep.draw` is called."""
        return transform(parameters[name] * rng.standard_normal(size(shape)))

    def quadrature(**parameters):
        """Return transformed Gauss–Hermite nodes [node] and their weights [node], which sum to 1."""
        nodes, weights = np.polynomial.hermite_e.hermegauss(HERMITE_NODES)
        return transform(parameters[name] * nodes), weights / weights.sum()

    # `keyword_names_of` reads the name of the parameter from the signature.
    signature = inspect.Signature([inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY)])
    draw.__signature__ = quadrature.__signature__ = signature  # type: ignore[attr-defined]
    return draw, quadrature
