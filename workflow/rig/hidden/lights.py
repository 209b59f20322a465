"""Effects that add light or modulate it: halo, ghost, fringes, speckle, pedestals."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from rig.hidden import fields
from rig.hidden.base import Base
from rig.hidden.designs import FRAME_PX, Shot
from rig.hidden.effect import Array, Effect, Moments
from rig.hidden.strength import Reference, evidence
from rig.hidden.world import View

CENTRE = (FRAME_PX - 1) / 2


def middle_sigma(base: Base) -> float:
    """The spot's width [px] averaged over the exposures."""
    return sum(base.spread(t) for t in base.exposures_s) / len(base.exposures_s) + base.laser_px


@dataclass(frozen=True)
class ScatterHalo(Effect):
    """A faint component about the spot's centre, its radius the same at every exposure; strength: peak over A [1].

    Profiles in q = r/radius: exp(-q), exp(-q^2/2) or (1 + q^2)^(-power). It is neither cut by the top hat nor blurred.
    """

    radius: float = 1.0  # [px]
    profile: str = "gaussian"
    power: float = 2.0
    name = "scatter_halo"
    limits = 1e-6, 0.3

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        profile = str(rng.choice(["exponential", "gaussian", "power_law"]))
        return cls(0.0, rng.uniform(1.5, 4.0) * middle_sigma(base), profile, rng.uniform(1.5, 3.0))

    def parameters(self) -> dict[str, float]:
        return {"fraction": self.strength, "radius": self.radius}

    def form(self) -> dict[str, Any]:
        return {"profile": self.profile} | ({"power": self.power} if self.profile == "power_law" else {})

    def light(self, light: Array, view: View) -> Array:
        peak = self.strength * view.state.peak
        u, v = view.dx / self.radius, view.dy / self.radius
        if self.profile == "gaussian":
            light += peak * np.exp(-0.5 * v**2) * np.exp(-0.5 * u**2)
        elif self.profile == "exponential":
            light += peak * np.exp(-np.sqrt(u**2 + v**2))
        else:
            light += peak * (1.0 + u**2 + v**2) ** -self.power
        return light


@dataclass(frozen=True)
class GhostReflection(Effect):
    """A displaced copy of the spot (with its top hat and blur, without its halo); strength: fraction [1]."""

    dx: float = 0.0  # [px]
    dy: float = 0.0  # [px]
    name = "ghost_reflection"
    limits = 1e-6, 0.4

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        distance, direction = rng.uniform(1.0, 4.0) * middle_sigma(base), rng.uniform(0.0, 2.0 * math.pi)
        return cls(0.0, distance * math.cos(direction), distance * math.sin(direction))

    def parameters(self) -> dict[str, float]:
        return {"fraction": self.strength, "dx": self.dx, "dy": self.dy}

    def light(self, light: Array, view: View) -> Array:
        light += self.strength * view.image(self.dx, self.dy)
        return light


@dataclass(frozen=True)
class InterferenceFringes(Effect):
    """1 + d cos(2 pi u / period + phi) on all light so far, u along `direction`; strength d [1].

    Phase: `sensor` counts u from the frame's centre, `spot` from the spot's, `site` draws phi anew at each site.
    """

    period: float = 10.0  # [px]
    direction: float = 0.0  # [deg], across the stripes
    phase: str = "sensor"
    phi: float = 0.0  # [rad]
    seed: int = 0
    name = "interference_fringes"
    limits = 1e-6, 0.6

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        period = math.exp(rng.uniform(math.log(6.0), math.log(80.0)))
        phase = str(rng.choice(["sensor", "spot", "site"]))
        return cls(
            0.0, period, rng.uniform(0.0, 180.0), phase, rng.uniform(0.0, 2.0 * math.pi), int(rng.integers(2**63))
        )

    def parameters(self) -> dict[str, float]:
        return {"d": self.strength, "period": self.period, "direction": self.direction}

    def form(self) -> dict[str, Any]:
        return {"phase": self.phase}

    def light(self, light: Array, view: View) -> Array:
        phi = self.phi
        x0, y0 = (view.state.x, view.state.y) if self.phase == "spot" else (CENTRE, CENTRE)
        if self.phase == "site":
            phi = _site_phase(self.seed, view.shot.site)
        k = 2.0 * math.pi / self.period
        along_x = k * math.cos(math.radians(self.direction)) * (view.x - x0) + phi
        along_y = k * math.sin(math.radians(self.direction)) * (view.y - y0)
        # cos(a + b) of a row and a column: two products in place of a cosine a pixel.
        light *= (
            1.0
            + np.outer(self.strength * np.cos(along_y), np.cos(along_x))
            - np.outer(self.strength * np.sin(along_y), np.sin(along_x))
        )
        return light


@dataclass(frozen=True)
class Speckle(Effect):
    """Granular field on all light so far, fixed to the sensor at each site, new at each site; strength: contrast [1].

    `grain` is the full width at half height of the field's autocovariance [px]. Field `coherent`: 1 + contrast (S - 1)
    sqrt(N), with S the mean of N independent |E|^2 (speckle over diffuse light); `lognormal`: exp of a Gaussian field.
    """

    grain: float = 4.0
    patterns: int = 0
    seed: int = 0
    name = "speckle"
    scatters = True

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        patterns = int(rng.integers(1, 6)) if rng.random() < 0.6 else 0
        return cls(0.0, rng.uniform(2.0, 12.0), patterns, int(rng.integers(2**63)))

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-5, min(0.6, 1.0 / math.sqrt(max(self.patterns, 1)))

    def parameters(self) -> dict[str, float]:
        return {"contrast": self.strength, "grain": self.grain}

    def form(self) -> dict[str, Any]:
        return {"field": "coherent" if self.patterns else "lognormal", "patterns": self.patterns}

    def light(self, light: Array, view: View) -> Array:
        field = view.of(fields.speckle(self.seed, view.shot.site, self.grain, self.patterns))
        if self.patterns:
            light *= np.maximum(1.0 + self.strength * field, 0.0)
        else:
            scale = math.sqrt(math.log1p(self.strength**2))
            light *= np.exp(scale * field - scale**2 / 2.0)
        return light

    def scatter_snr2(self, reference: Reference) -> float:
        # Modes: cells as large as the integral of the autocovariance, exp(-4 ln 2 r^2 / grain^2).
        cell = max(1.0, math.pi / (4.0 * math.log(2.0)) * self.grain**2)
        per_pixel = reference.per_pixel(reference.d_log_peak).sum(axis=1)  # [site, y, x]
        return float(evidence(self.strength**2 * cell * per_pixel).sum()) * reference.thin**2 / cell


@dataclass(frozen=True)
class _Pedestal(Effect):
    """A pedestal in DN, the same at every exposure: as light (with shot noise and pixel gains) or as electronics."""

    source: str = "light"

    def form(self) -> dict[str, Any]:
        return {"source": self.source}

    def pedestal(self, view: View) -> Array | float:
        """The pedestal [DN]."""
        raise NotImplementedError

    def light(self, light: Array, view: View) -> Array:
        if self.source == "light":
            light += self.pedestal(view)
        return light

    def reading(self, reading: Array, view: View, rng: np.random.Generator) -> Array:
        if self.source == "electronics":
            reading += self.pedestal(view)
        return reading

    def reading_moments(self, mean: Array, variance: Array, view: View) -> Moments:
        return (mean + self.pedestal(view) if self.source == "electronics" else mean), variance


@dataclass(frozen=True)
class DarkOffset(_Pedestal):
    """A uniform pedestal; strength: level [DN]."""

    name = "dark_offset"
    parameter = "level"

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, str(rng.choice(["light", "electronics"])))

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-5, 0.08 * base.full_scale

    def pedestal(self, view: View) -> float:
        return self.strength


@dataclass(frozen=True)
class BackgroundGradient(_Pedestal):
    """A pedestal that rises across the frame and is nowhere negative; strength: slope [DN / 100 px].

    The level at the frame's centre, ((columns - 1)/2, (rows - 1)/2), is `lift` times the slope.
    """

    direction: float = 0.0  # [deg], uphill
    lift: float = 2.0
    name = "background_gradient"

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        direction = rng.uniform(0.0, 2.0 * math.pi)
        farthest = CENTRE / 100.0 * (abs(math.cos(direction)) + abs(math.sin(direction)))
        source = str(rng.choice(["light", "electronics"]))
        return cls(0.0, source, math.degrees(direction), farthest * rng.uniform(1.0, 1.6))

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-5, 0.03 * base.full_scale

    def parameters(self) -> dict[str, float]:
        return {"level": self.lift * self.strength, "slope": self.strength, "direction": self.direction}

    def pedestal(self, view: View) -> Array:
        direction = math.radians(self.direction)
        across = math.cos(direction) * (view.x - CENTRE) + math.sin(direction) * (view.y - CENTRE)[:, None]
        # Rounding at the lowest corner may leave -1e-15.
        return self.strength * np.maximum(self.lift + across / 100.0, 0.0)


@functools.lru_cache(maxsize=1024)
def _site_phase(seed: int, site: int) -> float:
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(site,))))
    return float(rng.uniform(0.0, 2.0 * math.pi))
