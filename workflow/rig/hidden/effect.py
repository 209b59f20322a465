"""Base class of hidden effects: a strength, fixed structure, and hooks into the chain that do nothing by default.

Light is in DN (without black level), electrons in e-. The hooks of moments give mean and variance of the draws; the
strength is found with the moments, the frames are made with the draws.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

if TYPE_CHECKING:
    from rig.hidden.base import Base
    from rig.hidden.designs import Shot
    from rig.hidden.strength import Reference
    from rig.hidden.world import State, View

Array = np.ndarray
Moments = tuple[Array, Array]


@dataclass(frozen=True)
class Effect:
    """An effect of given `strength` (its main number, always positive; the unit is the effect's own)."""

    strength: float

    name: ClassVar[str]
    parameter: ClassVar[str]  # the contract's name of the strength
    limits: ClassVar[tuple[float, float]]  # smallest and largest strength that makes physical sense
    scatters: ClassVar[bool] = False  # changes the scatter between frames or pixels, not their expectation

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        """An effect with structure at random; its strength is set later."""
        return cls(0.0)

    def at(self, strength: float) -> Self:
        """The same effect with another strength."""
        return dataclasses.replace(self, strength=strength)

    def span(self, base: Base) -> tuple[float, float]:
        """Smallest and largest strength; those of a class are `limits` unless they depend on the baseline."""
        return self.limits

    def parameters(self) -> dict[str, float]:
        """The contract's parameters."""
        return {self.parameter: self.strength}

    def form(self) -> dict[str, Any]:
        """What the contract leaves free."""
        return {}

    def rebased(self, base: Base) -> Base:
        """The baseline that this effect departs from: only a law that takes another one's place needs its own."""
        return base

    def scatter_snr2(self, reference: Reference) -> float:
        """Squared signal-to-noise of an effect that scatters (twice the expected log-likelihood ratio)."""
        return 0.0

    # One number a frame.

    def time(self, t: float) -> float:
        """The true exposure [s]."""
        return t

    def spread(self, spread: float, t: float) -> float:
        """The spread p_b [px]."""
        return spread

    def brightness(self, shot: Shot) -> float:
        """A factor on the peak."""
        return 1.0

    def shift(self, shot: Shot) -> tuple[float, float]:
        """Displacement of the centre [px]."""
        return 0.0, 0.0

    def ellipse(self, shot: Shot) -> tuple[float, float]:
        """Long over short axis, and the long axis' direction [rad] from +x towards +y."""
        return 1.0, 0.0

    def flank(self) -> float:
        """Exponent n of exp(-(rho^2/2)^n)."""
        return 1.0

    def smear_path(self, state: State) -> tuple[float, float]:
        """Length [px] of a uniform motion during the exposure, and its direction [rad]."""
        return 0.0, 0.0

    # Pictures.

    def light(self, light: Array, view: View) -> Array:
        """Light on the sensor [DN]."""
        return light

    def electrons(self, electrons: Array, view: View) -> Array:
        """Electrons before read noise."""
        return electrons

    def electron_moments(self, mean: Array, variance: Array, view: View) -> Moments:
        """Moments of `electrons`."""
        return mean, variance

    def read_noise(self, noise: Array) -> Array:
        """Read noise [e-] of one frame."""
        return noise

    def read(self, electrons: Array) -> Array:
        """Electrons after read noise."""
        return electrons

    def read_moments(self, mean: Array, variance: Array, base: Base) -> Moments:
        """Moments of `read_noise` and `read`."""
        return mean, variance

    def signal(self, signal: Array, base: Base) -> Array:
        """Signal [DN] without black level."""
        return signal

    def signal_moments(self, mean: Array, variance: Array, base: Base) -> Moments:
        """Moments of `signal`."""
        return mean, variance

    def reading(self, reading: Array, view: View, rng: np.random.Generator) -> Array:
        """Reading [DN] with black level, before the rounding."""
        return reading

    def zero(self) -> tuple[float, float]:
        """Return the offset [DN] that the converter subtracts, and the reading [DN] below which it shows 0."""
        return 0.0, 0.0

    def reading_moments(self, mean: Array, variance: Array, view: View) -> Moments:
        """Moments of `reading`."""
        return mean, variance


@dataclass(frozen=True)
class Signed(Effect):
    """An effect of either sign."""

    sign: float = 1.0

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, sign=float(rng.choice([-1.0, 1.0])))

    def parameters(self) -> dict[str, float]:
        return {self.parameter: self.sign * self.strength}
