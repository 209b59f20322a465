"""The page that describes the vocabulary of effects, as Markdown."""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partialmethod
from pathlib import Path

from spotcheck.model.effect import Effect, EffectScales, Parameter, RandomStep
from spotcheck.model.effects import built_in, vocabulary
from spotcheck.model.stage import Stage
from spotcheck.report.pages import TEMPLATES

# Names of the scales that a bound may depend on, in the order of `EffectScales`.
SCALES = (
    "σ_g",
    "peak",
    "full scale",
    "crop",
    "shortest exposure",
    "read noise",
    "K",
    "power of t nearest to p1, p2",
    "longest exposure",
)

# Examples of effects, which the page shows.
MEAN_EXAMPLE = '''"""Vignetting: the light falls off from the frame's centre."""

import numpy as np

from spotcheck.model.effect import Effect, Only, Parameter, Stage, Step


def fall_off(frame, light_dn, *, a):
    """Return the light [DN] times 1 − a (r/100 px)², r from the frame's centre; never below 0."""
    pixels = frame.pixels
    r2 = (pixels.x - pixels.centre_x) ** 2 + (pixels.y - pixels.centre_y) ** 2
    return light_dn * np.maximum(1 - a * r2 / 100**2, 0.0)


EFFECT = Effect(
    name="vignetting",
    sentence="the light falls off from the frame's centre",
    parameters=(Parameter("a", "1", 0.0, 1.0),),
    variants={Only.ONLY: (Step(Stage.MODULATION, fall_off),)},
    starts=lambda scales: [(0.01,)],
)
'''
RANDOM_EXAMPLE = '''"""Mode hopping: the laser jumps between two modes of different power."""

import numpy as np

from spotcheck.model.effect import Effect, Need, Only, Parameter, RandomStep, Scope, Stage


def multiply(frame, peak_dn, factor):
    """Return the peak [DN] times a factor."""
    return peak_dn * factor


def draw_mode(rng, shape, *, rms):
    """Return the factor of one frame: 1 − rms or 1 + rms, with equal probability."""
    return 1 + rms * rng.choice((-1.0, 1.0))


def average_modes(*, rms):
    """Return both factors and their weights."""
    return np.array([1 - rms, 1 + rms]), np.array([0.5, 0.5])


EFFECT = Effect(
    name="mode_hopping",
    sentence="the laser jumps between two modes of different power",
    parameters=(Parameter("rms", "1", 0.0, 1.0),),
    variants={Only.ONLY: (RandomStep(Stage.BRIGHTNESS, multiply, Scope.FRAME, draw_mode, average_modes),)},
    starts=lambda scales: [(0.02,)],
    needs=(Need.FRAMES, Need.LAW),
)
'''


class _Expression:
    """An unknown quantity: arithmetic with it returns the formula as text."""

    def __init__(self, text: str, is_sum: bool = False):
        self.text, self.is_sum = text, is_sum

    def _join(self, sign: str, other, swapped: bool = False) -> "_Expression":
        """Return the formula of a binary operation; `swapped` if the other operand is on the left."""
        left, right = (other, self) if swapped else (self, other)
        is_product = sign in "×/"
        right_text = _text(right, is_product or sign == "−")
        return _Expression(f"{_text(left, is_product)} {sign} {right_text}", not is_product)

    __mul__, __rmul__ = partialmethod(_join, "×"), partialmethod(_join, "×", swapped=True)
    __truediv__, __rtruediv__ = partialmethod(_join, "/"), partialmethod(_join, "/", swapped=True)
    __add__, __radd__ = partialmethod(_join, "+"), partialmethod(_join, "+", swapped=True)
    __sub__, __rsub__ = partialmethod(_join, "−"), partialmethod(_join, "−", swapped=True)

    def __neg__(self):
        return _Expression(f"−{_text(self, True)}")


def _text(value: float | _Expression, in_brackets: bool = False) -> str:
    """Return a number or a formula as text; `in_brackets` puts brackets around a sum."""
    if isinstance(value, _Expression):
        return f"({value.text})" if value.is_sum and in_brackets else value.text
    if math.isinf(value):
        return "any"
    return f"{value:.12g}".replace("-", "−")


def describe_bound(end: float | Callable[[EffectScales], float]) -> str:
    """Return a bound of a parameter as a number, or as a formula if it depends on the data."""
    if not callable(end):
        return _text(end)
    try:
        return _text(end(EffectScales(*map(_Expression, SCALES))))  # type: ignore[arg-type]
    except TypeError:  # more than arithmetic
        return "set by the data"


def _parameter_row(parameter: Parameter, vanishes_at: float | None) -> str:
    """Return the table row of a parameter; `vanishes_at` is None unless the parameter is the strength."""
    notes = ["of the variant"] if parameter.is_variant_specific else []
    if vanishes_at is not None and not math.isnan(vanishes_at):
        notes.append("vanishes at " + ("∞" if math.isinf(vanishes_at) else _text(vanishes_at)))
    if parameter.negligible:
        notes.append(f"negligible if nearer than {describe_bound(parameter.negligible)}")
    bounds = (describe_bound(end) for end in (parameter.low, parameter.high))
    cells = (f"`{parameter.name}`", parameter.unit, *bounds, "; ".join(notes))
    return "| " + " | ".join(cells) + " |"


def _describe_stages(effect: Effect) -> str:
    """Return the stages at which an effect acts, and the scopes of its random steps."""
    if not effect.stages:
        return "Stage: profile (the baseline holds the learned shape)."
    texts = []
    for stage in effect.stages:
        steps = [step for variant in effect.variants.values() for step in variant if step.stage is stage]
        random_steps = [step for step in steps if isinstance(step, RandomStep)]
        scopes = sorted({step.scope.value for step in random_steps})
        drawn = f", drawn for each {' and '.join(scopes)}" if scopes else ""
        some = " in some variants" if 0 < len(random_steps) < len(steps) else ""
        texts.append(f"{stage.title} ({stage.value.action}{drawn}{some})")
    return f"Stage: {'; '.join(texts)}."


def describe_effect(effect: Effect) -> str:
    """Return the section of one effect: its sentence, stages, parameters and variants."""
    notes = [_describe_stages(effect)]
    if effect.needs:
        notes.append(f"Detectable only with: {', '.join(need.value for need in effect.needs)}.")
    if effect.replaces:
        notes.append(f"Replaces {', '.join(effect.replaces)}.")
    if effect.special_cases:
        notes.append(f"Special cases: {', '.join(map(_special_case, effect.special_cases))}.")
    if not effect.hidden_in_flats:
        notes.append("Also affects the levels of flats and darks.")
    if len(effect.variants) > 1:
        texts = []
        for variant in effect.variants:
            present = effect.parameters_of(variant)
            unused = [parameter.name for parameter in effect.parameters if parameter not in present]
            texts.append(f"`{variant.value}`" + (f" (without {', '.join(unused)})" if unused else ""))
        notes.append(f"Variants: {', '.join(texts)}.")
    if effect.reference:
        notes.append(f"Reference: {effect.reference}.")
    strength, *others = effect.parameters
    rows = [_parameter_row(strength, effect.vanishes_at), *(_parameter_row(parameter, None) for parameter in others)]
    link = f"[{effect.name}](../spotcheck/model/effects/{effect.name}.py)"
    title = link if effect.name in built_in() else effect.name
    return "\n".join(
        [
            f"## {effect.number}. {title}",
            "",
            f"{effect.sentence[0].upper()}{effect.sentence[1:]}.",
            "",
            "  \n".join(notes),
            "",
            "| parameter | unit | lowest | highest | |",
            "|---|---|---|---|---|",
            *rows,
            "",
        ]
    )


def _special_case(name: str) -> str:
    """Return an effect's name, or words for all laws of a quantity."""
    return name if name in vocabulary() else f"every law of the {name}"


def _tabulate_stages(effects: Sequence[Effect]) -> str:
    """Return the table of stages: what functions get and return, and which effects act there."""
    rows = []
    for stage in Stage:
        description = stage.value
        names = ", ".join(effect.name for effect in effects if stage in effect.stages)
        arguments = ", ".join(f"`{argument}`" for argument in description.arguments.split(", "))
        rows.append(f"| {stage.title} | {arguments} | {description.returns} | {names or '–'} |")
    head = "| stage, in the order of the chain | a function gets | and returns | effects |"
    return "\n".join([head, "|---|---|---|---|", *rows, ""])


def render_effects(effects: Iterable[Effect]) -> str:
    """Return the page in Markdown."""
    ordered = sorted(effects, key=lambda effect: effect.number)
    content = {
        "stages": _tabulate_stages(ordered),
        "sections": [describe_effect(effect) for effect in ordered],
        "mean_example": MEAN_EXAMPLE,
        "random_example": RANDOM_EXAMPLE,
    }
    return TEMPLATES.get_template("effects.md").render(**content)


def write_effects_page(path: Path) -> int:
    """Write the page of the current vocabulary and return the number of effects."""
    effects = vocabulary()
    # The page is part of the repository, not a result: it gets no sidecar with the run that wrote it.
    path.write_text(render_effects(effects.values()), encoding="utf-8")
    return len(effects)
