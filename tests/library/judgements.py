"""Judgements put together by hand, one or more of every status, for tests of the verdict's document and sentence."""

from typing import Any

import numpy as np

from spotcheck.old_engine.conclude.detect import Detection
from spotcheck.old_engine.conclude.judgement import Advice, Gap, Judgement, Light, Limit, Shift
from spotcheck.old_engine.conclude.places import Where
from spotcheck.old_engine.conclude.unexplained import Unexplained
from spotcheck.old_engine.evidence.parts import Part
from spotcheck.old_engine.model import light_shape
from spotcheck.old_engine.model.effect import Present
from spotcheck.old_engine.model.effects import vocabulary
from spotcheck.old_engine.nuisance.sheet import Against
from spotcheck.old_engine.search.forward import Found
from spotcheck.old_engine.search.holds import Holding

NO_LAW = Shift(None, None, None)
# What is told of the light.
WORDS = "6 % of its power lies elsewhere, most of it in four lobes"
PEDESTAL = "a uniform pedestal lies under the frame: ambient light, or a higher black level"


def detected(p: float) -> Detection:
    """A test with two parts."""
    parts = (Part("mean: blocks, all frames", 40.0, p / 2, "row 96, column 120"), Part("variance: frames", 0.2, 0.4))
    return Detection(p, parts)


def left(size: float, error: float = 1e-7) -> Unexplained:
    """So much is left [peak], with the error of its power [peak²]."""
    return Unexplained(size, error, 1e-3, size**2 / error, 0.1)


def found(name: str, *values: float, form: str | None = None, rivals: dict[str, float] | None = None) -> Found:
    """An effect with z = 30 that holds in 24 cells."""
    effect = vocabulary()[name]
    present = Present(effect, effect.forms[0] if form is None else form, values)
    return Found(present, 900.0, Holding(27.0, 24, 900.0, 0.01 * abs(values[0])), rivals or {})


def closed(by_light: float = 0.0, **by_effect: float) -> Gap:
    """A gap of 3 DN on unseen repeats, closed by parts."""
    share = by_light + sum(by_effect.values())
    return Gap(9.0, 1.01, 1.0, 3.0, 0.1, share, by_light, by_effect, 5400.0, "unseen repeats")


def learned(power: float = 0.06, error: float = 0.002) -> Light:
    """Light in four lobes."""
    orders = (0.1, 0.05, 0.15, 0.05, 0.65)
    return Light(power, error, orders, (1.21, 1.02, 395.0), -0.001, light_shape.empty(0.5, 2.0))


def stated(name: str, value: float, error: float, moved: float, told: float) -> Against:
    """A number of the sheet that frames move by so many of its stated errors, to an error of its own."""
    return Against(name, value, error, value + moved * error, told, moved, moved * 1.01)


def judged(**changes: Any) -> Judgement:
    """A judgement of frames in which nothing is missing, but for some fields."""
    base = Judgement(
        why_not="",
        detection=detected(0.32),
        found=(),
        beyond=(),
        light=None,
        sheet=(),
        unexplained=left(0.0),
        gap=None,
        shift=Shift((7.3931, 86.81), None, (0.0034, 0.029)),
        limits=(Limit("smear", "fraction", "1", "not there", high=0.0004, times=4.0),),
        where=(),
        off=0.0003,
    )
    return base._replace(**changes)


def off(p: float = 1e-12, part: float = 0.055, **changes: Any) -> Judgement:
    """A judgement of frames that are off by a part of the peak."""
    own = {"detection": detected(p), "off": part, "where": (Where("row 96, column 120 at 0.4 ms", 85.0),),
           "unexplained": left(0.0005), "limits": ()}  # fmt: skip
    return judged(**(own | changes))


CLIP = found("saturation", 520.7, 1.0, form="sharp with noise")
BEND = found("nonlinearity", 0.112)
ROWS, GRAINS = found("row_noise", 4.0), found("speckle", 0.25, 3.1)
GHOST = found("ghost_reflection", 0.0239, -29.2, 4.1, rivals={"scatter_halo": 4.6})
MOVED = Shift((2.3039, 33.13), (0.003, 8.83), (0.0057, 0.36))
GHOST_ERRORS = {"ghost_reflection": (0.0004, 0.35, 0.28)}
TELLS = Advice({"exposure_s": 1.8e-3, "angle_deg": 22.5}, ("ghost_reflection", "scatter_halo"), 12)
ALIKE = {"scatter_halo": 0.2, "super_gaussian": 0.9}

BLACK = stated("black_level_dn", 12.0, 0.3, -4.0, 0.02)

# Every kind of judgement, and what it is to be called.
JUDGEMENTS: dict[str, tuple[str, Judgement]] = {
    "agreed": ("consistent", judged()),
    "agreed, one frame": ("consistent", judged(shift=NO_LAW, limits=(), unexplained=None)),
    "one": ("named", off(found=(CLIP,), shift=MOVED, gap=closed(saturation=0.9997))),
    "one, no frames apart": ("named", off(found=(BEND,), shift=NO_LAW, unexplained=None)),
    "one of the scatter": (
        "named",
        off(part=0.0004, found=(ROWS,), shift=NO_LAW, gap=closed()._replace(before=1.001, closed=np.nan)),
    ),
    "one, hardly seen": ("named", off(p=0.2, part=0.0004, found=(BEND,), shift=NO_LAW, gap=closed(nonlinearity=0.8))),
    "two": (
        "named",
        off(found=(BEND, found("dark_offset", 8.003)), gap=closed(nonlinearity=0.7, dark_offset=0.28)),
    ),
    "four": (
        "named_more_remains",
        off(found=(CLIP, BEND, ROWS, GRAINS), gap=closed(saturation=0.7, nonlinearity=0.1), unexplained=left(0.006)),
    ),
    "light": ("named", off(light=learned(), shift=NO_LAW, gap=closed(by_light=0.97))),
    "light and one": (
        "named",
        off(light=learned(), found=(BEND,), gap=closed(by_light=0.97, nonlinearity=0.02)),
    ),
    "one and light": (
        "named_more_remains",
        off(light=learned(), found=(CLIP,), gap=closed(0.1, saturation=0.8), unexplained=left(0.006)),
    ),
    "tied": (
        "ambiguous",
        off(found=(GHOST,), errors=GHOST_ERRORS, gap=closed(ghost_reflection=0.98), advice=(TELLS,)),
    ),
    "tied, three": (
        "ambiguous",
        off(found=(CLIP, GHOST._replace(rivals=ALIKE)), gap=closed(saturation=0.6, ghost_reflection=0.3)),
    ),
    "stranger": ("unknown", off(part=0.021, unexplained=left(0.019))),
    "stranger, noise": ("unknown", off(part=0.0004, shift=NO_LAW, unexplained=left(0.0004))),
    "stranger, no test": ("unknown", judged(unexplained=left(0.01), limits=())),
    "not foretold": ("unknown", off(found=(BEND,), beyond=("nonlinearity",), unexplained=left(0.004))),
    "sheet": (
        "named",
        off(found=(CLIP,), gap=closed(saturation=0.98), shift=NO_LAW,
            sheet=(stated("gain_dn_per_e", 0.11, 0.0033, 6.7, 0.001), stated("read_noise_e", 12.0, 0.6, 1.1, 0.2))),
    ),
    "sheet alone": ("consistent", judged(limits=(), shift=NO_LAW, sheet=(BLACK,))),
    "untested": (
        "not_assessed",
        Judgement("there is no usable spot frame", None, (), (), None, (), None, None, NO_LAW, (), ()),
    ),
}  # fmt: skip
