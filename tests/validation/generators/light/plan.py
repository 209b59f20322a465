"""What is made: streams that are dealt by their shares, so that every beginning of the plan covers the table's rows.

Kinds, beside those of the protocol: `light:<light>` (no effect, light that is no Gaussian),
`one:<effect>:<light>:<level>` and `tied:<effect>:<light>:<level>`, `two:<a>+<b>:<light>:<level>`,
`outside:<mechanism>:<light>:<level>`, `sheet:<quantity>:<effect or none>:<off>` and `hene:<what>`; a level is a
multiple of the bound.
"""

from collections.abc import Iterator
from itertools import cycle, product
from typing import Any

import numpy as np

from tests.validation.generators.light import outside
from tests.validation.generators.second.effects import VOCABULARY
from tests.validation.protocol import Job, dealt

# 1,700 jobs give every row of the table some 150 sets at least, but for those of real frames, which are nine.
SHARES = {
    "null": 11, "plain": 10, "strong default": 10, "strong one_exposure": 10, "strong single_frame": 11, "ten": 10,
    "others": 1, "outside real": 10, "outside gauss": 8, "tied": 7, "two": 8, "hene": 8, "sheet": 6,
}  # fmt: skip
# Null sets on Gaussian light, by design.
NULL_DESIGNS = {"default": 2, "one_exposure": 2, "single_frame": 1}
# What no design of one exposure shows, and all that one frame may show.
NEEDS_EXPOSURES = ("photon_budget", "shutter_offset", "spread_law", "pointing_jitter")
OF_ONE_FRAME = ("saturation", "black_clipping", "dark_offset", "background_gradient", "interference_fringes",
                "excess_read_noise", "row_noise", "smear", "fixed_pattern", "ghost_reflection")  # fmt: skip
# What a free shape takes, by design; the truth of a set says whether it does.
TIED = (
    ("super_gaussian", "default"), ("beam_ellipticity", "default"), ("motion_blur", "one_exposure"),
    ("nonlinearity", "single_frame"), ("beam_ellipticity", "one_exposure"), ("super_gaussian", "one_exposure"),
    ("motion_blur", "single_frame"), ("ghost_reflection", "single_frame"), ("fibre_anisotropy", "single_frame"),
    ("super_gaussian", "single_frame"), ("beam_ellipticity", "single_frame"), ("ghost_reflection", "one_exposure"),
)  # fmt: skip
SHAPES = ("super_gaussian", "beam_ellipticity")
# No two of a group go together: each can be what the other is.
GROUPS = (
    {"photon_budget", "shutter_offset", "spread_law", "power_fluctuation", "laser_drift", "angle_reflectance"},
    {"dark_offset", "background_gradient", "black_clipping", "scatter_halo", "smear"},
    {"speckle", "fixed_pattern", "interference_fringes"},
    {"saturation", "nonlinearity"},
    {"fibre_anisotropy", "motion_blur", "ghost_reflection"},
)
# How far a sheet is off: gain and read noise in parts, the black level in DN.
OFF = {"gain": (0.01, -0.01, 0.03, -0.03, 0.05, -0.05), "read_noise": (0.1, -0.1), "black_level": (0.5, -0.5)}
# Strong effects on which a sheet that is off is tried; as many as share no factor with the ways of being off.
BESIDE = ("none", "saturation", "none", "smear", "none", "nonlinearity", "none", "photon_budget", "none")
LEVEL, LOWER, OTHERS, STRANGE = 50, 10, (15, 5), (15, 50, 150)
# What is put into real frames: clips by part of the top, a rise in DN, stripes by depth and period in px, a bend.
PUT_IN = ("as it is", "clip 0.7", "clip 0.9", "clip 0.97", "rise 6", "stripes 0.1 23", "stripes 0.1 9", "bend 0.15")


def plan(first: int) -> Iterator[Job]:
    """Jobs without end."""
    real = ("real", "drawn")
    every = tuple(name for name in VOCABULARY if name not in SHAPES)
    shown = {"default": every, "one_exposure": tuple(name for name in every if name not in NEEDS_EXPOSURES),
             "single_frame": OF_ONE_FRAME}  # fmt: skip
    streams = {
        "null": (("none:gauss", design) for design in dealt(NULL_DESIGNS)),
        "plain": _turned([("light:{}", design) for design in ("default", "one_exposure", "single_frame")], real),
        **{f"strong {d}": _turned([(f"one:{n}:{{}}:{LEVEL}", d) for n in names], real) for d, names in shown.items()},
        "ten": _turned(_mixed([(f"one:{n}:{{}}:{LOWER}", d) for d, names in shown.items() for n in names]), real),
        "others": _turned(_mixed([(f"one:{n}:{{}}:{level}", "default") for level in OTHERS for n in every]), real),
        "outside real": _turned(_outside(), real),
        "outside gauss": _turned(_outside(), ("gauss",)),
        "tied": _turned([(f"tied:{name}:{{}}:{LEVEL}", design) for name, design in TIED], real),
        "two": _turned([(f"two:{pair}:{{}}:{LEVEL}", "default") for pair in pairs(every)], real),
        "hene": ((f"hene:{what}", f"frame {k}") for k, what in cycle(_frames())),
        "sheet": _sheets(),
    }  # fmt: skip
    for number, name in enumerate(dealt(SHARES)):
        yield Job(number, first + number, *next(streams[name]))


def pairs(names: tuple[str, ...]) -> list[str]:
    """Pairs of effects that can be told from each other, in an order of its own."""
    fit = [
        f"{a}+{b}"
        for k, a in enumerate(names)
        for b in names[k + 1 :]
        if not any({a, b} <= group for group in GROUPS)
    ]  # fmt: skip
    return _mixed(fit)


def _mixed(rows: list[Any]) -> list[Any]:
    """Rows in an order at random, the same at every call."""
    return [rows[k] for k in np.random.default_rng(7).permutation(len(rows))]


def _turned(rows: list[tuple[str, str]], lights: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Rows in turn, each with one kind of light after the other."""
    turn = 0
    while True:
        for k, (kind, design) in enumerate(rows):
            yield kind.format(lights[(k + turn) % len(lights)]), design
        # Rows as many as a multiple of the lights would else never change theirs.
        turn += 1


def _frames() -> list[tuple[int, str]]:
    """Real frames and what is put in; each as it is before it is raised, for a rise is held against that."""
    rows = _mixed(list(product(range(9), PUT_IN)))
    for k in range(9):
        plain, risen = rows.index((k, PUT_IN[0])), rows.index((k, "rise 6"))
        if risen < plain:
            rows[plain], rows[risen] = rows[risen], rows[plain]
    return rows


def _outside() -> list[tuple[str, str]]:
    names = list(outside.MECHANISMS)
    out = []
    for level, design in product(STRANGE, ("default", "one_exposure")):
        out += [(f"outside:{name}:{{}}:{level}", design if design in outside.NEEDS.get(name, (design,)) else "default")
                for name in names]  # fmt: skip
    return out


def _sheets() -> Iterator[tuple[str, str]]:
    offs = [(name, off) for name, values in OFF.items() for off in values]
    for k, (beside, (name, off)) in enumerate(zip(cycle(BESIDE), cycle(offs), strict=False)):
        design = "default" if beside != "none" or k % 4 else "one_exposure"
        yield f"sheet:{name}:{beside}:{off:+g}", design
