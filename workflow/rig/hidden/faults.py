"""Mechanisms outside the vocabulary that act in the sensor and its electronics.

A response bent like an S is not here: a soft saturation, a non-linearity and other flanks together explain it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from rig.hidden import fields
from rig.hidden.base import Base
from rig.hidden.designs import CROP_PX, FRAME_PX, Shot
from rig.hidden.effect import Array, Effect, Moments
from rig.hidden.laws import scores
from rig.hidden.strength import Reference, evidence
from rig.hidden.world import View


@dataclass(frozen=True)
class ColumnNoise(Effect):
    """Whole columns scatter together, anew in every frame; strength: Gaussian rms [DN]."""

    name = "column_noise"
    scatters = True

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-3, 0.05 * base.full_scale

    def parameters(self) -> dict[str, float]:
        return {"rms_dn": self.strength}

    def reading(self, reading: Array, view: View, rng: np.random.Generator) -> Array:
        return reading + self.strength * rng.standard_normal((1, view.x.size))

    def scatter_snr2(self, reference: Reference) -> float:
        per_column = reference.per_pixel(reference.d_reading).sum(axis=-2) * reference.thin
        return float(evidence(self.strength**2 * per_column).sum()) * reference.thin


@dataclass(frozen=True)
class BlackWander(Effect):
    """The black level of the whole frame scatters from frame to frame; strength: Gaussian rms [DN]."""

    name = "black_wander"
    scatters = True
    black = True

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-4, 0.25 * base.black_level

    def parameters(self) -> dict[str, float]:
        return {"rms_dn": self.strength}

    def reading(self, reading: Array, view: View, rng: np.random.Generator) -> Array:
        return reading + self.strength * rng.standard_normal()

    def scatter_snr2(self, reference: Reference) -> float:
        return float(evidence(self.strength**2 * reference.information(reference.d_reading)).sum())


@dataclass(frozen=True)
class CorrelatedNoise(Effect):
    """A share of the read noise comes in blotches, anew in every frame; its variance stays. Strength: share [1]."""

    scale: float = 2.0  # rms width [px] of the Gaussian that smooths it
    name = "correlated_noise"
    scatters = True

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, rng.uniform(1.5, 6.0))

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-4, 0.95

    def parameters(self) -> dict[str, float]:
        return {"share": self.strength, "smoothing_px": self.scale}

    def read_noise(self, noise: Array, base: Base, rng: np.random.Generator) -> Array:
        blotches = base.read_noise * fields.smooth_normal(rng, self.scale)
        return math.sqrt(1.0 - self.strength) * noise + math.sqrt(self.strength) * blotches

    def scatter_snr2(self, reference: Reference) -> float:
        # Fourier modes of a frame that is dark at most pixels: power 1 + share x (power of the blotches - 1).
        base = reference.world.base
        part = (base.gain * base.read_noise) ** 2 / float(np.median(reference.variance))
        power = fields.transfer_function(self.scale) ** 2
        change = self.strength * min(part, 1.0) * (power - 1.0)
        frames = reference.mean.shape[0] * reference.mean.shape[1]
        return float(evidence(change).mean()) * CROP_PX**2 * frames


@dataclass(frozen=True)
class ConverterSteps(Effect):
    """Uneven steps of the converter: y + a sin(2 pi (y - black level) / period); strength a [DN]."""

    period: float = 16.0  # [DN]
    name = "converter_steps"

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        # Longer than the noise, or it would blur the steps away.
        noise = math.sqrt(base.gain * base.peak_dn + (base.gain * base.read_noise) ** 2)
        return cls(0.0, rng.uniform(3.0, 6.0) * noise)

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-3, self.period / (2.0 * math.pi)

    def parameters(self) -> dict[str, float]:
        return {"a_dn": self.strength, "period_dn": self.period}

    def reading(self, reading: Array, view: View, rng: np.random.Generator) -> Array:
        return reading + self.strength * np.sin(2.0 * math.pi / self.period * (reading - view.base.black_level))

    def reading_moments(self, mean: Array, variance: Array, view: View) -> Moments:
        k = 2.0 * math.pi / self.period
        seen, phase = self.strength * np.exp(-0.5 * k**2 * variance), k * (mean - view.base.black_level)
        return mean + seen * np.sin(phase), variance * (1.0 + k * seen * np.cos(phase)) ** 2


@dataclass(frozen=True)
class ExcessShotNoise(Effect):
    """Electrons multiply at random: variance F x mean, F > 1; strength F - 1 [1]."""

    name = "excess_shot_noise"

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-3, 3.0

    def parameters(self) -> dict[str, float]:
        return {"fano": 1.0 + self.strength}

    def detect(self, rate: Array, rng: np.random.Generator) -> Array:
        fano = 1.0 + self.strength
        return fano * rng.poisson(rate / fano)

    def electron_moments(self, mean: Array, variance: Array, view: View) -> Moments:
        return mean, (1.0 + self.strength) * variance


@dataclass(frozen=True)
class CosmicRays(Effect):
    """Short bright tracks at random places, anew in every frame; strength: mean height [DN]."""

    hits: float = 5.0  # a frame, on average
    name = "cosmic_rays"
    scatters = True

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, rng.uniform(2.0, 15.0))

    def span(self, base: Base) -> tuple[float, float]:
        # ASSUME: a particle leaves at least ten times the dark pixels' noise, or it would pass for noise.
        noise = math.hypot(base.gain * base.read_noise, math.sqrt(1.0 / 12.0))
        return 10.0 * noise, 100.0 * noise

    def parameters(self) -> dict[str, float]:
        return {"mean_height_dn": self.strength, "hits_per_frame": self.hits}

    def reading(self, reading: Array, view: View, rng: np.random.Generator) -> Array:
        for _ in range(rng.poisson(self.hits)):
            x, y = rng.integers(0, FRAME_PX, size=2)
            dx, dy = rng.uniform(-1.0, 1.0, size=2)
            height = self.strength * (0.3 + rng.exponential(0.7))
            for step in range(int(rng.integers(1, 5))):
                row, column = round(y + step * dy), round(x + step * dx)
                if 0 <= row < FRAME_PX and 0 <= column < FRAME_PX:
                    reading[row, column] += height
        return reading

    def scatter_snr2(self, reference: Reference) -> float:
        frames = reference.mean.shape[0] * reference.mean.shape[1]
        hits = 2.5 * self.hits * frames * (CROP_PX / FRAME_PX) ** 2
        return hits * float(evidence(np.array(self.strength**2 / np.median(reference.variance))))


@dataclass(frozen=True)
class LineJitter(Effect):
    """Rows are displaced along x at random, anew in every frame; strength: Gaussian rms [px]."""

    seed: int = 0
    name = "line_jitter"
    rank = 18
    scatters = True

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, int(rng.integers(2**63)))

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-3, 2.0

    def parameters(self) -> dict[str, Any]:
        return {"rms_px": self.strength}

    def light(self, light: Array, view: View) -> Array:
        if view.thin > 1:
            return light
        shift = self.strength * scores(self.seed + view.shot.index, FRAME_PX, "gaussian")[view.y]
        return np.stack([np.interp(view.x - s, view.x, row) for s, row in zip(shift, light, strict=True)])

    def scatter_snr2(self, reference: Reference) -> float:
        per_row = reference.per_pixel(reference.d_x).sum(axis=-1) * reference.thin
        return float(evidence(self.strength**2 * per_row).sum()) * reference.thin


@dataclass(frozen=True)
class TwoTaps(Effect):
    """The two halves of the sensor have black levels apart; strength: the step [DN]."""

    edge: float = 0.0  # first column of the right half
    sign: float = 1.0
    name = "two_taps"
    black = True

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, float(rng.integers(FRAME_PX // 2 - 20, FRAME_PX // 2 + 21)), float(rng.choice([-1.0, 1.0])))

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-3, base.black_level

    def parameters(self) -> dict[str, float]:
        return {"step_dn": self.sign * self.strength, "edge_px": self.edge}

    def reading(self, reading: Array, view: View, rng: np.random.Generator) -> Array:
        return reading + self._step(view)

    def reading_moments(self, mean: Array, variance: Array, view: View) -> Moments:
        return mean + self._step(view), variance

    def _step(self, view: View) -> Array:
        return 0.5 * self.sign * self.strength * np.where(view.x < self.edge, -1.0, 1.0)
