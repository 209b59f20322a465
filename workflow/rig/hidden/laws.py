"""Effects on one number a frame: brightness, exposure, width or centre as a law of angle, exposure, order or chance."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from rig.hidden.base import Base
from rig.hidden.designs import Shot
from rig.hidden.effect import Effect, Signed
from rig.hidden.strength import Reference, evidence


@dataclass(frozen=True)
class AngleReflectance(Effect):
    """Brightness follows the angle: 1 + d cos 2(gamma - gamma0); strength d [1]."""

    gamma0: float = 0.0  # [deg]
    name = "angle_reflectance"
    limits = 1e-5, 0.5

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, gamma0=rng.uniform(0.0, 180.0))

    def parameters(self) -> dict[str, float]:
        return {"d": self.strength, "gamma0": self.gamma0}

    def brightness(self, shot: Shot) -> float:
        return 1.0 + self.strength * math.cos(2.0 * math.radians(shot.angle_deg - self.gamma0))


@dataclass(frozen=True)
class PhotonBudget(Signed):
    """Light by another power of the exposure: (t / t_max)^q, t as in the manifest; strength |q| [1]."""

    t_max: float = 1.0
    name = "photon_budget"
    parameter = "q"
    limits = 1e-5, 1.0

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, sign=float(rng.choice([-1.0, 1.0])), t_max=max(base.exposures_s))

    def brightness(self, shot: Shot) -> float:
        return (shot.exposure_s / self.t_max) ** (self.sign * self.strength)


@dataclass(frozen=True)
class ShutterOffset(Signed):
    """The true exposure is the nominal one plus a constant, for width, light, dark and motion; strength |s| [s]."""

    name = "shutter_offset"
    parameter = "offset"

    def span(self, base: Base) -> tuple[float, float]:
        return 1e-5 * min(base.exposures_s), 0.5 * min(base.exposures_s)

    def time(self, t: float) -> float:
        return t + self.sign * self.strength


@dataclass(frozen=True)
class SpreadLaw(Effect):
    """The spread is a power of the exposure, p_ref (t / t_ref)^exponent, not p1 ln t + p2; strength: exponent [1].

    The peak follows the new spread by the stated photon budget. The baseline beside it is the tangent at t_ref.
    """

    t_ref: float = 1.0  # [s]
    spread_ref: float = 1.0  # [px]
    name = "spread_law"
    parameter = "exponent"

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        t_ref = math.exp(sum(math.log(t) for t in base.exposures_s) / len(base.exposures_s))
        return cls(0.0, t_ref=t_ref, spread_ref=base.spread(t_ref))

    def span(self, base: Base) -> tuple[float, float]:
        # ASSUME: the widest spot stays within the crop, 42 px rms, and the narrowest above 8 px.
        largest = min(math.log(42.0 / self.spread_ref), math.log(self.spread_ref / 8.0))
        return 0.01, largest / math.log(max(base.exposures_s) / self.t_ref)

    def form(self) -> dict[str, Any]:
        return {"t_ref_s": self.t_ref, "spread_ref_px": self.spread_ref}

    def rebased(self, base: Base) -> Base:
        p1 = self.strength * self.spread_ref
        return dataclasses.replace(base, p1=p1, p2=self.spread_ref - p1 * math.log(self.t_ref))

    def spread(self, spread: float, t: float) -> float:
        # As a factor on the tangent, so that the baseline's own p1 and p2 still move the width.
        steps = math.log(t / self.t_ref)
        return spread * math.exp(self.strength * steps) / (1.0 + self.strength * steps)


@dataclass(frozen=True)
class LaserDrift(Signed):
    """Brightness runs with the order of acquisition, 1 at the first frame; strength: |change| at the last frame [1]."""

    frames: int = 2
    curvature: float = 0.0  # 0: linear; else 1 - exp(-curvature u), scaled to the same total
    name = "laser_drift"
    parameter = "total"
    limits = 1e-5, 0.5

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        curvature = rng.uniform(1.0, 3.0) if rng.random() < 0.3 else 0.0
        return cls(0.0, sign=float(rng.choice([-1.0, 1.0])), frames=len(shots), curvature=curvature)

    def form(self) -> dict[str, Any]:
        return {"law": "settling" if self.curvature else "linear", "curvature": self.curvature}

    def brightness(self, shot: Shot) -> float:
        part = shot.index / (self.frames - 1)
        if self.curvature:
            part = math.expm1(-self.curvature * part) / math.expm1(-self.curvature)
        return 1.0 + self.sign * self.strength * part


@dataclass(frozen=True)
class PowerFluctuation(Effect):
    """Brightness scatters from frame to frame without order; strength: rms fraction [1]."""

    law: str = "gaussian"
    seed: int = 0
    frames: int = 1
    name = "power_fluctuation"
    parameter = "rms"
    limits = 1e-5, 0.2
    scatters = True

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, str(rng.choice(["gaussian", "uniform"])), int(rng.integers(2**63)), len(shots))

    def form(self) -> dict[str, Any]:
        return {"law": self.law}

    def brightness(self, shot: Shot) -> float:
        return max(0.0, 1.0 + self.strength * float(scores(self.seed, self.frames, self.law)[shot.index]))

    def scatter_snr2(self, reference: Reference) -> float:
        per_frame = reference.information(reference.d_log_peak)
        return float(evidence(self.strength**2 * per_frame).sum()) * (1.0 - 1.0 / per_frame.size)


@dataclass(frozen=True)
class PointingJitter(Effect):
    """The centre scatters between the exposures of a site; strength: Gaussian rms along each axis [px]."""

    seed: int = 0
    frames: int = 1
    name = "pointing_jitter"
    parameter = "rms"
    limits = 1e-4, 3.0
    scatters = True

    @classmethod
    def draw(cls, rng: np.random.Generator, base: Base, shots: Sequence[Shot]) -> Self:
        return cls(0.0, int(rng.integers(2**63)), len(shots))

    def shift(self, shot: Shot) -> tuple[float, float]:
        x, y = self.strength * scores(self.seed, 2 * self.frames, "gaussian").reshape(-1, 2)[shot.index]
        return float(x), float(y)

    def scatter_snr2(self, reference: Reference) -> float:
        # The centre of a site is fitted, so that one of its exposures is spent.
        axes = (reference.information(reference.d_x), reference.information(reference.d_y))
        exposures = axes[0].shape[1]
        return float(sum(evidence(self.strength**2 * axis).sum() for axis in axes)) * (1.0 - 1.0 / exposures)


@functools.lru_cache(maxsize=8)
def scores(seed: int, number: int, law: str) -> np.ndarray:
    """Independent scores of mean 0 and variance 1."""
    rng = np.random.Generator(np.random.SFC64(seed))
    return rng.standard_normal(number) if law == "gaussian" else rng.uniform(-math.sqrt(3.0), math.sqrt(3.0), number)
