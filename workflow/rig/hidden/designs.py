"""Designs: which angles, exposures and repeats, and in which order the frames were taken."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

FRAME_PX = 264
CROP_PX = 240
# ASSUME: the spot lands within this distance of the frame's centre, anew at each site, along each axis [px].
WANDER_PX = 4.0


@dataclass(frozen=True)
class Design:
    """The grid of conditions: angles [deg], exposures [s], number of repeats."""

    angles_deg: tuple[float, ...]
    exposures_s: tuple[float, ...]
    repeats: int

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.angles_deg) * self.repeats * len(self.exposures_s)

    def discovery(self, repeat: int) -> bool:
        """Whether a repeat may be used to find effects: of six or more, every third is kept unseen (contract)."""
        return self.repeats < 6 or repeat % 3 != 2


_FOUR = (0.0, 45.0, 90.0, 135.0)
_THREE_TIMES = (100e-6, 300e-6, 900e-6)
DESIGNS = {
    "default": Design(_FOUR, _THREE_TIMES, 8),
    "two_exposures": Design(_FOUR, (200e-6, 800e-6), 8),
    "eight_angles": Design(tuple(22.5 * k for k in range(8)), _THREE_TIMES, 4),
    "three_repeats": Design(_FOUR, _THREE_TIMES, 3),
    "one_exposure": Design(_FOUR, (500e-6,), 8),
    "one_site": Design((0.0,), _THREE_TIMES, 1),
    "single_frame": Design((0.0,), (500e-6,), 1),
}


@dataclass(frozen=True)
class Shot:
    """One frame to be taken."""

    index: int  # place in the order of acquisition
    site: int  # number of the site, by the design's count
    angle_deg: float  # angle of the fibres [deg]
    exposure_s: float  # exposure [s]
    repeat: int  # number of the repeat
    x_px: float  # column of the spot's centre [px]
    y_px: float  # row of the spot's centre [px]

    def row(self) -> dict[str, Any]:
        """The frame's row in the manifest."""
        stem = f"a{self.angle_deg:g}_r{self.repeat}_t{self.exposure_s * 1e6:.0f}us"
        angle = int(self.angle_deg) if self.angle_deg.is_integer() else self.angle_deg
        return {
            "file": f"frames/{stem}.tif",
            "kind": "spot",
            "angle_deg": angle,
            "exposure_s": round(self.exposure_s, 9),
            "repeat": self.repeat,
        }


def draw_shots(rng: np.random.Generator, design: Design) -> tuple[Shot, ...]:
    """Frames in order of acquisition: site by site, sites by angle, by repeat or shuffled; exposures rise within."""
    places = [(angle, repeat) for angle in design.angles_deg for repeat in range(design.repeats)]
    order = rng.choice(["angles", "repeats", "shuffled"])
    numbers = np.arange(len(places))
    if order == "repeats":
        numbers = numbers.reshape(len(design.angles_deg), design.repeats).T.ravel()
    elif order == "shuffled":
        numbers = rng.permutation(numbers)
    centres = (FRAME_PX - 1) / 2 + rng.uniform(-WANDER_PX, WANDER_PX, size=(len(places), 2))
    shots: list[Shot] = []
    for site in numbers:
        angle, repeat = places[site]
        x, y = centres[site]
        for exposure in design.exposures_s:
            shots.append(Shot(len(shots), int(site), angle, exposure, repeat, float(x), float(y)))
    return tuple(shots)


def middle_exposure(design: Design) -> float:
    """Geometric mean of the exposures [s]."""
    return math.exp(sum(math.log(t) for t in design.exposures_s) / len(design.exposures_s))
