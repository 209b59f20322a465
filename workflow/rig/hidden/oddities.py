"""Mechanisms outside the vocabulary that act on light: what the spot looks like, and how its width scatters.

A pixel gain fixed to the sensor (dust on the cover glass, vignetting, two taps of different gain) is `fixed_pattern` by
the contract's words, and an image that lags behind is mostly `photon_budget`: neither is here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from rig.hidden.base import Base
from rig.hidden.designs import Shot
from rig.hidden.effect import Array, Effect
from rig.hidden.laws import scores
from rig.hidden.lights import middle_sigma
from rig.hidden.strength import Reference, evidence
from rig.hidden.world import View


@dataclass(frozen=True)
class _Lobed(Effect):
    """Contours sigma (1 + strength cos m(theta - theta0)) about the centre, fixed to the camera."""

    theta0: float = 0.0  # [deg]

    lobes = 3

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, rng.uniform(0.0, 360.0))

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-4, 0.25

    def parameters(self) -> dict[str, float]:
        return {"depth": self.strength, "theta0_deg": self.theta0}

    def warp(self, rho2: Array, dx: Array, dy: Array) -> Array:
        # r^m cos m theta is the real part of (dx + i dy)^m; (1 + rho^m) keeps the centre smooth.
        phase = np.exp(-1j * self.lobes * math.radians(self.theta0))
        wave = ((dx + 1j * dy) ** self.lobes * phase).real / (1.0 + rho2 ** (self.lobes / 2))
        return rho2 / (1.0 + self.strength * wave) ** 2


@dataclass(frozen=True)
class Trefoil(_Lobed):
    """A three-cornered spot."""

    name = "trefoil"


@dataclass(frozen=True)
class SquareSpot(_Lobed):
    """A four-cornered spot."""

    name = "square_spot"
    lobes = 4


@dataclass(frozen=True)
class Coma(Effect):
    """Flanks that reach further on one side: the radius shrinks by 1 + c rho^2 cos(theta - theta0) / (1 + rho^2)."""

    theta0: float = 0.0  # [deg], where the tail points
    name = "coma"

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, rng.uniform(0.0, 360.0))

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-4, 0.4

    def parameters(self) -> dict[str, float]:
        return {"c": self.strength, "theta0_deg": self.theta0}

    def warp(self, rho2: Array, dx: Array, dy: Array) -> Array:
        direction = math.radians(self.theta0)
        along = math.cos(direction) * dx + math.sin(direction) * dy
        return rho2 / (1.0 + self.strength * along * np.sqrt(rho2) / (1.0 + rho2)) ** 2


@dataclass(frozen=True)
class Donut(Effect):
    """A share of the ring mode TEM01*: (1 - f + f rho^2 / 2) exp(-rho^2/2). From f = 0.5 on the centre is a dip.

    A small share is a change of width, and then of the flanks; so the share is large, whatever its signal-to-noise.
    """

    name = "donut"

    def span(self, base: Base) -> tuple[float, float]:
        return 0.6, 0.9

    def parameters(self) -> dict[str, float]:
        return {"share": self.strength}

    def warp(self, rho2: Array, dx: Array, dy: Array) -> Array:
        return rho2 - 2.0 * np.log(1.0 - self.strength + self.strength * rho2 / 2.0)


@dataclass(frozen=True)
class RingModulation(Effect):
    """Rings about the spot's centre: 1 + d cos(2 pi r / period + phi), finer than the spot is wide."""

    period: float = 8.0  # [px]
    phi: float = 0.0  # [rad]
    name = "ring_modulation"
    rank = 12

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, rng.uniform(0.3, 0.8) * middle_sigma(base), rng.uniform(0.0, 2.0 * math.pi))

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-4, 0.6

    def parameters(self) -> dict[str, float]:
        return {"d": self.strength, "period_px": self.period, "phi_rad": self.phi}

    def light(self, light: Array, view: View) -> Array:
        radius = np.hypot(view.dx, view.dy)
        return light * (1.0 + self.strength * np.cos(2.0 * math.pi / self.period * radius + self.phi))


@dataclass(frozen=True)
class BeamShadow(Effect):
    """Dust in the beam: a dark soft disc that moves with the spot; strength: depth [1]."""

    dx: float = 0.0  # [px]
    dy: float = 0.0  # [px]
    radius: float = 4.0  # [px]
    name = "beam_shadow"
    rank = 12

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        distance, direction = rng.uniform(0.4, 1.3) * middle_sigma(base), rng.uniform(0.0, 2.0 * math.pi)
        return cls(0.0, distance * math.cos(direction), distance * math.sin(direction), rng.uniform(2.5, 6.0))

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-4, 0.9

    def parameters(self) -> dict[str, float]:
        return {"depth": self.strength, "dx_px": self.dx, "dy_px": self.dy, "radius_px": self.radius}

    def light(self, light: Array, view: View) -> Array:
        distance2 = ((view.dx - self.dx) ** 2 + (view.dy - self.dy) ** 2) / self.radius**2
        return light * (1.0 - self.strength * np.exp(-(distance2**2)))


@dataclass(frozen=True)
class WidthAngle(Effect):
    """The spread, not the brightness alone, follows the angle: p_b (1 + w cos 2(gamma - gamma0)); strength w [1]."""

    gamma0: float = 0.0  # [deg]
    name = "width_angle"

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, gamma0=rng.uniform(0.0, 180.0))

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-5, 0.2

    def parameters(self) -> dict[str, float]:
        return {"w": self.strength, "gamma0_deg": self.gamma0}

    def spread(self, spread: float, t: float, shot: Shot) -> float:
        return spread * (1.0 + self.strength * math.cos(2.0 * math.radians(shot.angle_deg - self.gamma0)))


@dataclass(frozen=True)
class WidthScatter(Effect):
    """The spread scatters from site to site, the same at all exposures of a site; strength: rms fraction [1]."""

    seed: int = 0
    sites: int = 1
    name = "width_scatter"
    scatters = True

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, int(rng.integers(2**63)), 1 + max(shot.site for shot in shots))

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-5, 0.15

    def parameters(self) -> dict[str, Any]:
        return {"rms": self.strength}

    def spread(self, spread: float, t: float, shot: Shot) -> float:
        return spread * max(0.5, 1.0 + self.strength * float(scores(self.seed, self.sites, "gaussian")[shot.site]))

    def scatter_snr2(self, reference: Reference) -> float:
        base = reference.world.base
        middle = middle_sigma(base) - base.laser_px
        per_site = reference.information(reference.d_p2).sum(axis=1)
        return float(evidence((self.strength * middle) ** 2 * per_site).sum()) * (1.0 - 1.0 / per_site.size)
