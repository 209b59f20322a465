"""The records of an effect: name, parameters, and for each variant the functions that act at stages of the chain.

One file holds one effect. What other code needs to know about an effect is an attribute of `Effect`; nothing depends
on its name or on the text of a variant.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cache
from typing import Any

import numpy as np

from spotcheck.model.stage import Stage
from spotcheck.sensor import SensorModel


class Need(Enum):
    """Conditions that a design must vary for an effect to show, in words."""

    EXPOSURES = "several exposures"
    THREE_EXPOSURES = "three exposures"
    ANGLES = "several angles"
    ORDER = "a known order of acquisition"
    FRAMES = "several frames of a condition"
    SITES = "several sites"
    LAW = "a law of the light in exposure"


# Properties of the spot that an effect may be a law of.
PROPERTIES = ("brightness", "width")
# Starting values [deg] of a direction after which half a turn changes nothing.
DIRECTIONS = (0.0, 45.0, 90.0, 135.0)


class Scope(Enum):
    """Which frames share a random number or field."""

    FRAME = "frame"
    SITE = "site"
    SENSOR = "sensor"


class Only(Enum):
    """The variant of an effect that has one."""

    ONLY = ""


class Pedestal(Enum):
    """Variants of a pedestal: light, with shot noise, or electronics, without."""

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
    width_exponent: float  # power of the exposure that comes nearest to p1 ln t + p2
    longest_s: float  # longest exposure [s]
    waves: tuple[tuple[float, float], ...] = ()  # stripes in residuals: period [px] and direction [deg]
    copies: tuple[tuple[float, float], ...] = ()  # copies of the spot in residuals: dx, dy [px]


Bound = float | Callable[[EffectScales], float]


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect."""

    name: str  # name, which the functions take it by
    unit: str  # unit, 1 for none
    low: Bound = -np.inf  # lowest value, a number or a function of the scales; a direction has no bounds
    high: Bound = np.inf  # highest value
    negligible: Bound = 0.0  # distance from where the effect vanishes below which a user would call it nothing
    is_variant_specific: bool = False  # whether it is a constant of the variant: fitted, and reported as part of it


@dataclass(frozen=True, eq=False)
class Step:
    """A function at a stage. It takes the arguments of the stage and, by name, parameters of the effect."""

    stage: Stage  # where it acts
    function: Callable[..., Any]  # arguments and result are those of `Stage`
    # Derivatives of the result by parameters, by name; functions with the same arguments. For stages in which the light
    # is proportional to the result (brightness) or contains it as a sum (pedestal).
    derivatives: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    # Parameter [DN] that readings follow in whole steps only, since rounding comes behind it; "" if none.
    rounded: str = ""

    def keyword_names(self) -> tuple[str, ...]:
        """Return the names of the parameters that it takes."""
        return keyword_names_of(self.function)


@dataclass(frozen=True, eq=False)
class RandomStep:
    """A function at a stage that takes a random number or field as its last argument before the parameters."""

    stage: Stage  # where it acts
    function: Callable[..., Any]  # arguments are those of `Stage`, then what was drawn
    scope: Scope  # which frames share what is drawn
    # (rng, shape [rows, columns] of the frame, parameters by name) → random number or field
    draw: Callable[..., Any]
    # (parameters by name) → quadrature values [node] and weights [node] of the draw in one pixel; weights sum to 1
    quadrature: Callable[..., tuple[np.ndarray, np.ndarray]]

    def keyword_names(self) -> tuple[str, ...]:
        """Return the names of the parameters that it takes."""
        return keyword_names_of(self.function, self.draw, self.quadrature)


@dataclass(frozen=True, eq=False)
class Effect:
    """One effect.

    Parameters
    ----------
    name : a word of small letters, digits and underscores.
    sentence : what a person is told, from a small letter on and without a full stop.
    parameters : the strength first.
    variants : for each variant (a member of an enum, whose value is its text in files) its steps.
    starts : starting values of all parameters for a fit, one or more, from the scales of a dataset.
    reference : where the formula comes from.
    number : place in the vocabulary, from 1; 0 for the next free one. Random draws depend on it.
    vanishes_at : value of the strength without effect; infinity for a clip, NaN if it depends on the dataset.
    noun : what the strength is the size of, as in "no clip below 930 DN"; by default the name of the parameter.
    is_share : whether the strength is a part of something, which is written in per cent.
    is_static_shape : whether it changes the shape of the light in the same way in every frame.
    law_of : property of the spot for which it is a law across frames, "brightness" or "width"; "" for none.
    acts_on_noise : whether it changes the noise and hardly the mean, so that scatter tells it.
    needs : what a design must vary for it to show.
    special_cases : effects that are special cases of it, by name or by the property that they are a law of.
    replaces : parameters of the baseline that lose their meaning.
    hidden_in_flats : why levels of flats and darks cannot show it; "" where they can.
    instrument_keys : from a sensor, the variant and the parameters by name: values of the keys of instrument.yaml with
        which the baseline does what the effect does; {} for none. None if no variant has any.
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
        """Return the parameters that a variant has: of the constants of variants, those that its functions take."""
        used = {name for step in self.variants[variant] for name in step.keyword_names()}
        return [p for p in self.parameters if not p.is_variant_specific or p.name in used]

    def variant_named(self, text: str | None) -> Enum | None:
        """Return the variant of a text in files; None if there is none."""
        return next((variant for variant in self.variants if variant.value == text), None)

    def apply(self, values: Mapping[str, float], form: str | None = None) -> "AppliedEffect":
        """Return the effect with values of all parameters that its variant has.

        Parameters
        ----------
        values : values by the names of parameters, each in its unit.
        form : text of the variant in files; None if there is only one, or for the one without a text.

        Raises
        ------
        ValueError
            If there is no such variant, or if its parameters are others; the text says what would be right.
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
        """Return the lowest and the highest value of each parameter [parameter, 2]."""
        ends = [(parameter.low, parameter.high) for parameter in self.parameters]
        return np.array([[end(scales) if callable(end) else end for end in pair] for pair in ends], dtype=float)


@dataclass(frozen=True)
class AppliedEffect:
    """An effect in a model, as `Effect.apply` makes it."""

    effect: Effect
    variant: Enum  # one of its variants
    values: tuple[float, ...]  # values of all parameters, in their order; NaN for those that the variant does not have

    @property
    def parameters(self) -> dict[str, float]:
        """Values by name."""
        return {parameter.name: value for parameter, value in zip(self.effect.parameters, self.values, strict=True)}

    def with_value(self, name: str, value: float) -> "AppliedEffect":
        """Return the effect with another value of one parameter."""
        return replace(self, values=tuple((self.parameters | {name: value}).values()))

    def steps_at(self, stage: Stage) -> Iterator["AppliedStep"]:
        """Return the steps of the variant at a stage."""
        return (AppliedStep(step, self) for step in self.effect.variants[self.variant] if step.stage is stage)

    def instrument_keys(self, sensor: SensorModel) -> Mapping[str, float]:
        """Return the values of keys of instrument.yaml with which a sensor does what the effect does; {} for none."""
        keys_of = self.effect.instrument_keys
        return {} if keys_of is None else keys_of(sensor, self.variant, **self.parameters)


@dataclass(frozen=True)
class AppliedStep:
    """A step with the parameters of its effect: a function of the arguments of its stage.

    Steps that compare equal do the same, so that tables can be kept for them.
    """

    step: Step | RandomStep  # which step
    applied: AppliedEffect  # the effect that it belongs to
    full_scale_dn: float = np.inf  # largest reading [DN], for functions that take it by name

    def __call__(self, *arguments: Any) -> Any:
        return self.call(self.step.function, *arguments)

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of the step with the parameters that it names."""
        values = self.applied.parameters | {"full_scale_dn": self.full_scale_dn}
        return function(*arguments, **{name: values[name] for name in keyword_names_of(function)})

    @property
    def random(self) -> RandomStep | None:
        """The step if it takes a random number or field, else None."""
        return self.step if isinstance(self.step, RandomStep) else None

    def average(self) -> tuple[np.ndarray, np.ndarray]:
        """Return values and weights that average over what a random step draws."""
        assert self.random is not None
        return self.call(self.random.quadrature)


@cache
def keyword_names_of(*functions: Callable[..., Any]) -> tuple[str, ...]:
    """Return the names of the parameters of an effect that functions take: their keyword-only arguments."""
    return tuple(name for function in functions for name in inspect.getfullargspec(function).kwonlyargs)


def multiply(frame, value, factor):
    """Return a value, such as a peak or a light [DN], times what was drawn: for random steps."""
    return value * factor


def normal_draws(name: str, transform: Callable[..., Any] = np.asarray, size: Callable[..., Any] = lambda shape: ()):
    """Return `draw` and `quadrature` of a random step whose values are a function of normal numbers.

    Parameters
    ----------
    name : str
        Parameter that is the standard deviation of the normal numbers; their mean is 0.
    transform : function
        Makes values of normal numbers; by default the numbers themselves.
    size : function
        Size of what is drawn, from the shape [rows, columns] of the frame; by default one number.
    """

    def draw(rng, shape, **parameters):
        return transform(parameters[name] * rng.standard_normal(size(shape)))

    def quadrature(**parameters):
        # Gauss–Hermite: exact for polynomials of degree 9.
        nodes, weights = np.polynomial.hermite_e.hermegauss(5)
        return transform(parameters[name] * nodes), weights / weights.sum()

    signature = inspect.Signature([inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY)])
    draw.__signature__ = quadrature.__signature__ = signature  # type: ignore[attr-defined]
    return draw, quadrature
