"""An effect from a file outside the library, checked as a whole before anything runs with it."""

import hashlib
import inspect
import re
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from spotcheck.errors import InputError
from spotcheck.old_engine.model import effect_trial
from spotcheck.old_engine.model.chain import Law
from spotcheck.old_engine.model.effect import (
    COMPONENTS,
    MARKS,
    NEEDS,
    Context,
    Effect,
    Parameter,
    Place,
    Present,
    Scatter,
)
from spotcheck.schema import read_schema

# What the function of an effect gets at each place, before its parameters by name.
ARGUMENTS = {
    Place.EXPOSURE: ("view", "exposure_s"),
    Place.WIDTH: ("view", "reference_px", "ratio"),
    Place.BRIGHTNESS: ("view",),
    Place.METRIC: ("view", "dx", "dy"),
    Place.PROFILE: ("view", "half"),
    Place.BLUR: ("view",),
    Place.ADDED: ("view", "spot", "amplitude", "sigma"),
    Place.MODULATION: ("view",),
    Place.PEDESTAL: ("view",),
    Place.CHARGE: ("view", "electrons"),
    Place.WELL: ("mean", "variance", "read_variance"),
    Place.NOISE: ("read_variance",),
    Place.RESPONSE: ("mean", "variance", "full_scale"),
    Place.DIGITAL: (),
}
# The same of what scatters.
DRAWS = {"gain": ("rng",), "centre": ("rng",), "row": ("rows", "rng"), "field": ("shape", "rng")}
SHARED = ("frame", "site", "sensor")
# Bounds and starts are tried on a spot as the paper has it.
EXAMPLE = Context(18.0, 640.0, 1023.0, 240.0, 1e-4, 13.0, 0.11, 0.17, 9e-4)


def read_effect(path: Path) -> tuple[Effect, str]:
    """The effect that a Python file defines as `EFFECT`, and the file's SHA-256 in hex.

    Raises `InputError` where there is no file, where it cannot be run, and where it defines no sound effect.
    """
    if not path.is_file():
        raise InputError(f"{path}: is no file; name a Python file that defines EFFECT")
    try:
        source = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a Python file that defines EFFECT") from None
    digest = hashlib.sha256(source).hexdigest()
    effect = _run(path, source, f"effect_{digest[:12]}")
    if effect is None:
        raise InputError(f"{path}: defines no EFFECT; it must say EFFECT = Effect(name=…, …)")
    if not isinstance(effect, Effect):
        raise InputError(
            f"{path}: EFFECT is of type {type(effect).__name__}; it must be a spotcheck.old_engine.model.effect.Effect"
        )
    if fault := next(_faults(effect), None):
        raise InputError(f"{path}: {fault}")
    return effect, digest


def _run(path: Path, source: bytes, name: str) -> Any:
    """EFFECT of a file; None where it defines none. No bytecode is kept beside the user's file."""
    module = ModuleType(name)
    module.__file__ = str(path)
    # Classes of the file look their module up.
    sys.modules[name] = module
    try:
        exec(compile(source, str(path), "exec"), vars(module))
    except SyntaxError as error:
        where = f" line {error.lineno}" if error.lineno else ""
        raise InputError(f"{path}{where}: {error.msg}; it must be Python that can be run") from None
    except (Exception, SystemExit) as error:
        lines = [own.lineno for own in traceback.extract_tb(error.__traceback__) if own.filename == str(path)]
        where = f" line {lines[-1]}" if lines else ""
        text = f"{type(error).__name__}: {error}".splitlines()[0].rstrip(": ")
        raise InputError(f"{path}{where}: {text}; it must be Python that runs without an error") from None
    return vars(module).get("EFFECT")


def _faults(effect: Effect) -> Iterator[str]:
    """What is wrong with an effect, and what would be right; what follows the first is not to be trusted."""
    # A verdict speaks of `all` effects in the place of a name.
    if not isinstance(effect.name, str) or not re.fullmatch(r"(?!all$)[a-z][a-z0-9_]*", effect.name):
        yield f"name is {effect.name!r}; it must be a word of small letters, digits and _, and not all"
    if not isinstance(effect.sentence, str) or not effect.sentence.strip() or effect.sentence.endswith("."):
        yield f"sentence is {effect.sentence!r}; it must say what the effect does, without a full stop"
    if not isinstance(effect.place, Place):
        yield f"place is {effect.place!r}; it must be one of Place"
    if isinstance(effect.number, bool) or not isinstance(effect.number, int) or effect.number < 0:
        yield f"number is {effect.number!r}; leave it out, and the next free one is taken"
    yield from _of_parameters(effect)
    yield from _of_words(effect)
    yield from _of_scatter(effect)
    yield from _of_functions(effect)
    yield from _of_adopts(effect)
    yield from effect_trial.faults(effect, EXAMPLE)


def _of_parameters(effect: Effect) -> Iterator[str]:
    own = effect.parameters
    if not isinstance(own, tuple) or not own or not all(isinstance(p, Parameter) for p in own):
        yield "parameters must be a tuple of Parameter(name, unit, low, high), the strength first: (Parameter(…),)"
    names = [p.name for p in own]
    for p in own:
        if not isinstance(p.name, str) or not p.name.isidentifier() or names.count(p.name) > 1:
            yield f"parameters: {p.name!r} must be a word that stands once"
        if not isinstance(p.unit, str) or not p.unit:
            yield f"parameters: the unit of {p.name} is {p.unit!r}; it must be text, such as px, or 1 for none"
    if own[0].inner:
        yield f"parameters: {own[0].name} is inner; the first must be the strength, which a person is told"
    try:
        bounds = effect.bounds(EXAMPLE)
    except Exception as error:
        yield f"parameters: bounds raise {_said(error)}; they must be numbers or functions of the Context"
    for p, (low, high) in zip(own, bounds, strict=True):
        if not low < high:
            yield f"parameters: {p.name} goes from {low:g} to {high:g}; the lowest must be below the highest"


def _of_words(effect: Effect) -> Iterator[str]:
    """Fields that list words, each of a few."""
    forms, names = effect.forms, tuple(p.name for p in effect.parameters)
    if not _is_tuple(forms) or not forms or len(set(forms)) < len(forms) or (len(forms) > 1 and "" in forms):
        yield f"forms is {forms!r}; it must be a tuple of different names, or left out"
    for field, words in (("needs", tuple(NEEDS)), ("marks", MARKS), ("rounded", forms), ("replaces", Law._fields)):
        own = getattr(effect, field)
        if not _is_tuple(own) or not set(own) <= set(words):
            yield f"{field} is {own!r}; it must be a tuple, each of {', '.join(map(repr, words))}"
    try:
        known = all(form in forms and set(own) <= set(names) for form, own in effect.idle.items())
    except (AttributeError, TypeError):
        known = False
    if not known:
        yield f"idle is {effect.idle!r}; it must give for a form a tuple of parameters"
    if not isinstance(effect.contains, tuple) or not all(isinstance(own, str | Place) for own in effect.contains):
        yield f"contains is {effect.contains!r}; it must be a tuple of names of effects, or of places"
    if effect.spectral and not (effect.place is Place.MODULATION and "site" in forms and len(names) == 4):
        yield (
            "spectral is for a Place.MODULATION with a form site and four parameters, depth, period, direction and"
            " phase; leave it out"
        )
    if not isinstance(effect.flats, str):
        yield f"flats is {effect.flats!r}; it must say why levels of flats cannot show the effect, or be empty"


def _of_scatter(effect: Effect) -> Iterator[str]:
    own = effect.scatter
    if (own is not None) != (effect.place is Place.SCATTER):
        yield "scatter and place: an effect of Place.SCATTER, and no other, has a Scatter(of, shared, component)"
    if own is None:
        if effect.place is Place.NOISE and len(effect.parameters) > 1:
            yield "parameters: white noise is told by one number; give the strength alone"
        return
    if not isinstance(own, Scatter):
        yield f"scatter is {own!r}; it must be Scatter(of, shared, component)"
    for value, known in ((own.of, DRAWS), (own.shared, SHARED), (own.component, COMPONENTS)):
        if value not in known:
            yield f"scatter holds {value!r}; it must be one of {', '.join(known)}"
    if own.of in ("gain", "centre", "row") and own.shared != "frame":
        yield f"scatter: a {own.of} is drawn for each frame; shared must be frame"
    if len(effect.parameters) != COMPONENTS[own.component]:
        yield (
            f"parameters: {len(effect.parameters)} are given, but of the component {own.component} a fit tells"
            f" {COMPONENTS[own.component]}"
        )


def _of_functions(effect: Effect) -> Iterator[str]:
    if effect.place is Place.SHAPE:
        if effect.function is not None or list(effect.starts(EXAMPLE)):
            yield "function and starts: a shape is learned, not fitted; leave the function out and let starts give none"
        return
    if not callable(effect.function):
        yield "function is missing; it must do what the place says"
        return
    before = ARGUMENTS[effect.place] if effect.scatter is None else DRAWS[effect.scatter.of]
    named = [p.name for p in effect.parameters] + (["form"] if len(effect.forms) > 1 else [])
    try:
        inspect.signature(effect.function).bind(*before, **dict.fromkeys(named))
    except (TypeError, ValueError):
        yield f"function cannot be called as its place asks; it must be f({', '.join([*before, '*', *named])})"
    try:
        starts = [tuple(own) for own in effect.starts(EXAMPLE)]
    except Exception as error:
        yield f"starts raises {_said(error)}; it must be a function of the Context that gives a list of tuples"
    if not starts and not effect.spectral:
        yield "starts gives none; it must give at least one tuple of values"
    for own in starts:
        if len(own) != len(effect.parameters) or not np.isfinite(own).all():
            yield f"starts gives {own}; each must hold a number for {', '.join(p.name for p in effect.parameters)}"


def _of_adopts(effect: Effect) -> Iterator[str]:
    """Keys of instrument.yaml that say the same."""
    if effect.adopts is None:
        return
    keys = read_schema("instrument")["properties"]
    for form in effect.forms:
        for start in effect.starts(EXAMPLE):
            try:
                found = Present(effect, form, tuple(start)).adopted(effect_trial.SENSOR)
                wrong = [key for key in found if key.partition(".")[2] not in keys[key.partition(".")[0]]["properties"]]
            except Exception as error:
                yield f"adopts raises {_said(error)}; it must be f(sensor, *, …) and give values of sensor.key"
                return
            if wrong:
                yield f"adopts names {wrong[0]}, which is no key of instrument.yaml"
                return


def _is_tuple(own: Any) -> bool:
    return isinstance(own, tuple) and all(isinstance(word, str) for word in own)


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".rstrip(": ")
