"""What an effect is: a name, a sentence, parameters, the place in the chain where it acts, and a function.

One file holds one effect, and nothing else has to know of it: what fits, searches, verdicts and pages need to know is
in the fields of `Effect`. The places are those of the dataset contract's order; each says what the function gets and
returns (arrays broadcast over views and points, DN unless said).
"""

from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from spotcheck.old_engine.model.sensor import SensorModel


class Place(Enum):
    """Where an effect acts, in the order of the chain. After the view, every function gets its parameters by name."""

    EXPOSURE = "exposure"  # (view, nominal exposure [s]) → exposure [s]
    WIDTH = "width"  # (view, p_b at the reference exposure [px], exposure over that one) → p_b [px]
    BRIGHTNESS = "brightness"  # (view) → factor on the spot's light
    METRIC = "metric"  # (view, dx, dy [px]) → dx, dy of an equivalent round spot
    PROFILE = "profile"  # (view, ρ²/2) → exponent of the shape, exp(−…)
    SHAPE = "shape"  # no function: the surface that the baseline has beside the declared shape (`LightShape`)
    BLUR = "blur"  # (view) → shifts dx, dy [px] and weights, over which the spot is averaged
    ADDED = "added"  # (view, spot, amplitude, σ_g) → light; spot(dx, dy) is the spot displaced by so many px
    MODULATION = "modulation"  # (view) → factor on all light so far
    PEDESTAL = "pedestal"  # (view) → light [DN], or in a form `electronic` what comes on top of the black level
    CHARGE = "charge"  # (view, electrons) → electrons, after the Poisson draw
    # (mean, variance [DN], read variance [DN²]) → mean, variance without read noise; forms that end in `with noise` act
    # on the signal with its read noise
    WELL = "well"
    NOISE = "noise"  # (read variance [e-²]) → read variance [e-²]
    RESPONSE = "response"  # (mean, variance, full scale [DN]) → mean, variance of the signal without black level
    DIGITAL = "digital"  # () → the signal [DN] below which a reading is 0, or that a form `subtracted` takes off
    SCATTER = "scatter"  # no mean of its own: see `Scatter`


# What a design must vary for an effect to show, in words.
NEEDS = {
    "exposure": "several exposures",
    "three exposures": "three exposures",
    "exposures of a site": "several exposures of a site",
    "angle": "several angles",
    "order": "a known order of acquisition",
    "frames": "several frames of a condition",
    "law": "a law of the light in exposure",
}
# Variance components, and how many parameters a fit tells of each: its root, for pixels also how many are hot, for a
# granular field also its grain.
COMPONENTS = {"row": 1, "pixel": 2, "grain": 2, "gain": 1, "centre": 1}
# What an effect may do to readings that no fitted number describes, so that it does not speak against the effect.
MARKS = ("skewness", "outliers", "hot", "stripes", "code", "columns of a frame")
NO_SPOT = "there is no spot"


class Scatter(NamedTuple):
    """A random field or number: `of` what and `shared` by what, and the variance component that it is to a fit.

    A `gain` (factor on the light), a `centre` (dx, dy [px]), a `row` (offsets [DN]) or a `field` (factors on the
    pixels' light), the same for each `frame`, each `site`, or for the `sensor`. The function gets a generator, before
    it the number of rows for a row and the shape [rows, columns] for a field. Components: `row`, offsets of rows anew
    in every frame; `pixel`, gains of the sensor's pixels; `grain`, a granular field of each site; `gain` and `centre`,
    brightness and place of each frame. Effects of one component cannot be told apart.
    """

    of: str
    shared: str
    component: str


class Context(NamedTuple):
    """What bounds and starts may depend on: σ_g [px] at the longest exposure, brightest light [DN], full scale [DN],
    crop [px], shortest exposure [s], read noise [e-], gain [DN/e-], the power of t that p1 and p2 come nearest to, and
    the longest exposure [s]."""

    sigma_px: float
    peak_dn: float
    full_scale_dn: float
    crop_px: float
    shortest_s: float
    read_noise_e: float
    gain_dn_per_e: float
    exponent: float
    longest_s: float


class Parameter(NamedTuple):
    """Name, unit, lowest and highest value (numbers, or functions of the context). `inner` marks a constant of the form
    that the dataset contract leaves free: it is fitted, and reported as part of the form."""

    name: str
    unit: str
    low: float | Callable[[Context], float]
    high: float | Callable[[Context], float]
    inner: bool = False


class Effect(NamedTuple):
    """One effect.

    What it is:

    - `name`, a word; `sentence`, what a person is told, from a small letter on and without a full stop; `noun`, what
      its strength is the size of, as in "no clip below 930 DN"; without one its parameter's name. `part`: that is a
      part of something, and is said in per cent.
    - `place` in the chain; `function`, as the place says (none at `Place.SHAPE`, whose parameters only describe).
    - `parameters`, the strength first. A verdict reports those that are not `inner`, with their units; of an effect
      that scatters, as many as its component tells (`COMPONENTS`).
    - `starts`: where its fit begins, values of all parameters; none where a shape is learned instead.
    - `number`: its place in the vocabulary, from 1; 0: behind all others. Random draws depend on it.
    - `forms` among which the data choose; `idle`, the parameters that a form does not have or that the means do not
      tell; `rounded`, the forms whose strength [DN] shows in readings as a whole number.
    - `neutral`, the strength at which it vanishes, and `negligible`, how far from it a user would call it nothing (a
      number, or a function of the context); nearer than that it is not named, however surely it is there.
    - `replaces`, the baseline's parameters that lose their meaning.
    - `scatter`, what it draws, for an effect that has no mean of its own.

    How it is found:

    - `needs`, what a design must vary for it to show (keys of `NEEDS`).
    - `contains`, names of effects that are a special case of it, or places of which every effect is one: where both
      explain, the special case is the name.
    - `always`: a search tries it whatever it promises to first order, since from its starts that says little.
    - `spectral`: it is found as a peak of the spectrum that sites share, not from `starts`. Its parameters are depth,
      period, direction and phase, and in the form `site` each site has a phase of its own.
    - `uniform`: as a pedestal it is alike over the whole frame.
    - `marks` that it leaves in readings by its nature (`MARKS`).
    - `flats`: why levels of flats and darks cannot show it; "" where they can.

    What it says of the instrument:

    - `adopts`: from a sensor (`SensorModel`) and its parameters by name, values of keys of instrument.yaml, such as
      "sensor.read_noise_e", with which the baseline does what the effect does; {} for a form that no key describes.
      None: no key describes any.
    """

    name: str
    sentence: str
    place: Place
    parameters: tuple[Parameter, ...]
    starts: Callable[[Context], Sequence[tuple[float, ...]]]
    function: Callable[..., Any] | None = None
    number: int = 0
    forms: tuple[str, ...] = ("",)
    idle: Mapping[str, tuple[str, ...]] = MappingProxyType({})
    rounded: tuple[str, ...] = ()
    neutral: float = 0.0
    negligible: float | Callable[[Context], float] = 0.0
    replaces: tuple[str, ...] = ()
    scatter: Scatter | None = None
    needs: tuple[str, ...] = ()
    contains: tuple[str | Place, ...] = ()
    always: bool = False
    spectral: bool = False
    uniform: bool = False
    marks: tuple[str, ...] = ()
    flats: str = NO_SPOT
    noun: str = ""
    part: bool = False
    adopts: Callable[..., Mapping[str, float]] | None = None

    @property
    def component(self) -> str:
        """The variance component that it is; "" where it is none."""
        return self.scatter.component if self.scatter else ""

    def has_as_special_case(self, other: "Effect") -> bool:
        """Whether another effect is a special case of this one."""
        return other.name in self.contains or other.place in self.contains

    def moves_level(self, form: str) -> bool:
        """Whether a form of it does what another black level would."""
        subtracted = self.place is Place.DIGITAL and form == "subtracted"
        return subtracted or (self.place is Place.PEDESTAL and self.uniform)

    def signs(self, context: Context) -> tuple[int, ...]:
        """On which sides of where it vanishes its strength may lie; none where it vanishes nowhere."""
        low, high = self.bounds(context)[0]
        return tuple(sign for sign, there in ((-1, low < self.neutral), (1, high > self.neutral)) if there)

    def size_text(self, low: str, high: str) -> str:
        """How large it may be, in words, by texts of the ends of what its strength may be; "" for an end that nature or
        nothing sets."""
        noun = self.noun or f"{self.parameters[0].name} of {self.name}"
        if np.isinf(self.neutral):
            return f"no {noun} below {low}" if low else ""
        if low and high:
            return f"{noun} from {low} to {high}"
        return f"{noun} {f'below {high}' if high else f'above {low}'}" if low or high else ""

    def excess(self, strength: float, context: Context) -> float:
        """How far a strength is from where the effect vanishes, in units of what is negligible; infinite where nothing
        is. An effect without a neutral strength vanishes at its lowest."""
        neutral = self.bounds(context)[0, 0] if np.isnan(self.neutral) else self.neutral
        least = self.negligible(context) if callable(self.negligible) else self.negligible
        return np.inf if least == 0 or not np.isfinite(neutral) else abs(strength - neutral) / least

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
        return self.effect.function(*arguments, **self.named(), **self._formed())

    def adopted(self, sensor: SensorModel) -> Mapping[str, float]:
        """Values of keys of instrument.yaml that say of a sensor what the effect says; {} where no key can."""
        return self.effect.adopts(sensor, **self.named(), **self._formed()) if self.effect.adopts else {}

    def _formed(self) -> dict[str, str]:
        return {"form": self.form} if len(self.effect.forms) > 1 else {}
