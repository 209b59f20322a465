"""Cases of few pixels on which the makers of sets on real light are tried."""

from dataclasses import replace

import numpy as np

from tests.validation.generators.light.case import draw_case
from tests.validation.generators.light.outside import MECHANISMS
from tests.validation.generators.second.case import LASER_WIDTH, Case, Effect, Frame
from tests.validation.generators.second.effects import VOCABULARY


def small_case(seed: int = 3, light_: str = "gauss", size: int = 40, names: tuple[str, ...] = (), **more) -> Case:
    """Two sites at two exposures on frames of a few px, the spot a fifth of them wide."""
    case = draw_case(seed, "default", light_, list(names))
    frames = [Frame(90.0 * site, t, 0, site) for site in (0, 1) for t in (3e-4, 9e-4)]
    width = {"p1": 0.8, "p2": size / 7 - LASER_WIDTH - 0.8 * np.log(9e-4)}
    centres = (size - 1) / 2 + np.array([[0.3, -0.8], [-1.2, 0.6]])
    return replace(case, frames=frames, size=size, centres=centres, **(width | more))


def strong(case: Case, name: str, s: float | None = None) -> Effect:
    """An effect of the vocabulary or outside it, as strong as its search begins."""
    effect = {**VOCABULARY, **MECHANISMS}[name](case, np.random.default_rng(7))
    effect.name, effect.s = name, max(effect.start, effect.floor) if s is None else s
    return effect
