"""What a dataset is before anything is rendered: its grid of frames, its camera, its base spot and its effects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

LONG, MIDDLE, SHORT = 9e-4, 3e-4, 1e-4  # s
DESIGNS: dict[str, tuple[int, int, tuple[float, ...]]] = {  # angles, repeats, exposures [s]
    "default": (4, 8, (SHORT, MIDDLE, LONG)),
    "two_exposures": (4, 8, (2e-4, 8e-4)),
    "eight_angles": (8, 4, (SHORT, MIDDLE, LONG)),
    "three_repeats": (4, 3, (SHORT, MIDDLE, LONG)),
    "one_exposure": (4, 8, (MIDDLE,)),
    "one_site": (1, 1, (SHORT, MIDDLE, LONG)),
    "single_frame": (1, 1, (LONG,)),
}
CROP = 240  # px
BITS = 10
FULL_SCALE = 2**BITS - 1  # DN
OPTICS = {"focal_length_m": 0.0502, "working_distance_m": 0.25, "f_number": 11.0, "filter_transmission": 0.9193}
LASER = {"power_w": 0.001, "wavelength_m": 6.5e-7, "fwhm_x_m": 72.8e-6, "fwhm_y_m": 80.4e-6}
PIXEL_PITCH = 5.5e-6  # m
FULL_WELL = 13500.0  # e-
LASER_WIDTH = (
    OPTICS["focal_length_m"]
    / OPTICS["working_distance_m"]
    * (LASER["fwhm_x_m"] + LASER["fwhm_y_m"])
    / 2
    / 2.3548
    / PIXEL_PITCH
)  # px, the image of the laser's own width


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

    `unknowns` counts the random numbers hidden in its realisation (0: deterministic). `stage` and `hook` belong to
    mechanisms outside the vocabulary, which act through `Case.apply`. `floor` is the least s, for
    effects that hardly move the mean; `variance(s)` is the factor on the shot-noise variance.
    """

    name: str
    at: Callable[[float], dict[str, float]]
    form: dict[str, object]
    start: float
    cap: float
    unknowns: int = 0
    seed: int = 0
    floor: float = 0.0
    state: dict[str, np.ndarray] = field(default_factory=dict)
    stage: str = ""
    hook: Callable[..., np.ndarray] | None = None
    variance: Callable[[float], float] = lambda s: 1.0
    s: float = 0.0

    def __getitem__(self, key: str) -> float:
        return self.at(self.s)[key]


class Shape(Protocol):
    """The light's shape in u = (x − x₀)/σ, v = (y − y₀)/σ, in peaks of the Gaussian that fits it best; its name, its
    highest value, and its rms off that Gaussian."""

    @property
    def name(self) -> str: ...

    @property
    def top(self) -> float: ...

    @property
    def off(self) -> float: ...

    def __call__(self, u: np.ndarray, v: np.ndarray) -> np.ndarray: ...


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
    shift: int  # bits, left-aligned container
    stacked: bool
    budget: str
    top_hat: bool
    p1: float  # px
    p2: float  # px
    peak: float  # DN, amplitude A at the longest exposure
    centres: np.ndarray  # px, (site, [x, y])
    effects: dict[str, Effect] = field(default_factory=dict)
    shape: Shape | None = None  # a Gaussian if there is none
    full_well: float = np.inf  # e-

    @property
    def exposures(self) -> list[float]:
        """Nominal exposures [s], ascending."""
        return sorted({frame.exposure for frame in self.frames})

    @property
    def plateau(self) -> float:
        """Highest base light [DN]."""
        top = self.shape.top if self.shape else 1.0
        return self.peak * (np.exp(-0.25) if self.top_hat else top)

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


def draw_case(seed: int, design: str, names: list[str]) -> Case:
    """Grid, camera and base spot of a seed. `names` decides only the black level and the frame's size, where an effect
    needs one of them."""
    rng = np.random.default_rng([seed, 0])
    angles, repeats, exposures = DESIGNS[design]
    step = 180.0 / angles
    grid = [(a, r) for r in range(repeats) for a in range(angles)]  # the paper's cycles: the sample turns, then again
    if rng.random() < 0.4:
        grid.sort()
    frames = [Frame(a * step, t, r, a * repeats + r) for a, r in grid for t in exposures]
    p1 = rng.uniform(1.9, 3.0)
    width = rng.uniform(13.0, 17.0)  # px at the geometric mean of the paper's exposures
    p2 = width - p1 * np.log(SHORT * MIDDLE * LONG) / 3
    if len(exposures) == 1:
        p1, p2 = 0.0, p2 + p1 * np.log(exposures[0])
    size = CROP if rng.random() < 0.75 or "smear" in names else CROP + 32
    black = int(rng.choice([0, rng.integers(5, 60)], p=[0.3, 0.7]))
    if "black_clipping" in names:
        black = int(rng.choice([0, 0, 3]))
    if any(name.startswith("outside:") for name in names):
        black = max(black, 24)
    top_hat = bool(rng.random() < 0.5)
    plateau = rng.uniform(0.5, 0.75) * FULL_SCALE
    roam = 5.0 if size == CROP else 14.0
    centres = (size - 1) / 2 + rng.uniform(-roam, roam, (angles * repeats, 2))
    return Case(
        seed=seed,
        design=design,
        frames=frames,
        size=size,
        gain=round(float(np.exp(rng.uniform(np.log(0.07), np.log(0.2)))), 4),
        read_noise=round(rng.uniform(8.0, 20.0), 2),
        dark_current=round(rng.uniform(20.0, 120.0), 1),
        black=black,
        shift=int(rng.choice([0, 0, 0, 16 - BITS])),
        stacked=bool(rng.random() < 0.3),
        budget=str(rng.choice(["spot_area", "linear"])),
        top_hat=top_hat,
        p1=float(p1),
        p2=float(p2),
        peak=float(plateau * (np.exp(0.25) if top_hat else 1.0)),
        centres=centres,
    )
