"""Read an effect from a Python file of the user, and check it as a whole before anything runs with it.

An effect is a deviation from the baseline model; a variant is one of several formulas for it. A step is a function that
acts at a stage of the chain from laser to reading; a random step also takes a number or field that is drawn, and has a
quadrature: values and weights whose weighted sums are means over the draw. Bounds and starting values of parameters are
functions of the scales of a dataset (`EffectScales`).
"""

import inspect
import re
import runpy
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np

from spotcheck.errors import InputError
from spotcheck.io.provenance import file_digest
from spotcheck.io.schema import read_schema
from spotcheck.model.baseline import Baseline
from spotcheck.model.conditions import FrameConditions, crop_grid
from spotcheck.model.effect import PROPERTIES, AppliedEffect, Effect, EffectScales, RandomStep, Step, keyword_names_of
from spotcheck.model.forward import LAW_PARAMETERS, ForwardModel, RandomStreams
from spotcheck.model.stage import Stage
from spotcheck.sensor import SensorModel

# Scales of a spot as the paper has it, for which bounds and starting values are evaluated.
EXAMPLE = EffectScales(
    sigma_px=18.0, peak_dn=640.0, full_scale_dn=1023.0, crop_px=240.0, shortest_s=1e-4, read_noise_e=13.0,
    gain_dn_per_e=0.11, width_exponent=0.17, longest_s=9e-4,
)  # fmt: skip
# Camera and frame size with which the effect is simulated.
SENSOR = SensorModel(0.11, 13.0, black_level_dn=12.0, full_scale_dn=1023.0)
ROWS, COLUMNS = 10, 12  # [px]
GRID = crop_grid(range(COLUMNS), range(ROWS), COLUMNS, ROWS)
# A small spot, and the same at another exposure and angle and another place in the order of acquisition.
FRAME = FrameConditions(
    GRID, x0=5.3, y0=4.6, exposure_s=1e-4, longest_s=2e-4, reference_s=2e-4, order=0.0, peak_dn=640.0, sigma_px=3.0
)
FRAMES = (FRAME, replace(FRAME, exposure_s=2e-4, angle=np.pi / 2, order=1.0))
# The model without an effect.
PLAIN = ForwardModel(Baseline(laser_px=0.0, photon_budget="free", top_hat=False, longest_s=2e-4), SENSOR)
# Stages at which random steps are not supported.
NEVER_RANDOM = (Stage.BLUR, Stage.ADDED_LIGHT, Stage.SMEAR, Stage.READ_NOISE, Stage.RESPONSE, Stage.DIGITAL)
# Number of draws of a random step, and how far their mean and standard deviation may be from those of its quadrature,
# both in standard deviations of the quadrature.
DRAWS, MAX_MEAN_ERROR, MAX_DEVIATION_ERROR = 1000, 0.25, 0.3
# Signals [full scale] at which functions of the sensor must not decrease, and the decrease that counts as rounding.
SIGNAL_RANGE, SIGNALS, DECREASE_TOLERANCE = (-0.1, 3.0), 2000, 1e-9
# Largest change of readings [full scale] by an effect at the strength where it vanishes.
VANISHED_TOLERANCE = 1e-6


def read_effect(path: Path) -> tuple[Effect, str]:
    """Return the effect that a Python file defines as `EFFECT`, and the SHA-256 of the file in hex.

    Raises `InputError`, with the line of the file if possible, if there is no file, if it cannot be run, or if it
    defines no usable effect.
    """
    if not path.is_file():
        raise InputError(f"{path}: is no file; name a Python file that defines EFFECT")
    try:
        with _explain_errors("", "it must be Python that can be run without an error"):
            digest = file_digest(path)
            # `run_path` writes no bytecode next to the user's file.
            effect: Any = runpy.run_path(str(path)).get("EFFECT")
        with _explain_errors("EFFECT: ", "its attributes must be as spotcheck.model.effect.Effect says"):
            _check_attributes(effect)
            _check_variants(effect)
            for start in _check_starts(effect):
                for variant in effect.variants:
                    _check_use(AppliedEffect(effect, variant, start))
    except InputError as fault:
        # The last line of the user's file in the traceback, or the line of a syntax error.
        cause = fault.__cause__
        calls = traceback.extract_tb(cause.__traceback__ if cause else None)
        lines = [call.lineno for call in calls if call.filename == str(path)] or [getattr(cause, "lineno", None)]
        raise InputError(f"{path} line {lines[-1]}: {fault}" if lines[-1] else f"{path}: {fault}") from None
    return effect, digest


@contextmanager
def _explain_errors(what: str, remedy: str) -> Iterator[None]:
    """Run the body of a `with` statement, and turn an error of the user's code in it into an `InputError`.

    Its message is `what`, the place in the user's file, then the error, then `remedy`, which says what would be right.
    """
    try:
        yield
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        # The whole text of a syntax error repeats the name of the file.
        text = f"{type(error).__name__}: {getattr(error, 'msg', error)}".splitlines()[0].rstrip(": ")
        raise InputError(f"{what}{text}; {remedy}") from error


# The checks below raise `InputError` for the first fault. The message says what is wrong and what would be right; the
# path is added by `read_effect`.


def _check_attributes(effect: Any) -> None:
    """Check types and values of the attributes of an effect, except variants, bounds and starting values."""
    if not isinstance(effect, Effect):
        what = "defines no EFFECT" if effect is None else f"EFFECT is of type {type(effect).__name__}"
        raise InputError(f"{what}; it must say EFFECT = Effect(name=…, …) with spotcheck.model.effect.Effect")
    # In a verdict the name "all" stands for all effects.
    if not isinstance(effect.name, str) or not re.fullmatch(r"(?!all$)[a-z][a-z0-9_]*", effect.name):
        raise InputError(f"name is {effect.name!r}; it must be a word of small letters, digits and _, and not all")
    if not isinstance(effect.sentence, str) or not re.search(r"[^.\s]$", effect.sentence):
        raise InputError(f"sentence is {effect.sentence!r}; it must say what the effect does, without a full stop")
    if isinstance(effect.number, bool) or not isinstance(effect.number, int) or effect.number < 0:
        raise InputError(f"number is {effect.number!r}; leave it out, and the next free one is taken")
    if effect.law_of not in ("", *PROPERTIES):
        raise InputError(f"law_of is {effect.law_of!r}; it must be one of {', '.join(PROPERTIES)}, or left out")
    for attribute in ("parameters", "needs", "replaces", "special_cases"):
        # The type hint is tuple[type of the elements, ...].
        values, (element_type, _) = getattr(effect, attribute), get_args(get_type_hints(Effect)[attribute])
        if not isinstance(values, tuple) or not all(isinstance(value, element_type) for value in values):
            raise InputError(f"{attribute} is {values!r}; it must be a tuple of {element_type.__name__}: (…,)")
    if not set(effect.replaces) <= set(LAW_PARAMETERS):
        raise InputError(f"replaces is {effect.replaces}; it must hold words out of {', '.join(LAW_PARAMETERS)}")
    names = [parameter.name for parameter in effect.parameters]
    for name, unit in ((parameter.name, parameter.unit) for parameter in effect.parameters):
        if not isinstance(name, str) or not name.isidentifier() or names.count(name) > 1:
            raise InputError(f"parameters: {name!r} must be a word that stands once")
        if not isinstance(unit, str) or not unit:
            raise InputError(f"parameters: the unit of {name} is {unit!r}; it must be text, such as px, or 1 for none")
    if not names or effect.parameters[0].is_variant_specific:
        raise InputError("parameters: the first must be the strength, which cannot be specific to a variant")


def _check_variants(effect: Effect) -> None:
    """Check the steps of each variant, their stages, and the names of the arguments of their functions."""
    names = [parameter.name for parameter in effect.parameters]
    if not isinstance(effect.variants, dict) or not effect.variants:
        raise InputError("variants must be a dict from members of an Enum to tuples of Step or RandomStep")
    for variant, steps in effect.variants.items():
        if not isinstance(variant, Enum) or not isinstance(variant.value, str):
            raise InputError(f"variants: {variant!r} must be a member of an Enum whose value is text, as Only.ONLY")
        if not isinstance(steps, tuple) or not steps or not all(isinstance(step, Step | RandomStep) for step in steps):
            raise InputError(f"variants: {variant} must have a tuple of Step or RandomStep: (Step(Stage.…, function),)")
        for step in steps:
            if not isinstance(step.stage, Stage):
                raise InputError(f"variants: {step.stage!r} must be a member of Stage")
            where, is_random = f"at the stage {step.stage.title}", isinstance(step, RandomStep)
            if is_random and step.stage in NEVER_RANDOM:
                raise InputError(f"a RandomStep cannot act {where}; make it a Step, or take another stage")
            arguments = [*step.stage.value.arguments.split(", "), *(["drawn"] if is_random else [])]
            with _explain_errors(f"function {where}: ", f"it must be f({', '.join([*arguments, '*', *names])})"):
                # `bind` raises TypeError if the function cannot be called like this.
                inspect.signature(step.function).bind(*arguments, **dict.fromkeys(keyword_names_of(step.function)))
            if unknown := sorted({*step.keyword_names()} - {*names, "full_scale_dn"}):
                raise InputError(f"a function {where} takes {unknown[0]}, which is no parameter; name it in parameters")


def _check_starts(effect: Effect) -> list[tuple[float, ...]]:
    """Check bounds and starting values for `EXAMPLE`; return for each start the values of all parameters."""
    names = [parameter.name for parameter in effect.parameters]
    with _explain_errors("parameters: bounds raise ", "they must be numbers or functions of the EffectScales"):
        low, high = effect.bounds(EXAMPLE).T
    for name, lowest, highest in zip(names, low, high, strict=True):
        if not lowest < highest:
            raise InputError(f"{name} goes from {lowest:g} to {highest:g}; the lowest must be below the highest")
    with _explain_errors("starts raises ", "it must be a function of the EffectScales that gives a list of tuples"):
        starts = [tuple(map(float, start)) for start in effect.starts(EXAMPLE)]
    if not starts:
        raise InputError("starts gives none; it must give at least one tuple of values")
    for start in starts:
        if len(start) != len(names) or not (np.isfinite(start) & (low <= start) & (start <= high)).all():
            words = f"a number for {', '.join(names)}, none outside the bounds of a parameter"
            raise InputError(f"starts gives {start}; each must hold {words}")
    return starts


def _check_use(applied: AppliedEffect) -> None:
    """Check that an effect with values sets valid keys of instrument.yaml and gives usable readings and draws."""
    effect, values = applied.effect, ", ".join(f"{name} = {value:g}" for name, value in applied.parameters.items())
    # Section of instrument.yaml and its schema, whose `properties` are the keys.
    sections = read_schema("instrument")["properties"].items()
    with _explain_errors("instrument_keys raises ", "it must be f(sensor, variant, *, …) and give sensor.key"):
        keys = set(applied.instrument_keys(SENSOR))
    if unknown := keys - {f"{name}.{key}" for name, section in sections for key in section.get("properties", ())}:
        raise InputError(f"instrument_keys names {unknown.pop()}, which is no key of instrument.yaml")
    remedy = f"at {values} it must return finite numbers that broadcast over rows and columns"
    with _explain_errors("function raises ", remedy):
        model = replace(PLAIN, effects=(applied,))
        signal, distribution = np.linspace(*SIGNAL_RANGE, SIGNALS) * SENSOR.full_scale_dn, model.distribution()
        # The functions of the signal [DN] at the well, at the response and at the digital stage.
        for transfer in (*distribution.charge, *distribution.response, *distribution.digital):
            if np.any(np.diff(transfer(signal)) < -DECREASE_TOLERANCE * SENSOR.full_scale_dn):
                raise InputError(f"function returns less for a larger signal at {values}; it must never decrease there")
        # A random frame, then mean and variance of the readings of each frame.
        images = [model.sample(FRAME, RandomStreams(seed=1, frame=0, site=0))]
        images += [moment for frame in FRAMES for moment in model.expected(frame)]
        if not all(np.shape(image) == (ROWS, COLUMNS) and np.isfinite(image).all() for image in images):
            raise InputError(f"function makes readings that are not finite or not one for each pixel; {remedy}")
        for stage in effect.stages:
            _check_draws(applied, stage)
        # An effect with special cases turns into one of them at this strength instead of vanishing.
        if np.isfinite(effect.vanishes_at) and not effect.special_cases:
            model = replace(PLAIN, effects=(applied.with_value(effect.parameters[0].name, effect.vanishes_at),))
            change = model.expected(FRAME).mean - PLAIN.expected(FRAME).mean
            if np.max(np.abs(change)) > VANISHED_TOLERANCE * SENSOR.full_scale_dn:
                raise InputError(f"vanishes_at is {effect.vanishes_at:g}, but it still changes readings there")


def _check_draws(applied: AppliedEffect, stage: Stage) -> None:
    """Check that draws of the random steps at a stage have the mean and standard deviation of their quadratures."""
    for step in applied.steps_at(stage):
        if step.random_step:
            rng, drawn = np.random.default_rng(1), np.empty(0)
            while drawn.size < DRAWS:
                drawn = np.append(drawn, step.call(step.random_step.draw, rng, (ROWS, COLUMNS)))
            # Mean and standard deviation of a draw by the quadrature, and the sum of its weights.
            values, weights = step.quadrature()
            mean = float(weights @ values)
            deviation, total = float(np.sqrt(weights @ (values - mean) ** 2)), np.sum(weights)
            is_off = abs(drawn.mean() - mean) > MAX_MEAN_ERROR * deviation
            is_off |= abs(drawn.std() - deviation) > MAX_DEVIATION_ERROR * deviation
            if is_off or not np.isclose(total, 1.0):
                raise InputError(
                    f"draw at the stage {stage.title} has the mean {drawn.mean():.3g} and the deviation"
                    f" {drawn.std():.3g}, but its quadrature has {mean:.3g} and {deviation:.3g}, with weights whose sum"
                    f" is {total:.3g}; both must agree, and weights sum to 1"
                )
