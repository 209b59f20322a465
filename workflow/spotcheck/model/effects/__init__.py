"""The vocabulary of effects: the effects that a run knows. Each other module of this folder defines one.

An effect is a deviation of the frames from the baseline model. A run may add effects from files of the user and leave
some out. This choice is a global state of the process, which the command line sets once, so that every function of a
run knows the same effects by the same names. Processes that a stage starts are given the choice and load the effects
again, as functions of a file cannot be sent to another process.
"""

import importlib
import pkgutil
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from spotcheck.errors import InputError
from spotcheck.model.effect import PROPERTIES, Effect
from spotcheck.model.effect_file import read_effect


class Choice(NamedTuple):
    """Choice of a vocabulary; at most one of `only` and `without` is given."""

    files: tuple[str, ...] = ()  # paths of Python files, each of which adds an effect
    only: tuple[str, ...] = ()  # names of the effects that are kept; empty: all
    without: tuple[str, ...] = ()  # names of the effects that are left out


# The choice of exactly the effects of this folder.
LIBRARY = Choice()
# The choice of this process, which `choose` sets.
_choice = LIBRARY


@cache
def built_in() -> dict[str, Effect]:
    """Return the effects of this folder by name, in the order of their numbers."""
    modules = (importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__))
    return _sort_by_number(module.EFFECT for module in modules)


def _sort_by_number(effects: Iterable[Effect]) -> dict[str, Effect]:
    """Return effects by name, in the order of their numbers."""
    return {effect.name: effect for effect in sorted(effects, key=lambda effect: effect.number)}


def vocabulary() -> Mapping[str, Effect]:
    """Return the effects of this run by name, in the order of their numbers."""
    return _gather(_choice)[0]


def choose(choice: Choice = LIBRARY) -> None:
    """Set the vocabulary of this process, by default to the effects of this folder.

    Raises `InputError`, and keeps the vocabulary, in any of these cases: a file has no usable effect, or one whose name
    or number another effect has, or whose special case is no known effect; `only` or `without` names no known effect;
    both are given; or no effect is left.
    """
    global _choice
    # Files may have changed since they were last read.
    _gather.cache_clear()
    # Raises before the choice is set.
    _gather(choice)
    _choice = choice


def chosen() -> Choice:
    """Return the choice of this process, which processes that it starts must be given."""
    return _choice


def describe_vocabulary() -> dict[str, Any]:
    """Return how the vocabulary of this run differs from the effects of this folder, as files of results record it.

    The key `own` has a list of name, file and digest (`sha256`) of each effect from a file, `left_out` the names of
    effects that are left out. {} without a difference.
    """
    difference = _gather(_choice)[1]
    return difference if any(difference.values()) else {}


@cache
def _gather(choice: Choice) -> tuple[dict[str, Effect], dict[str, list]]:
    """Return the effects of a choice by name, in the order of their numbers, and their difference from the library's.

    The difference is that of `describe_vocabulary`, with empty lists where there is none. Raises `InputError` as
    `choose` does.
    """
    effects, entries = dict(built_in()), []
    for file in choice.files:
        effect, digest = read_effect(Path(file))
        numbers = {other.number: other.name for other in effects.values()}
        if effect.name in effects:
            raise InputError(f"{file}: its effect is called {effect.name}, as another is; give it a name of its own")
        if other := numbers.get(effect.number):
            raise InputError(f"{file}: number {effect.number} is that of {other}; leave it out for the next free one")
        # 0 stands for the next free number.
        effects[effect.name] = replace(effect, number=effect.number or max(numbers) + 1)
        entries.append({"name": effect.name, "file": Path(file).name, "sha256": digest})
    known = f"known effects: {', '.join(effects)}"
    # A special case is what an effect can imitate: another effect, or all laws of a property of the spot
    # (`PROPERTIES`).
    for file, entry in zip(choice.files, entries, strict=True):
        for special_case in sorted(set(effects[entry["name"]].special_cases) - {*effects, *PROPERTIES}):
            raise InputError(f"{file}: special_cases names {special_case}, which is no effect; {known}")
    if choice.only and choice.without:
        raise InputError("vocabulary: has both only and without; name the effects that stay, or those that go")
    for key, names in (("only", choice.only), ("without", choice.without)):
        for name in sorted(set(names) - set(effects)):
            raise InputError(f"vocabulary: {key} names {name}, which is no effect; {known}")
    kept_names = set(choice.only or effects) - set(choice.without)
    if not kept_names:
        raise InputError("vocabulary: without names every effect; leave at least one")
    kept = _sort_by_number(effects[name] for name in kept_names)
    kept_entries = [entry for entry in entries if entry["name"] in kept]
    return kept, {"own": kept_entries, "left_out": [name for name in effects if name not in kept]}
