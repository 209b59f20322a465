"""Effects of the sensor and its electronics."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from rig.hidden.base import Base
from rig.hidden.clipping import clip_above
from rig.hidden.designs import FRAME_PX, Shot
from rig.hidden.effect import Array, Effect, Moments, Signed
from rig.hidden.strength import Reference, evidence
from rig.hidden.world import View


@dataclass(frozen=True)
class Smear(Effect):
    """Every column's electrons spread evenly over all its rows, on top of what is there; strength: fraction [1]."""

    name = "smear"
    parameter = "fraction"
    limits = 1e-6, 0.3

    def electrons(self, electrons: Array, view: View) -> Array:
        # A thinned view holds every thin-th row of the lit part of the column.
        return electrons + self.strength * view.thin / FRAME_PX * electrons.sum(axis=0)

    def electron_moments(self, mean: Array, variance: Array, view: View) -> Moments:
        return self.electrons(mean, view), variance


@dataclass(frozen=True)
class Saturation(Effect):
    """The signal stops at a level [DN above black level]; strength: brightest light / level [1].

    Hard: min(e, level/K). Soft: e (1 + (e K/level)^order)^(-1/order). Before read noise (a well) or after it.
    """

    plateau: float = 1.0  # brightest light of the baseline [DN]
    gain: float = 1.0
    stage: str = "before read noise"
    order: float = 0.0  # 0: hard
    name = "saturation"

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        order = rng.uniform(4.0, 12.0) if rng.random() < 0.5 else 0.0
        return cls(0.0, base.plateau_dn, base.gain, str(rng.choice(["before read noise", "after read noise"])), order)

    def span(self, base: Base) -> tuple[float, float]:
        return (0.2 if self.order else 0.8), 4.0

    def parameters(self) -> dict[str, float]:
        return {"level": self.plateau / self.strength}

    def form(self) -> dict[str, Any]:
        knee = {"knee": "soft", "order": self.order} if self.order else {"knee": "hard"}
        return knee | {"clips": self.stage}

    @property
    def level_e(self) -> float:
        """The level [e-]."""
        return self.plateau / self.strength / self.gain

    def _clip(self, electrons: Array) -> Array:
        if not self.order:
            return np.minimum(electrons, self.level_e)
        part = np.maximum(electrons / self.level_e, 0.0) ** self.order
        return electrons * (1.0 + part) ** (-1.0 / self.order)

    def _clip_moments(self, mean: Array, variance: Array) -> Moments:
        if not self.order:
            return clip_above(mean, variance, self.level_e)
        part = np.maximum(mean / self.level_e, 0.0) ** self.order
        return mean * (1.0 + part) ** (-1.0 / self.order), variance * (1.0 + part) ** (-2.0 / self.order - 2.0)

    def electrons(self, electrons: Array, view: View) -> Array:
        return self._clip(electrons) if self.stage == "before read noise" else electrons

    def electron_moments(self, mean: Array, variance: Array, view: View) -> Moments:
        return self._clip_moments(mean, variance) if self.stage == "before read noise" else (mean, variance)

    def read(self, electrons: Array) -> Array:
        return self._clip(electrons) if self.stage == "after read noise" else electrons

    def read_moments(self, mean: Array, variance: Array, base: Base) -> Moments:
        return self._clip_moments(mean, variance) if self.stage == "after read noise" else (mean, variance)


@dataclass(frozen=True)
class ExcessReadNoise(Effect):
    """More read noise than stated; strength: total variance / stated variance - 1."""

    stated: float = 1.0  # [e-]
    name = "excess_read_noise"
    limits = 1e-5, 24.0

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, base.read_noise)

    def parameters(self) -> dict[str, float]:
        return {"total": self.stated * math.sqrt(1.0 + self.strength)}

    def read_noise(self, noise: Array) -> Array:
        return noise * math.sqrt(1.0 + self.strength)

    def read_moments(self, mean: Array, variance: Array, base: Base) -> Moments:
        return mean, variance + self.strength * base.read_noise**2


@dataclass(frozen=True)
class Nonlinearity(Signed):
    """y - q y^2 / full scale of the signal y without black level; strength |q| [1]."""

    name = "nonlinearity"
    parameter = "q"
    limits = 1e-6, 0.3

    def signal(self, signal: Array, base: Base) -> Array:
        return signal - self.sign * self.strength / base.full_scale * signal**2

    def signal_moments(self, mean: Array, variance: Array, base: Base) -> Moments:
        bend = self.sign * self.strength / base.full_scale
        return mean - bend * (mean**2 + variance), variance * (1.0 - 2.0 * bend * mean) ** 2


@dataclass(frozen=True)
class RowNoise(Effect):
    """Whole rows scatter together, anew in every frame; strength: Gaussian rms [DN]."""

    name = "row_noise"
    parameter = "rms"
    scatters = True

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-4, 0.05 * base.full_scale

    def reading(self, reading: Array, view: View, rng: np.random.Generator) -> Array:
        reading += self.strength * rng.standard_normal((view.y.size, 1))
        return reading

    def scatter_snr2(self, reference: Reference) -> float:
        per_row = reference.per_pixel(reference.d_reading).sum(axis=-1) * reference.thin
        return float(evidence(self.strength**2 * per_row).sum()) * reference.thin


@dataclass(frozen=True)
class FixedPattern(Effect):
    """Gaussian pixel gains, hot pixels, or both, the same in every frame. Strength: PRNU, or else the height [DN].

    `hot_pixels` counts them in the whole frame; each adds its own constant (0.3 to 2 times `hot_dn`) at every exposure.
    """

    kind: str = "prnu"
    hot_pixels: int = 0
    hot_ratio: float = 0.0  # height of a hot pixel [DN] per unit of strength
    seed: int = 0
    name = "fixed_pattern"
    scatters = True

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        kind = str(rng.choice(["prnu", "hot", "both"]))
        number = 0 if kind == "prnu" else round(math.exp(rng.uniform(math.log(10.0), math.log(300.0))))
        ratio = {"prnu": 0.0, "hot": 1.0, "both": base.full_scale * rng.uniform(0.3, 2.0)}[kind]
        return cls(0.0, kind, number, ratio, int(rng.integers(2**63)))

    def span(self, base: Base) -> tuple[float, float]:
        return (1e-3, 0.3 * base.full_scale) if self.kind == "hot" else (1e-5, 0.1)

    @property
    def prnu(self) -> float:
        """Relative rms of the pixel gains [1]."""
        return 0.0 if self.kind == "hot" else self.strength

    @property
    def hot_dn(self) -> float:
        """Height of the hot pixels [DN]."""
        return self.strength * self.hot_ratio

    def parameters(self) -> dict[str, float]:
        return {"prnu": self.prnu, "hot_pixels": float(self.hot_pixels)}

    def form(self) -> dict[str, Any]:
        return {"pattern": self.kind, "hot_dn": self.hot_dn}

    def light(self, light: Array, view: View) -> Array:
        if self.prnu:
            light *= np.maximum(1.0 + self.prnu * view.of(_pixel_scores(self.seed)), 0.0)
        return light

    def reading(self, reading: Array, view: View, rng: np.random.Generator) -> Array:
        if self.hot_pixels:
            y, x, height = _hot_pixels(self.seed, self.hot_pixels)
            reading[y, x] += self.hot_dn * height
        return reading

    def scatter_snr2(self, reference: Reference) -> float:
        gains = reference.per_pixel(reference.d_log_peak).sum(axis=(0, 1))
        total = float(evidence(self.prnu**2 * gains).sum()) * reference.thin**2
        if self.hot_pixels:
            typical = float(np.median(reference.per_pixel(reference.d_reading).sum(axis=(0, 1))))
            _, _, height = _hot_pixels(self.seed, self.hot_pixels)
            total += float(evidence((self.hot_dn * height) ** 2 * typical).sum())
        return total


@dataclass(frozen=True)
class BlackClipping(Effect):
    """The faint border is lost; strength: threshold [DN]. Subtraction: max(y - threshold, 0); dead zone: 0 below it.

    ASSUME: a converter that loses the border has no black level to protect it: hidden only where the black level is 0.
    """

    by: str = "subtraction"
    name = "black_clipping"
    parameter = "threshold"

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, str(rng.choice(["subtraction", "dead zone"])))

    def span(self, base: Base) -> tuple[float, float]:
        # A dead zone below half a step is no more than the rounding.
        return (1e-3 if self.by == "subtraction" else 0.5), 0.2 * base.full_scale

    def form(self) -> dict[str, Any]:
        return {"by": self.by}

    def zero(self) -> tuple[float, float]:
        return (self.strength, 0.0) if self.by == "subtraction" else (0.0, self.strength)


@functools.lru_cache(maxsize=4)
def _pixel_scores(seed: int) -> np.ndarray:
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(0,))))
    return rng.standard_normal((FRAME_PX, FRAME_PX))


@functools.lru_cache(maxsize=16)
def _hot_pixels(seed: int, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and relative heights; no pixel twice."""
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(1,))))
    where = rng.choice(FRAME_PX**2, size=number, replace=False)
    return where // FRAME_PX, where % FRAME_PX, rng.uniform(0.3, 2.0, size=number)
