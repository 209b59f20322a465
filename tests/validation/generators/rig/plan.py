"""What is run: streams of cases that are dealt by their shares, so that every beginning of the plan is balanced.

The plan has no end. A job's seed is the first seed plus its number, so that no two jobs share one.
"""

from collections.abc import Iterator, Sequence
from itertools import cycle

from rig import hidden
from tests.validation.protocol import Job, dealt

# Mends that come of sets with effects leave null sets as they are; those with effects then are drawn anew, from this
# much higher on.
AFRESH = 7_510_000
# Where several designs have a part in a stream, how often each.
NULL_DESIGNS = {
    "default": 6, "two_exposures": 4, "three_repeats": 4, "one_exposure": 3, "one_site": 2, "single_frame": 2,
}  # fmt: skip
EFFECT_DESIGNS = {
    "default": 12, "two_exposures": 1, "three_repeats": 2, "one_exposure": 1, "one_site": 1, "single_frame": 1,
    "eight_angles": 1,
}  # fmt: skip
# Shares of the streams. Of 4300 jobs 2064 are null sets, 1204 have one strong effect (50 each).
SHARES = {"none": 48, "strong": 28, "mid": 5, "faint": 5, "outside": 7, "two": 5, "three": 1, "four": 1}


def plan(first: int) -> Iterator[Job]:
    """Jobs without end."""
    streams = {
        "none": _nulls(),
        "strong": _ones("strong"),
        "mid": _ones("mid"),
        "faint": _ones("faint"),
        "outside": _outside(),
        **{number: _several(number) for number in ("two", "three", "four")},
    }
    for number, name in enumerate(dealt(SHARES)):
        yield Job(number, first + number + AFRESH * (name != "none"), *next(streams[name]))


def _nulls() -> Iterator[tuple[str, str, str]]:
    """Null sets; every eighth is judged by a baseline that leaves each frame's light free."""
    for number, design in enumerate(dealt(NULL_DESIGNS)):
        yield "none", design, "free" if number % 8 == 7 and design in ("three_repeats", "one_exposure") else ""


def _ones(level: str) -> Iterator[tuple[str, str]]:
    """Every effect in turn, each through the designs on its own."""
    return _rotated([f"one:{name}:{level}" for name in hidden.EFFECTS])


def _outside() -> Iterator[tuple[str, str]]:
    return _rotated([f"outside:{name}:strong" for name in hidden.OUTSIDE])


def _several(number: str) -> Iterator[tuple[str, str]]:
    return _rotated([f"{number}:strong"])


def _rotated(kinds: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Kinds in turn. Each starts elsewhere in the row of designs, so that no round shows one design alone."""
    designs = {kind: _offset(dealt(EFFECT_DESIGNS), 5 * k) for k, kind in enumerate(kinds)}
    for kind in cycle(kinds):
        design = next(designs[kind])
        yield kind, design if hidden.possible(kind, design) else "default"


def _offset(names: Iterator[str], steps: int) -> Iterator[str]:
    for _ in range(steps):
        next(names)
    return names
