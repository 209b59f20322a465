"""Kinds of cases, as text: what is hidden, and how strong."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from rig.hidden import registry
from rig.hidden.designs import Design
from rig.hidden.names import (
    EFFECTS,
    EXCLUSIVE,
    EXCLUSIVE_AT_ONE_EXPOSURE,
    EXCLUSIVE_AT_ONE_SITE,
    LEVELS,
)

_COUNTS = {"none": 0, "one": 1, "two": 2, "three": 3, "four": 4}


@dataclass(frozen=True)
class Kind:
    """`number` of effects of a `level`; `names` where they are fixed."""

    number: int
    level: str
    names: tuple[str, ...] = ()


def read_kind(kind: str, design: Design) -> Kind:
    """A kind from its text; ValueError where it is none, or where the design cannot show it."""
    if kind == "none":
        return Kind(0, "strong")
    match = re.fullmatch(r"(one|two|three|four|outside)(?::([a-z_+]+))?:(faint|mid|strong)", kind)
    if match is None:
        raise ValueError(
            f"{kind!r} is no kind: none, one:<effect>:<level>, two:strong, … with levels {', '.join(LEVELS)}"
        )
    count, listed, level = match.groups()
    names = tuple(listed.split("+")) if listed else ()
    pool = tuple(registry.OUTSIDERS) if count == "outside" else EFFECTS
    for name in names:
        if name not in pool:
            raise ValueError(f"{name!r} is not one of {', '.join(pool)}")
        if not registry.shows(name, design):
            raise ValueError(
                f"{name} is not possible in this design ({design.name}): nothing in its frames would show it"
            )
    number = 1 if count == "outside" else _COUNTS[count]
    if (names and len(set(names)) != number) or (count == "outside" and not names):
        raise ValueError(f"{kind!r} must name {number} different {'mechanism' if count == 'outside' else 'effect'}(s)")
    if _clash(names, design):
        raise ValueError(f"{kind!r}: not possible in this design ({design.name}), its effects exclude each other")
    return Kind(number, level, names)


def possible(kind_or_effect: str, design: str = "default") -> bool:
    """Whether a design can show an effect, a mechanism outside the vocabulary, or a whole kind."""
    grid = registry.design(design)
    if kind_or_effect in EFFECTS or registry.is_outside(kind_or_effect):
        return registry.shows(kind_or_effect, grid)
    try:
        read_kind(kind_or_effect, grid)
    except ValueError as error:
        if "not possible in this design" not in str(error):
            raise
        return False
    return True


def choose(rng: np.random.Generator, kind: Kind, design: Design) -> tuple[str, ...]:
    """The kind's names, or distinct effects at random that the design shows and that do not exclude each other."""
    if kind.names or kind.number == 0:
        return kind.names
    pool = [name for name in EFFECTS if registry.shows(name, design)]
    while True:
        names = tuple(str(name) for name in rng.choice(pool, size=kind.number, replace=False))
        if not _clash(names, design):
            return names


def _clash(names: tuple[str, ...], design: Design) -> bool:
    pairs = [*EXCLUSIVE]
    if len(design.exposures_s) == 1:
        pairs += EXCLUSIVE_AT_ONE_EXPOSURE
    if design.sites == 1:
        pairs += EXCLUSIVE_AT_ONE_SITE
    if len(design.exposures_s) == 2:
        pairs += [{"photon_budget", "shutter_offset"}]
    return any(pair <= set(names) for pair in pairs)
