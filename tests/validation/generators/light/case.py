"""Grid, camera and light of a seed: the second generator's case with a shape of its own."""

import numpy as np

from tests.validation.generators.light import beams
from tests.validation.generators.second.case import (
    CROP,
    FULL_SCALE,
    LASER_WIDTH,
    LONG,
    MIDDLE,
    SHORT,
    Case,
    Frame,
)

ANGLES = 4
REPEATS = 8
# Frames of a condition in the design of one exposure.
FEWEST, MOST = 5, 20
# Width σ_g at the longest exposure and how it grows with ln t; at no exposure it is below 14 px [px].
SIGMA, GROWTH, LEAST_SIGMA = (16.0, 22.0), (0.8, 1.8), 14.0
# Brightest light over full scale.
BRIGHT = (0.5, 0.75)


def draw_case(seed: int, design: str, light: str, names: list[str]) -> Case:
    """Everything but the effects, of which `names` decide what they need: the black level, and the photon budget where
    the contract's ties would hide them."""
    rng = np.random.default_rng([seed, 0])
    grid, exposures = _grid(design, rng)
    frames = [Frame(a * 180.0 / ANGLES, t, r, site) for site, (a, r) in enumerate(grid) for t in exposures]
    sigma, p1 = rng.uniform(*SIGMA), rng.uniform(*GROWTH)
    p1 = min(p1, (sigma - LEAST_SIGMA) / np.log(LONG / SHORT)) if len(exposures) > 1 else 0.0
    p2 = sigma - LASER_WIDTH - p1 * np.log(exposures[-1])
    shape = beams.beam(light, rng)
    gain = round(float(np.exp(rng.uniform(np.log(0.07), np.log(0.2)))), 4)
    top = shape.top if shape else 1.0
    black = int(rng.integers(5, 60)) if rng.random() < 0.75 else 0
    if "black_clipping" in names:
        black = int(rng.choice([0, 0, 3]))
    # By `spot_area` all exposures are nearly as bright, and nothing that bends can be told from the shape.
    budget = "linear" if rng.random() < 0.75 else "spot_area"
    if {"spread_law", "shutter_offset"} & set(names):
        budget = "linear"
    return Case(
        seed=seed,
        design=design,
        frames=frames,
        size=CROP,
        gain=gain,
        read_noise=round(rng.uniform(3.0, 15.0), 2),
        dark_current=round(rng.uniform(0.0, 120.0), 1),
        black=max(black, 24) if any(name.startswith("outside:") for name in names) else black,
        budget=budget,
        p1=float(p1),
        p2=float(p2),
        peak=float(rng.uniform(*BRIGHT) * FULL_SCALE / top),
        centres=(CROP - 1) / 2 + rng.uniform(-4.0, 4.0, (len(grid), 2)),
        shape=shape,
        full_well=round(float(rng.uniform(1.15, 2.0) * FULL_SCALE / gain), 0),
    )


def _grid(design: str, rng: np.random.Generator) -> tuple[list[tuple[int, int]], tuple[float, ...]]:
    """Sites as (angle, repeat) in the order of acquisition, and the exposures of each [s]."""
    if design == "single_frame":
        return [(0, 0)], (LONG,)
    repeats = REPEATS if design == "default" else int(rng.integers(FEWEST, MOST + 1))
    # The paper's cycles: the sample turns, then again.
    grid = [(a, r) for r in range(repeats) for a in range(ANGLES)]
    return (sorted(grid) if rng.random() < 0.4 else grid), ((SHORT, MIDDLE, LONG) if design == "default" else (MIDDLE,))
