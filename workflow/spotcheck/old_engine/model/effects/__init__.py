"""The vocabulary of effects: every file in this folder is one, and a run may add files of its own and leave some out.

The vocabulary is chosen once for a process, by the command line, and not handed down: it belongs to the run as the
library's code does. Every stage of a run must know the same effects, a name that a file holds must mean one thing
wherever it is read, and processes that a stage starts are given the choice, from which they load it anew (functions of
a file cannot be sent to them).
"""

import importlib
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from spotcheck.errors import InputError
from spotcheck.old_engine.model.effect import Effect
from spotcheck.old_engine.model.effect_file import read_effect


class Choice(NamedTuple):
    """Files that each add an effect, and the names of all effects that stay (none: all) or of those that go."""

    files: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    without: tuple[str, ...] = ()


# The vocabulary as this folder has it.
LIBRARY = Choice()
_choice = LIBRARY


class Vocabulary(NamedTuple):
    """Effects by name, in the order of their numbers; name, file and SHA-256 of each that was added; those that were
    left out."""

    effects: Mapping[str, Effect]
    own: tuple[tuple[str, str, str], ...] = ()
    left_out: tuple[Effect, ...] = ()


@cache
def built_in() -> dict[str, Effect]:
    """Effects of this folder by name, in the order of their numbers."""
    names = [found.name for found in pkgutil.iter_modules(__path__)]
    effects = [importlib.import_module(f"{__name__}.{name}").EFFECT for name in names]
    return {effect.name: effect for effect in sorted(effects, key=lambda effect: effect.number)}


def vocabulary() -> Mapping[str, Effect]:
    """The effects of this run by name, in the order of their numbers."""
    return _gathered(_choice).effects


def choose(choice: Choice = LIBRARY) -> None:
    """Set the vocabulary of this process, by default that of this folder.

    Raises `InputError` for a file that holds no sound effect, a name or number that is taken, a name that no effect
    has, and a choice that leaves nothing.
    """
    global _choice
    _gathered.cache_clear()
    _gathered(choice)
    _choice = choice


def chosen() -> Choice:
    """The choice of this process, for processes that it starts."""
    return _choice


def record(among: Callable[[Effect], bool] = lambda effect: True) -> dict[str, Any]:
    """What sets the run's vocabulary apart from that of this folder, for files: effects that were added, with name and
    digest of their files, and names of those left out; of some effects only. {} where there is no difference."""
    found = _gathered(_choice)
    own = [
        {"name": name, "file": file, "sha256": digest}
        for name, file, digest in found.own
        if name in found.effects and among(found.effects[name])
    ]
    left_out = [effect.name for effect in found.left_out if among(effect)]
    return {"own": own, "left_out": left_out} if own or left_out else {}


@cache
def _gathered(choice: Choice) -> Vocabulary:
    effects, own = _with_files(choice.files)
    known = f"known effects: {', '.join(effects)}"
    for file, (name, *_) in zip(choice.files, own, strict=True):
        for part in effects[name].contains:
            if isinstance(part, str) and part not in effects:
                raise InputError(f"{file}: contains {part}, which is no effect; {known}")
    if choice.only and choice.without:
        raise InputError("vocabulary: has both only and without; name the effects that stay, or those that go")
    for key in ("only", "without"):
        for name in getattr(choice, key):
            if name not in effects:
                raise InputError(f"vocabulary: {key} names {name}, which is no effect; {known}")
    left_out = [name for name in effects if name in choice.without or (choice.only and name not in choice.only)]
    if len(left_out) == len(effects):
        raise InputError("vocabulary: without names every effect; leave at least one")
    kept = {name: effect for name, effect in effects.items() if name not in left_out}
    return Vocabulary(kept, own, tuple(effects[name] for name in left_out))


def _with_files(files: Sequence[str]) -> tuple[dict[str, Effect], tuple[tuple[str, str, str], ...]]:
    """The effects of this folder and of some files by name, in the order of their numbers; name, file and SHA-256 of
    each that was added."""
    effects, own = dict(built_in()), []
    for file in files:
        effect, digest = read_effect(Path(file))
        numbers = {other.number: other.name for other in effects.values()}
        if effect.name in effects:
            raise InputError(f"{file}: its effect is called {effect.name}, as another is; give it a name of its own")
        if effect.number in numbers:
            raise InputError(
                f"{file}: number {effect.number} is that of {numbers[effect.number]}; leave it out, and the next free"
                " one is taken"
            )
        effects[effect.name] = effect._replace(number=effect.number or max(numbers) + 1)
        own.append((effect.name, Path(file).name, digest))
    return dict(sorted(effects.items(), key=lambda item: item[1].number)), tuple(own)
