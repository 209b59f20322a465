"""Extended models for tests: effects by name, and the text of model.yaml."""

import json
from collections.abc import Iterator
from dataclasses import asdict

import numpy as np

from spotcheck.model.effect import AppliedEffect
from spotcheck.model.effects import vocabulary
from spotcheck.model.light_shape import LIGHT
from spotcheck.model.model_file import ExtendedModel


def applied(name: str, variant: str | None = None, **values: float) -> AppliedEffect:
    """Return an effect of the vocabulary, of its first variant unless the text of one is given."""
    effect = vocabulary()[name]
    member = next(iter(effect.variants)) if variant is None else effect.variant_named(variant)
    assert member is not None
    assert set(values) == {parameter.name for parameter in effect.parameters_of(member)}
    return AppliedEffect(effect, member, tuple(values.get(parameter.name, np.nan) for parameter in effect.parameters))


def model_text(model: ExtendedModel) -> str:
    """Return the content of model.yaml; numbers have nine digits."""
    return "\n".join(_lines(model)) + "\n"


def _lines(model: ExtendedModel) -> Iterator[str]:
    yield "schema: 1"
    yield f"frame: {{rows_px: {model.rows}, columns_px: {model.columns}}}"
    yield f"exposure: {{longest_s: {model.longest_s:.9g}, reference_s: {model.reference_s:.9g}}}"
    if model.lights:
        yield f"light: {LIGHT}"
    if model.law is not None:
        yield "law:"
        yield from (f"  {key}: {value:.9g}" for key, value in
                    (("p1_px", model.law.p1), ("p2_px", model.law.p2), ("peak_dn", model.law.peak_dn)))  # fmt: skip
    yield "effects:" if model.effects else "effects: []"
    for applied_effect in model.effects:
        yield f"  - name: {applied_effect.effect.name}"
        if applied_effect.variant.value:
            yield f"    form: {applied_effect.variant.value}"
        yield "    parameters:"
        for parameter in applied_effect.effect.parameters_of(applied_effect.variant):
            yield f"      {parameter.name}: {applied_effect.parameters[parameter.name]:.9g}"
    yield "spots:" if model.spots else "spots: []"
    for site, spot in model.spots.items():
        keys = asdict(site) | {"conditions": dict(site.conditions)} | asdict(spot)
        # JSON is YAML as well.
        yield f"  - {json.dumps({key: value for key, value in keys.items() if value not in (None, {})})}"
