"""The vocabulary of effects: every file in this folder is one, and a run may add files of its own and leave some out.

The vocabulary is chosen once for a process, by the command line, and not handed down: it belongs to the run as the
library's code does. Every stage of a run must know the same effects, a name that a file holds must mean one thing
wherever it is read, and processes that a stage starts are given the choice, from which they load it anew (functions of
a file cannot be sent to them).
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
    """Files that each add an effect, and the names of all effects that stay (none: all) or of those that go."""

    files: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    without: tuple[str, ...] = ()


# The vocabulary as this folder has it.
LIBRARY = Choice()
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
    """Set the vocabulary of this process, by default that of this folder.

    Raises `InputError` for a file that holds no usable effect, a name or number that is taken, a name that no effect
    has, and a choice that leaves nothing.
    """
    global _choice
    _gather.cache_clear()
    _gather(choice)
    _choice = choice


def chosen() -> Choice:
    """Return the choice of this process, for processes that it starts."""
    return _choice


def record() -> dict[str, Any]:
    """Return the difference of the run's vocabulary from that of this folder, for files; {} if there is none.

    `own` holds name, file and digest of the effects from files, `left_out` the names of effects that were left out.
    """
    difference = _gather(_choice)[1]
    return difference if any(difference.values()) else {}


@cache
def _gather(choice: Choice) -> tuple[dict[str, Effect], dict[str, list]]:
    """Return the effects of a choice by name, in the order of their numbers, and the keys of `record`."""
    effects, added = dict(built_in()), []
    for file in choice.files:
        effect, digest = read_effect(Path(file))
        numbers = {other.number: other.name for other in effects.values()}
        if effect.name in effects:
            raise InputError(f"{file}: its effect is called {effect.name}, as another is; give it a name of its own")
        if other := numbers.get(effect.number):
            raise InputError(f"{file}: number {effect.number} is that of {other}; leave it out for the next free one")
        effects[effect.name] = replace(effect, number=effect.number or max(numbers) + 1)
        added.append({"name": effect.name, "file": Path(file).name, "sha256": digest})
    known = f"known effects: {', '.join(effects)}"
    for file, keys in zip(choice.files, added, strict=True):
        for special_case in sorted(set(effects[keys["name"]].special_cases) - {*effects, *PROPERTIES}):
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
    added = [keys for keys in added if keys["name"] in kept]
    return kept, {"own": added, "left_out": [name for name in effects if name not in kept]}
