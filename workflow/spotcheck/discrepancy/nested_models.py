"""Chain of nested models from the declared to the extended one, for the validation on held-out frames.

Each model adds one thing: a learned light shape, an effect of the mean image, a law, or an effect that scatters. All
have laws of their own, fitted to their own brightness and width. What an effect closes of the gap is the difference
between its model and the one before it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from spotcheck.discrepancy.criteria import MIN_GAIN
from spotcheck.discrepancy.frames import FrameParameters, FrameSet, thin_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.laws import LawFit, LawSearch, NamedLaw
from spotcheck.discrepancy.named_scatter import NamedScatter
from spotcheck.discrepancy.residuals import ResidualImages
from spotcheck.discrepancy.validation import (
    NestedModel,
    Prediction,
    estimate_gains,
    has_field,
    is_field,
    predict_frames,
)
from spotcheck.model.effect import AppliedEffect, EffectScales, RandomStep, Scope, Step
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light import ExposureLaw
from spotcheck.model.stage import Stage

# Pixels and effort of the fits of models between the declared and the final one.
PIXELS, TOLERANCE, ITERATIONS = 200_000, 0.3, 20
# Name of the model that adds a learned shape of the light.
LIGHT_SHAPE = "light shape"
# Standard deviations of the gap of the declared model beyond noise without which no share of it is reported.
SIGNIFICANT_Z = 4.0


@dataclass(frozen=True)
class FittedParts:
    """Fits that the chain is made of."""

    declared: JointFit  # without effects
    with_shape: JointFit | None  # with the learned shape and no other effect; None beside the declared shape
    final: JointFit  # with all effects of the mean image
    search: LawSearch  # laws of the final fit's spots
    laws: tuple[NamedLaw, ...]  # named laws
    scatter: tuple[NamedScatter, ...]  # named effects that scatter
    images: ResidualImages  # residuals of the declared light's fit, for gains of pixels
    scales: EffectScales


def build_chain(parts: FittedParts) -> list[NestedModel]:
    """Return the models in their order."""
    law = _law_of(parts.declared, parts).law
    chain = [NestedModel("", _clean(parts.declared.model, parts, law))]
    names = list(parts.final.model.effect_names)
    if parts.with_shape is not None:
        law = _law_of(parts.with_shape, parts).law
        model = parts.with_shape.model.with_fine_structure(parts.final.model)
        chain.append(NestedModel(LIGHT_SHAPE, _clean(model, parts, law)))
    for count in range(1, len(names)):
        fit = _fit_without(parts.final, names[count:])
        chain.append(NestedModel(names[count - 1], _clean(fit.model, parts, _law_of(fit, parts).law)))
    if names:
        last = _clean(parts.final.model, parts, parts.search.fit([]).law)
        chain.append(NestedModel(names[-1], last))
    by_gain = sorted(parts.laws, key=lambda law: -law.gain)
    for count in range(1, len(by_gain) + 1):
        laws = [law.applied.effect for law in by_gain[:count]]
        fitted = parts.search.fit(laws)
        forward = _clean(parts.final.model, parts, fitted.law, fitted.effects)
        chain.append(NestedModel(laws[-1].name, forward))
    return _add_scatter(chain, parts)


def _law_of(fit: JointFit, parts: FittedParts) -> LawFit:
    """Return the law without effects of the spots of a fit, with the covariance of the final one's."""
    return parts.search.with_numbers(replace(parts.search.numbers, spots=fit.model.spots)).fit([])


def _fit_without(final: JointFit, names: Sequence[str]) -> JointFit:
    """Return the final fit without some effects, on thinned pixels; shape, sensor and other effects are kept.

    An effect that was fitted without another one would take on part of its work.
    """
    model = replace(final.model, grid=None, free=())
    for name in names:
        model = model.without_effect(name)
    return fit_jointly(model, thin_pixels(final.pixels, PIXELS), tolerance=TOLERANCE, iterations=ITERATIONS)


def _clean(
    model: JointModel, parts: FittedParts, law: ExposureLaw, effects: tuple[AppliedEffect, ...] = ()
) -> ForwardModel:
    """Return a forward model with a law and the stated sensor."""
    baseline = replace(parts.search.forward.baseline, learned=model.forward.baseline.learned)
    return ForwardModel(baseline, parts.search.forward.sensor, law, (*model.forward.effects, *effects))


def _add_scatter(chain: list[NestedModel], parts: FittedParts) -> list[NestedModel]:
    """Return the chain with a model for each effect that scatters.

    The variation of sites is part of every model, since without it no new site can be predicted.
    """
    by_site = [named for named in parts.scatter if _scope_of(named) is Scope.SITE and not is_field(named.applied)]
    site_sd = [0.0, 0.0]
    for named in by_site:
        for step in named.applied.effect.variants[named.applied.variant]:
            if isinstance(step, RandomStep):
                place = (Stage.BRIGHTNESS, Stage.WIDTH).index(step.stage)
                site_sd[place] = named.applied.parameters[named.parameter_of(step)]
    chain = [replace(nested, scatter=replace(nested.scatter, site_sd=(site_sd[0], site_sd[1]))) for nested in chain]
    in_law = has_field(parts.final.model)
    for named in parts.scatter:
        if named in by_site or named.applied.effect.name in parts.final.model.effect_names:
            continue
        last = chain[-1]
        nested = replace(last, added=named.applied.effect.name)
        for step in named.applied.effect.variants[named.applied.variant]:
            nested = _with_step(nested, named, step, parts, in_law)
        chain.append(nested)
    return chain


def _scope_of(named: NamedScatter) -> Scope | None:
    """Return the scope of what an effect draws; None for a wider noise of readings."""
    steps = named.applied.effect.variants[named.applied.variant]
    return next((step.scope for step in steps if isinstance(step, RandomStep)), None)


def _with_step(
    nested: NestedModel, named: NamedScatter, step: Step | RandomStep, parts: FittedParts, in_law: bool
) -> NestedModel:
    """Return the model with the scatter of one step of an effect."""
    scatter, forward = nested.scatter, nested.forward
    if not isinstance(step, RandomStep):
        return replace(nested, forward=replace(forward, effects=(*forward.effects, named.applied)))
    value = named.applied.parameters[named.parameter_of(step)]
    if step.stage is Stage.SPECKLE_FIELD and not in_law:
        scatter = replace(scatter, field_variance=value**2, grain_px=named.grain_px)
    elif step.stage is Stage.PIXEL_GAIN and value > 0:
        scatter = replace(scatter, gains=estimate_gains(parts.images, value**2))
    elif step.stage is Stage.ROW_NOISE_AND_HOT_PIXELS:
        scatter = replace(scatter, row_variance=value**2)
    elif step.stage is Stage.BRIGHTNESS:
        scatter = replace(scatter, brightness_sd=value)
    elif step.stage is Stage.COORDINATES:
        scatter = replace(scatter, centre_sd=value)
    return replace(nested, scatter=scatter)


@dataclass(frozen=True)
class ValidatedChain:
    """Predictions of held-out frames by each model of a chain."""

    chain: tuple[NestedModel, ...]
    predictions: tuple[Prediction, ...]

    @property
    def is_significant(self) -> bool:
        """Whether the declared model has a gap of which shares can be reported."""
        first = self.predictions[0]
        return (first.gap - 1) > SIGNIFICANT_Z * first.deviation

    def share_of(self, effect: str) -> float:
        """Return the part of the declared model's gap that an effect closes; NaN if unknown."""
        for before, after, nested in zip(self.predictions, self.predictions[1:], self.chain[1:], strict=False):
            if nested.added == effect and self.is_significant:
                return (before.left_open - after.left_open) / (self.predictions[0].gap - 1)
        return float("nan")

    @property
    def closed(self) -> float:
        """Part of the declared model's gap that all effects close; NaN if there was none."""
        if not self.is_significant:
            return float("nan")
        return 1 - max(self.predictions[-1].left_open, 0.0) / (self.predictions[0].gap - 1)

    def refuted(self) -> tuple[str, ...]:
        """Return the effects with which held-out frames are predicted worse, whatever is added behind them.

        Effects may need one another: a clip without the law behind it can predict worse than no clip.
        """
        scores = [prediction.score for prediction in self.predictions]
        return tuple(
            nested.added for k, nested in enumerate(self.chain[1:], 1) if min(scores[k:]) - scores[k - 1] > MIN_GAIN
        )


def validate_chain(chain: Sequence[NestedModel], frames: FrameSet, start: FrameParameters) -> ValidatedChain:
    """Predict held-out frames by each model of a chain, from centres that `start` gives."""
    predictions = tuple(predict_frames(nested, frames, start) for nested in chain)
    return ValidatedChain(tuple(chain), predictions)
