"""What an effect is: a name, a sentence, parameters, the place in the chain where it acts, and a function.

One file in `effects/` holds one effect and nothing else has to know of it. The places are those of the dataset
contract's order; each says what the function gets and returns (arrays broadcast over views and points, DN unless said).
"""

from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np


class Place(Enum):
    """Where an effect acts, in the order of the chain. After the view, every function gets its parameters by name."""

    EXPOSURE = "exposure"  # (view, nominal exposure [s]) → exposure [s]
    WIDTH = "width"  # (view, p_b at the reference exposure [px], exposure over that one) → p_b [px]
    BRIGHTNESS = "brightness"  # (view) → factor on the spot's light
    METRIC = "metric"  # (view, dx, dy [px]) → dx, dy of an equivalent round spot
    PROFILE = "profile"  # (view, ρ²/2) → exponent of the shape, exp(−…)
    BLUR = "blur"  # (view) → shifts dx, dy [px] and weights, over which the spot is averaged
    ADDED = "added"  # (view, spot, amplitude, σ_g) → light; spot(dx, dy) is the spot displaced by so many px
    MODULATION = "modulation"  # (view) → factor on all light so far
    PEDESTAL = "pedestal"  # (view) → light
    CHARGE = "charge"  # (view, electrons) → electrons, after the Poisson draw
    WELL = "well"  # (mean, variance [DN], read variance [DN²]) → mean, variance without read noise
    NOISE = "noise"  # (read variance [e-²]) → read variance [e-²]
    RESPONSE = "response"  # (mean, variance, full scale [DN]) → mean, variance of the signal without black level
    DIGITAL = "digital"  # () → the signal [DN] below which a reading is 0, or that is taken off, by its form
    SCATTER = "scatter"  # no mean of its own: see `Scatter`


class Scatter(NamedTuple):
    """A random field or number: of what (`gain`, `centre`, `row`, `field`), the same for each `frame`, `site` or for
    the `sensor`."""

    of: str
    shared: str


class Context(NamedTuple):
    """What bounds and starts may depend on: σ_g [px] at the longest exposure, brightest light [DN], full scale [DN],
    crop [px], shortest exposure [s], read noise [e-], gain [DN/e-], and the power of t that p1 and p2 come nearest
    to."""

    sigma_px: float
    peak_dn: float
    full_scale_dn: float
    crop_px: float
    shortest_s: float
    read_noise_e: float
    gain_dn_per_e: float
    exponent: float


class Parameter(NamedTuple):
    """Name, unit, lowest and highest value (numbers, or functions of the context). `inner` marks a constant of the form
    that the dataset contract leaves free: it is fitted, and reported as part of the form."""

    name: str
    unit: str
    low: float | Callable[[Context], float]
    high: float | Callable[[Context], float]
    inner: bool = False


class Effect(NamedTuple):
    """One effect. `number` is its place in the vocabulary. `neutral` is the strength (the first parameter) at which it
    vanishes; `starts` lists where its fit begins, one value a parameter; `forms` the forms among which the data
    choose; `replaces` the baseline's parameters that lose their meaning; `needs` what a design must vary for it to
    show ("exposure", "three exposures", "angle", "order", "frames", "law" for a law of the light in exposure); `idle`
    the parameters that a form does not have; `rounded` the forms whose strength [DN] shows in readings as a whole
    number."""

    number: int
    name: str
    sentence: str
    place: Place
    parameters: tuple[Parameter, ...]
    starts: Callable[[Context], Sequence[tuple[float, ...]]]
    function: Callable[..., Any] | None = None
    forms: tuple[str, ...] = ("",)
    neutral: float = 0.0
    replaces: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    scatter: Scatter | None = None
    idle: Mapping[str, tuple[str, ...]] = MappingProxyType({})
    rounded: tuple[str, ...] = ()

    def bounds(self, context: Context) -> np.ndarray:
        """Lowest and highest value of each parameter [parameter, 2]."""
        return np.array(
            [[end(context) if callable(end) else end for end in (p.low, p.high)] for p in self.parameters], dtype=float
        )


class Present(NamedTuple):
    """An effect in a model: which, in which form, and the values of its parameters."""

    effect: Effect
    form: str
    values: tuple[float, ...]

    def named(self) -> dict[str, float]:
        """Parameters by name."""
        return {p.name: v for p, v in zip(self.effect.parameters, self.values, strict=True)}

    def apply(self, *arguments: Any) -> Any:
        """Call the effect's function with its parameters, and its form where there is a choice."""
        assert self.effect.function is not None
        extra = {"form": self.form} if len(self.effect.forms) > 1 else {}
        return self.effect.function(*arguments, **self.named(), **extra)
