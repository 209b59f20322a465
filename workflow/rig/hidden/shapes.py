"""Effects on the spot's shape: flanks, ellipses, motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from rig.hidden.base import Base
from rig.hidden.designs import Shot
from rig.hidden.effect import Effect, Signed
from rig.hidden.world import State


@dataclass(frozen=True)
class SuperGaussian(Signed):
    """exp(-(rho^2/2)^n); strength |ln n|, steeper or flatter flanks."""

    name = "super_gaussian"
    limits = 1e-5, math.log(2.0)

    def parameters(self) -> dict[str, float]:
        return {"n": self.flank()}

    def flank(self) -> float:
        return math.exp(self.sign * self.strength)


@dataclass(frozen=True)
class FibreAnisotropy(Effect):
    """An ellipse that turns with the fibres, long axis at ±angle + zero; strength: ln(long axis / short axis)."""

    sense: float = 1.0
    zero_deg: float = 0.0
    name = "fibre_anisotropy"
    limits = 1e-5, math.log(2.0)

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, sense=float(rng.choice([-1.0, 1.0])), zero_deg=rng.uniform(0.0, 180.0))

    def parameters(self) -> dict[str, float]:
        return {"ratio": math.exp(self.strength)}

    def form(self) -> dict[str, Any]:
        return {"sense": self.sense, "zero_deg": self.zero_deg}

    def ellipse(self, shot: Shot) -> tuple[float, float]:
        return math.exp(self.strength), math.radians(self.sense * shot.angle_deg + self.zero_deg)


@dataclass(frozen=True)
class BeamEllipticity(Effect):
    """An ellipse fixed to the camera; strength: ln(long axis / short axis)."""

    direction: float = 0.0  # [deg]
    name = "beam_ellipticity"
    limits = 1e-5, math.log(2.0)

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, direction=rng.uniform(0.0, 180.0))

    def parameters(self) -> dict[str, float]:
        return {"ratio": math.exp(self.strength), "direction": self.direction}

    def ellipse(self, shot: Shot) -> tuple[float, float]:
        return math.exp(self.strength), math.radians(self.direction)


@dataclass(frozen=True)
class MotionBlur(Effect):
    """A uniform smear of length speed · t (true exposure), centred on the spot's centre; strength: speed [px/s]."""

    direction: float = 0.0  # [deg]; the smear is the same for the opposite sense
    name = "motion_blur"

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, direction=rng.uniform(0.0, 180.0))

    def span(self, base: Base) -> tuple[float, float]:
        return 0.02 / max(base.exposures_s), 60.0 / max(base.exposures_s)

    def parameters(self) -> dict[str, float]:
        return {"speed": self.strength, "direction": self.direction}

    def smear_path(self, state: State) -> tuple[float, float]:
        return self.strength * state.t, math.radians(self.direction)
