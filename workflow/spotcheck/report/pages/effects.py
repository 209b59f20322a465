"""The page that describes the vocabulary of effects, as Markdown.

An effect is a physical cause of a difference between model and frames. The vocabulary is the list of effects that a
run tests. Bounds of parameters may depend on scales of the data (`EffectScales`), such as the width of the spot; the
page shows such a bound as a formula.
"""

import math
from collections.abc import Callable, Iterable
from functools import partialmethod
from pathlib import Path

from spotcheck.model.effect import Effect, EffectScales, Parameter, RandomStep
from spotcheck.model.effects import built_in, vocabulary
from spotcheck.model.stage import Stage
from spotcheck.report.pages import TEMPLATES

# Names of the scales on the page, in the order of the fields of `EffectScales`.
SCALE_NAMES = ("σ_g", "peak", "full scale", "crop", "shortest exposure", "read noise", "K",
               "power of t nearest to p1, p2", "longest exposure")  # fmt: skip


class _Expression:
    """A scale without a value; arithmetic with it gives the formula as text instead of a number.

    `text` is the formula; `is_sum` says whether it needs brackets within a product.
    """

    def __init__(self, text: str, is_sum: bool = False):
        self.text, self.is_sum = text, is_sum

    def _join(self, sign: str, other, swapped: bool = False) -> "_Expression":
        """Return the formula of a binary operation; `other` is a number or formula, on the left if `swapped`."""
        left, right = (other, self) if swapped else (self, other)
        is_product = sign in "×/"
        right_text = _format_term(right, is_product or sign == "−")
        return _Expression(f"{_format_term(left, is_product)} {sign} {right_text}", not is_product)

    __mul__, __rmul__ = partialmethod(_join, "×"), partialmethod(_join, "×", swapped=True)
    __truediv__, __rtruediv__ = partialmethod(_join, "/"), partialmethod(_join, "/", swapped=True)
    __add__, __radd__ = partialmethod(_join, "+"), partialmethod(_join, "+", swapped=True)
    __sub__, __rsub__ = partialmethod(_join, "−"), partialmethod(_join, "−", swapped=True)

    def __neg__(self) -> "_Expression":
        return _Expression(f"−{_format_term(self, True)}")


def _format_term(value: float | _Expression, in_brackets: bool = False) -> str:
    """Return a number or a formula as text; `in_brackets` puts brackets around a sum. Infinity is "any"."""
    if isinstance(value, _Expression):
        return f"({value.text})" if value.is_sum and in_brackets else value.text
    if math.isinf(value):
        return "any"
    return f"{value:.12g}".replace("-", "−")


def describe_bound(bound: float | Callable[[EffectScales], float]) -> str:
    """Return a bound of a parameter as a number, or as a formula of the scales if it depends on the data."""
    if not callable(bound):
        return _format_term(bound)
    try:
        return _format_term(bound(EffectScales(*map(_Expression, SCALE_NAMES))))  # type: ignore[arg-type]
    except TypeError:  # the function does more than arithmetic, which `_Expression` does not support
        return "set by the data"


def list_remarks(effect: Effect, parameter: Parameter) -> list[str]:
    """Return remarks on a parameter of an effect: that it belongs to the variant, and which values have no effect."""
    remarks = ["of the variant"] if parameter.is_variant_specific else []
    # The first parameter is the strength. NaN: the effect vanishes at no value of it.
    if parameter is effect.parameters[0] and not math.isnan(effect.vanishes_at):
        vanishes_at = "∞" if math.isinf(effect.vanishes_at) else _format_term(effect.vanishes_at)
        remarks.append(f"vanishes at {vanishes_at}")
    if parameter.negligible:
        remarks.append(f"negligible if nearer than {describe_bound(parameter.negligible)}")
    return remarks


def _describe_stages(effect: Effect) -> str:
    """Return the stages of the forward model at which an effect acts, and the scopes of its random steps.

    The scope of a random step says whether it is drawn for each frame, for each site, or once for the sensor.
    """
    if not effect.stages:
        return "Stage: profile (the baseline holds the learned shape)."
    texts = []
    for stage in effect.stages:
        steps = [step for variant in effect.variants.values() for step in variant if step.stage is stage]
        random_steps = [step for step in steps if isinstance(step, RandomStep)]
        scopes = sorted({step.scope.value for step in random_steps})
        scope_text = f", drawn for each {' and '.join(scopes)}" if scopes else ""
        variant_text = " in some variants" if 0 < len(random_steps) < len(steps) else ""
        texts.append(f"{stage.title} ({stage.value.action}{scope_text}{variant_text})")
    return f"Stage: {'; '.join(texts)}."


def describe_effect(effect: Effect) -> list[str]:
    """Return sentences on an effect: its stages, what it needs and replaces, its special cases, variants, reference."""
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
            used = effect.parameters_of(variant)
            unused = [parameter.name for parameter in effect.parameters if parameter not in used]
            texts.append(f"`{variant.value}`" + (f" (without {', '.join(unused)})" if unused else ""))
        notes.append(f"Variants: {', '.join(texts)}.")
    if effect.reference:
        notes.append(f"Reference: {effect.reference}.")
    return notes


def _special_case(name: str) -> str:
    """Return a special case as text: the name of an effect unchanged, or "every law of the width" for a quantity."""
    return name if name in vocabulary() else f"every law of the {name}"


def render_effects(effects: Iterable[Effect]) -> str:
    """Return the page of effects in Markdown, ordered by their numbers."""
    content = {
        "effects": sorted(effects, key=lambda effect: effect.number),
        "stages": list(Stage),
        "library": built_in(),
        "describe": describe_effect,
        "bound": describe_bound,
        "remarks": list_remarks,
    }
    return TEMPLATES.get_template("effects.md").render(**content)


def write_effects_page(path: Path) -> int:
    """Write the page of the vocabulary of this run as Markdown, and return the number of effects."""
    effects = vocabulary()
    # The page is part of the repository, not a result: it gets no sidecar with the run that wrote it.
    path.write_text(render_effects(effects.values()), encoding="utf-8")
    return len(effects)
