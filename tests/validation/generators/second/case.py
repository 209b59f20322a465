"""What a dataset is before anything is rendered: its grid of frames, its camera, its base spot and its effects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

LONG, MIDDLE, SHORT = 9e-4, 3e-4, 1e-4  # s
CROP = 240  # px
BITS = 10
FULL_SCALE = 2**BITS - 1  # DN
OPTICS = {"focal_length_m": 0.0502, "working_distance_m": 0.25, "f_number": 11.0, "filter_transmission": 0.9193}
LASER = {"power_w": 0.001, "wavelength_m": 6.5e-7, "fwhm_x_m": 72.8e-6, "fwhm_y_m": 80.4e-6}
PIXEL_PITCH = 5.5e-6  # m
MAGNIFICATION = OPTICS["focal_length_m"] / OPTICS["working_distance_m"]
# The image of the laser's own width [px].
LASER_WIDTH = MAGNIFICATION * (LASER["fwhm_x_m"] + LASER["fwhm_y_m"]) / 2 / 2.3548 / PIXEL_PITCH


@dataclass(frozen=True)
class Frame:
    """One spot frame: angle [deg], exposure [s], repeat, and the index of its (angle, repeat) site."""

    angle: float
    exposure: float
    repeat: int
    site: int


@dataclass
class Effect:
    """One hidden effect. `at(s)` turns a strength s into the contract's parameters; the rest fixes its form.

    `start`, `floor` and `cap` are a usual, the least and the largest s. `stage` and `hook` belong to mechanisms outside
    the vocabulary, which act through `Case.apply`; `variance(s)` is the factor on the shot-noise variance.
    """

    at: Callable[[float], dict[str, float]]
    form: dict[str, object]
    start: float
    cap: float
    seed: int = 0
    floor: float = 0.0
    state: dict[str, np.ndarray] = field(default_factory=dict)
    stage: str = ""
    hook: Callable[..., np.ndarray] | None = None
    variance: Callable[[float], float] = lambda s: 1.0
    name: str = ""
    s: float = 0.0

    def __getitem__(self, key: str) -> float:
        return self.at(self.s)[key]


@dataclass
class Case:
    """Everything that a dataset is made of. Lengths in px, light and levels in DN, noise in electrons."""

    seed: int
    design: str
    frames: list[Frame]
    size: int
    gain: float  # DN/e-
    read_noise: float  # e- rms
    dark_current: float  # e-/s
    black: int  # DN
    budget: str
    p1: float  # px
    p2: float  # px
    peak: float  # DN, amplitude A at the longest exposure
    centres: np.ndarray  # px, (site, [x, y])
    effects: dict[str, Effect] = field(default_factory=dict)
    # The light's shape, as `light.beams.Beam` has it, in u = (x − x₀)/σ and v = (y − y₀)/σ; None for a Gaussian.
    shape: Any = None
    full_well: float = np.inf  # e-

    @property
    def exposures(self) -> list[float]:
        """Nominal exposures [s], ascending."""
        return sorted({frame.exposure for frame in self.frames})

    @property
    def plateau(self) -> float:
        """Highest base light [DN]."""
        return self.peak * (self.shape.top if self.shape else 1.0)

    def get(self, name: str) -> Effect | None:
        """The effect of this name, if the case has it."""
        return self.effects.get(name)

    def only(self, *effects: Effect) -> Case:
        """The same case with these effects alone."""
        return replace(self, effects={effect.name: effect for effect in effects})

    def apply(self, stage: str, value, i: int, *extra):
        """Let every mechanism outside the vocabulary that acts at `stage` change `value` in frame i."""
        for effect in self.effects.values():
            if effect.stage == stage:
                value = effect.hook(value, i, effect.s, *extra)
        return value
