"""Extended models for tests: effects by name, and the text of model.yaml."""

import numpy as np

from spotcheck.model import model_writer
from spotcheck.model.effect import AppliedEffect
from spotcheck.model.effects import vocabulary
from spotcheck.model.model_file import ExtendedModel


def applied(name: str, variant: str | None = None, **values: float) -> AppliedEffect:
    """Return an effect of the vocabulary, of its first variant unless the text of one is given."""
    effect = vocabulary()[name]
    member = next(iter(effect.variants)) if variant is None else effect.variant_named(variant)
    assert member is not None
    assert set(values) == {parameter.name for parameter in effect.parameters_of(member)}
    return AppliedEffect(effect, member, tuple(values.get(parameter.name, np.nan) for parameter in effect.parameters))


def model_text(model: ExtendedModel) -> str:
    """Return the content of model.yaml."""
    return model_writer.model_text(model, "set", "named")
