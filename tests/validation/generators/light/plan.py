"""Which sets are made: the rows of the score table, dealt so that every beginning of the plan covers all rows.

A job's kind names its row first: `<row>:<what is put in>:<light>:<multiple of the bound>`; the design is the job's own.
"""

from collections.abc import Iterator
from itertools import cycle, islice, product

import numpy as np

from tests.validation.generators.light import outside
from tests.validation.generators.second.effects import VOCABULARY
from tests.validation.protocol import Job, deal

STRONG, WEAK = 50, 10
SHAPES = ("beam_ellipticity", "super_gaussian", "scatter_halo", "ghost_reflection")
# What no design of one exposure shows or tells from what varies between sites, and all that one frame may show.
NEEDS_EXPOSURES = ("photon_budget", "shutter_offset", "spread_law", "pointing_jitter", "motion_blur",
                   "power_fluctuation", "beam_ellipticity", "super_gaussian")  # fmt: skip
OF_ONE_FRAME = ("saturation", "black_clipping", "dark_offset", "background_gradient", "interference_fringes",
                "excess_read_noise", "row_noise", "smear", "fixed_pattern", "ghost_reflection")  # fmt: skip
# No two of a group are put in together: each can be what the other is.
CONFOUNDED = (
    {"photon_budget", "shutter_offset", "spread_law", "power_fluctuation", "laser_drift", "angle_reflectance"},
    {"dark_offset", "background_gradient", "black_clipping", "scatter_halo", "smear"},
    {"speckle", "fixed_pattern", "interference_fringes"},
    {"saturation", "nonlinearity"},
    {"fibre_anisotropy", "motion_blur", "ghost_reflection", "beam_ellipticity", "super_gaussian"},
)
# The mechanism that the page on effects gives a form to.
DOCUMENTED = "vignetting"
# What is put into real frames: a clip at a part of the peak, stripes by depth and period [px], a rise [DN], a bend.
PUT_IN = ("clip 0.9", "stripes 0.1 23", "rise 6", "bend 0.15")
FRAMES = 9
# Sets of every row.
COUNTS = {
    "strong gauss": 40, "weak gauss": 40, "strong real": 40, "weak real": 40, "one exposure": 40, "single frame": 40,
    "two": 40, "nothing": 100, "outside": 60, "shape": 40, "frame": FRAMES * (1 + len(PUT_IN)), "frames at 600 px": 1,
    "default dataset": 1,
}  # fmt: skip


def plan(first: int) -> Iterator[Job]:
    """All jobs. The order within a row, and so which effects come twice, is drawn from the first seed."""
    rng = np.random.default_rng(first)
    every, both = list(VOCABULARY), ("gauss", "real")
    exposed = [name for name in every if name not in NEEDS_EXPOSURES]
    rows = {
        "strong gauss": ((f"{name}:gauss:{STRONG}", "default") for name in _shuffled(every, rng)),
        "weak gauss": ((f"{name}:gauss:{WEAK}", "default") for name in _shuffled(every, rng)),
        "strong real": ((f"{name}:real:{STRONG}", "default") for name in _shuffled(every, rng)),
        "weak real": ((f"{name}:real:{WEAK}", "default") for name in _shuffled(every, rng)),
        "one exposure": _alternate(both, _shuffled(exposed, rng), "one_exposure"),
        "single frame": _alternate(both, _shuffled(list(OF_ONE_FRAME), rng), "single_frame"),
        "two": _alternate(both, _shuffled(pairs(every), rng), "default"),
        "nothing": ((f":{light}:0", design) for design, light in
                    cycle(product(("default", "one_exposure", "default", "single_frame"), both))),
        "outside": _outside(both, _shuffled([name for name in outside.MECHANISMS if name != DOCUMENTED], rng)),
        "shape": ((f"{name}:gauss:{level}", "default") for level, name in
                  zip(cycle((STRONG, WEAK)), _shuffled(list(SHAPES), rng), strict=False)),
        "frame": ((what, f"frame {frame}") for what in ("as it is", *PUT_IN) for frame in range(FRAMES)),
        "frames at 600 px": iter([("", "nine frames")]),
        "default dataset": iter([("", "default")]),
    }  # fmt: skip
    for number, row in enumerate(islice(deal(COUNTS), sum(COUNTS.values()))):
        kind, design = next(rows[row])
        yield Job(number, first + number, f"{row}:{kind}", design)


def pairs(names: list[str]) -> list[str]:
    """Pairs of effects that the default design can tell from each other."""
    return [f"{a}+{b}" for k, a in enumerate(names) for b in names[k + 1 :]
            if not any({a, b} <= group for group in CONFOUNDED)]  # fmt: skip


def _shuffled(names: list[str], rng: np.random.Generator) -> Iterator[str]:
    """Names without end; each round has all of them, in an order of its own."""
    rounds = [[names[k] for k in rng.permutation(len(names))] for _ in range(20)]
    return cycle(name for round_ in rounds for name in round_)


def _alternate(lights: tuple[str, ...], names: Iterator[str], design: str) -> Iterator[tuple[str, str]]:
    for name, light in zip(names, cycle(lights), strict=False):
        yield f"{name}:{light}:{STRONG}", design


def _outside(lights: tuple[str, ...], names: Iterator[str]) -> Iterator[tuple[str, str]]:
    """Mechanisms outside the vocabulary, strong, in the designs that show them."""
    for number, (name, light) in enumerate(zip(names, cycle(lights), strict=False)):
        shown = outside.NEEDS.get(name, ("default", "one_exposure"))
        yield f"{name}:{light}:{STRONG}", shown[number % len(shown)]
