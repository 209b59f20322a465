"""An effect from a file outside the library, checked as a whole before anything runs with it."""

import hashlib
import inspect
import re
import sys
import traceback
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from spotcheck.errors import InputError
from spotcheck.model.baseline import Baseline
from spotcheck.model.conditions import FrameConditions, crop_grid
from spotcheck.model.effect import (
    PROPERTIES,
    AppliedEffect,
    Effect,
    EffectScales,
    Need,
    Parameter,
    RandomStep,
    Step,
    keyword_names_of,
)
from spotcheck.model.forward import LAW_PARAMETERS, ForwardModel, RandomStreams
from spotcheck.model.stage import Stage
from spotcheck.schema import read_schema
from spotcheck.sensor import SensorModel

# Scales of a spot as the paper has it, and the camera on which an effect is tried, with frames of so many pixels.
EXAMPLE = EffectScales(18.0, 640.0, 1023.0, 240.0, 1e-4, 13.0, 0.11, 0.17, 9e-4)
SENSOR = SensorModel(0.11, 13.0, black_level_dn=12.0, full_scale_dn=1023.0)
ROWS, COLUMNS = 10, 12
# Stages whose functions are called without anything drawn.
NEVER_RANDOM = (Stage.BLUR, Stage.ADDED_LIGHT, Stage.SMEAR, Stage.READ_NOISE, Stage.RESPONSE, Stage.DIGITAL)
# Random numbers of one step, and how far their mean and deviation may be from those of its quadrature [deviations].
DRAWS, MEAN_OFF, DEVIATION_OFF = 1000, 0.25, 0.3


def read_effect(path: Path) -> tuple[Effect, str]:
    """Return the effect that a Python file defines as `EFFECT`, and the file's SHA-256 in hex.

    Raises `InputError` if there is no file, if it cannot be run, and if it defines no usable effect.
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
        kind = type(effect).__name__
        raise InputError(f"{path}: EFFECT is of type {kind}; it must be a spotcheck.model.effect.Effect")
    if fault := next(_faults(effect), None):
        raise InputError(f"{path}: {fault}")
    return effect, digest


def _run(path: Path, source: bytes, name: str) -> Any:
    """Return EFFECT of a file, None if it defines none. No bytecode is kept beside the user's file."""
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
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        where = f" line {lines[-1]}" if lines else ""
        text = f"{type(error).__name__}: {error}".splitlines()[0].rstrip(": ")
        raise InputError(f"{path}{where}: {text}; it must be Python that runs without an error") from None
    return vars(module).get("EFFECT")


def _faults(effect: Effect) -> Iterator[str]:
    """Yield what is wrong with an effect and what would be right; only the first is to be trusted."""
    # A verdict speaks of `all` effects in the place of a name.
    if not isinstance(effect.name, str) or not re.fullmatch(r"(?!all$)[a-z][a-z0-9_]*", effect.name):
        yield f"name is {effect.name!r}; it must be a word of small letters, digits and _, and not all"
    if not isinstance(effect.sentence, str) or not effect.sentence.strip() or effect.sentence.endswith("."):
        yield f"sentence is {effect.sentence!r}; it must say what the effect does, without a full stop"
    if isinstance(effect.number, bool) or not isinstance(effect.number, int) or effect.number < 0:
        yield f"number is {effect.number!r}; leave it out, and the next free one is taken"
    yield from _faults_of_parameters(effect)
    for field, kinds, words in (
        ("needs", Need, "members of Need"),
        ("replaces", str, f"words out of {', '.join(LAW_PARAMETERS)}"),
        ("special_cases", str, "names of effects"),
    ):
        values = getattr(effect, field)
        is_known = field != "replaces" or set(values) <= set(LAW_PARAMETERS)
        if not isinstance(values, tuple) or not all(isinstance(value, kinds) for value in values) or not is_known:
            yield f"{field} is {values!r}; it must be a tuple of {words}"
    if effect.law_of not in ("", *PROPERTIES):
        yield f"law_of is {effect.law_of!r}; it must be one of {', '.join(PROPERTIES)}, or left out"
    yield from _faults_of_variants(effect)
    yield from _faults_of_starts(effect)
    for variant in effect.variants:
        for start in effect.starts(EXAMPLE):
            yield from _faults_of_use(AppliedEffect(effect, variant, tuple(map(float, start))))


def _faults_of_parameters(effect: Effect) -> Iterator[str]:
    parameters = effect.parameters
    if not isinstance(parameters, tuple) or not parameters or not all(isinstance(p, Parameter) for p in parameters):
        yield "parameters must be a tuple of Parameter(name, unit, low, high), the strength first: (Parameter(…),)"
    names = [parameter.name for parameter in parameters]
    for name, unit in ((parameter.name, parameter.unit) for parameter in parameters):
        if not isinstance(name, str) or not name.isidentifier() or names.count(name) > 1:
            yield f"parameters: {name!r} must be a word that stands once"
        if not isinstance(unit, str) or not unit:
            yield f"parameters: the unit of {name} is {unit!r}; it must be text, such as px, or 1 for none"
    if parameters[0].describes_variant:
        yield f"parameters: {names[0]} describes a variant; the first must be the strength, which a person is told"
    try:
        bounds = effect.bounds(EXAMPLE)
    except Exception as error:
        yield f"parameters: bounds raise {_text_of(error)}; they must be numbers or functions of the EffectScales"
    for name, (low, high) in zip(names, bounds, strict=True):
        if not low < high:
            yield f"parameters: {name} goes from {low:g} to {high:g}; the lowest must be below the highest"


def _faults_of_variants(effect: Effect) -> Iterator[str]:
    names = {parameter.name for parameter in effect.parameters}
    if not isinstance(effect.variants, dict) or not effect.variants:
        yield "variants must be a dict from members of an Enum to tuples of Step or RandomStep"
    for variant, steps in effect.variants.items():
        if not isinstance(variant, Enum) or not isinstance(variant.value, str):
            yield f"variants: {variant!r} must be a member of an Enum whose value is text, such as Only.ONLY"
        if not isinstance(steps, tuple) or not steps or not all(isinstance(step, Step | RandomStep) for step in steps):
            yield f"variants: {variant!r} must have a tuple of Step or RandomStep: (Step(Stage.…, function),)"
        for step in steps:
            if not isinstance(step.stage, Stage):
                yield f"variants: {step.stage!r} must be a member of Stage"
            if isinstance(step, RandomStep) and step.stage in NEVER_RANDOM:
                yield f"a RandomStep cannot act at the stage {step.stage.title}; make it a Step, or take another stage"
            arguments = (*step.stage.value.arguments, *(("drawn",) if isinstance(step, RandomStep) else ()))
            try:
                inspect.signature(step.function).bind(*arguments, **dict.fromkeys(keyword_names_of(step.function)))
            except (TypeError, ValueError):
                yield f"a function at the stage {step.stage.title} must be f({', '.join([*arguments, '*', *names])})"
            if unknown := sorted(set(step.keyword_names()) - names - {"full_scale_dn"}):
                yield f"a function at the stage {step.stage.title} takes {unknown[0]}, which is no parameter"


def _faults_of_starts(effect: Effect) -> Iterator[str]:
    try:
        starts = [tuple(start) for start in effect.starts(EXAMPLE)]
    except Exception as error:
        yield f"starts raises {_text_of(error)}; it must be a function of the EffectScales that gives a list of tuples"
    if not starts:
        yield "starts gives none; it must give at least one tuple of values"
    names = ", ".join(parameter.name for parameter in effect.parameters)
    low, high = effect.bounds(EXAMPLE).T
    for start in starts:
        if len(start) != len(effect.parameters) or not np.isfinite(start).all():
            yield f"starts gives {start}; each must hold a number for {names}"
        if (np.array(start) < low).any() or (np.array(start) > high).any():
            yield f"starts gives {start}, outside the bounds of {names}"


def _faults_of_use(applied: AppliedEffect) -> Iterator[str]:
    """Yield what is wrong with keys of instrument.yaml, draws, and readings of a small frame."""
    sections = read_schema("instrument")["properties"]
    try:
        keys = list(applied.instrument_keys(SENSOR))
        wrong = [key for key in keys if key.partition(".")[2] not in sections[key.partition(".")[0]]["properties"]]
    except Exception as error:
        yield f"instrument_keys raises {_text_of(error)}; it must be f(sensor, variant, *, …) and give sensor.key"
    if wrong:
        yield f"instrument_keys names {wrong[0]}, which is no key of instrument.yaml"
    values = ", ".join(f"{name} = {value:g}" for name, value in applied.parameters.items())
    gone = applied.with_value(applied.effect.parameters[0].name, applied.effect.vanishes_at)
    try:
        for step in applied.effect.variants[applied.variant]:
            yield from _faults_of_draws(applied, step)
        model = _example(applied)
        if not all(np.isfinite(model.light(_example_frame(number)).total).all() for number in range(2)):
            yield f"function returns what is not finite at {values}; it must return numbers"
        signal, distribution = np.linspace(-0.1, 3.0, 2000) * SENSOR.full_scale_dn, model.distribution()
        for transfer in (*distribution.charge, *distribution.response, *distribution.digital):
            if np.any(np.diff(transfer(signal)) < -1e-9 * SENSOR.full_scale_dn):
                yield f"function returns less for a larger signal at {values}; at this stage it must never decrease"
        expected = [model.expected(_example_frame(number)) for number in range(2)]
        drawn = model.sample(_example_frame(0), RandomStreams(1, 0, 0))
        has_zero = np.isfinite(applied.effect.vanishes_at) and not applied.effect.special_cases
        nothing = _example(gone) if has_zero else _example()
        change = nothing.expected(_example_frame(0)).mean - _example().expected(_example_frame(0)).mean
    except Exception as error:
        yield f"function raises {_text_of(error)} at {values}; it must broadcast over rows and columns"
    parts = [drawn, *(part for reading in expected for part in (reading.mean, reading.variance))]
    if any(np.shape(part) != (ROWS, COLUMNS) for part in parts):
        yield f"function returns an array that does not broadcast to rows and columns at {values}"
    if not all(np.isfinite(part).all() for part in parts):
        yield f"function returns what is not finite at {values}; it must return numbers"
    if np.max(np.abs(change)) > 1e-6 * SENSOR.full_scale_dn:
        yield f"vanishes_at is {applied.effect.vanishes_at:g}, but with it the function still changes readings"


def _faults_of_draws(applied: AppliedEffect, step: Step | RandomStep) -> Iterator[str]:
    """Yield a difference between what a random step draws and the quadrature that stands for it."""
    if not isinstance(step, RandomStep):
        return
    bound = next(other for other in applied.steps_at(step.stage) if other.step is step)
    rng, drawn = np.random.default_rng(1), np.empty(0)
    while drawn.size < DRAWS:
        drawn = np.append(drawn, bound.call(step.draw, rng, (ROWS, COLUMNS)))
    values, weights = bound.average()
    mean = float(weights @ values)
    deviation = float(np.sqrt(weights @ (values - mean) ** 2))
    is_off = abs(drawn.mean() - mean) > MEAN_OFF * deviation or abs(drawn.std() - deviation) > DEVIATION_OFF * deviation
    if is_off or not np.isclose(np.sum(weights), 1.0):
        yield (
            f"draw at the stage {step.stage.title} has the mean {drawn.mean():.3g} and the deviation {drawn.std():.3g},"
            f" but its quadrature has {mean:.3g} and {deviation:.3g}, with weights whose sum is {np.sum(weights):.3g};"
            " both must agree, and weights sum to 1"
        )


def _example(*effects: AppliedEffect) -> ForwardModel:
    return ForwardModel(Baseline(0.0, "free", False, 2e-4), SENSOR, None, effects)


def _example_frame(number: int) -> FrameConditions:
    """Return one of two frames of a small spot: other exposures, angles and places in the order of acquisition."""
    grid = crop_grid(range(COLUMNS), range(ROWS), COLUMNS, ROWS)
    exposure_s = 1e-4 * (1 + number)
    return FrameConditions(grid, 5.3, 4.6, exposure_s, 2e-4, 2e-4, np.pi / 2 * number, float(number), 640.0, 3.0)


def _text_of(error: Exception) -> str:
    """Return an exception in one line, with the line of the user's file."""
    frames = traceback.extract_tb(error.__traceback__)
    text = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}".rstrip(": ")
    return f"{text} (line {frames[-1].lineno})" if frames else text
