"""Chain of nested models from the declared to the extended one, for the validation on held-out frames.

Each model adds one thing to the one before it: a learned light shape, an effect of the mean image, a law of brightness
or width across frames, or a random effect. Every model has a law of the exposure, which is fitted to the brightness and
width of the spots in its own fit of the pixels. The gap is the mean squared residual on held-out frames over that of
noise, so that 1 is noise alone. An effect closes the difference between the gaps of its model and the one before it. A
`Prediction` has the `gap` of a model, its significant excess over noise (`left_open`), and −2 ln p of the frames
(`score`).
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
from spotcheck.model.effect import AppliedEffect, RandomStep, Scope, Step
from spotcheck.model.forward import ForwardModel
from spotcheck.model.light import ExposureLaw
from spotcheck.model.stage import Stage

# Fits of models between the declared and the final one: pixels, Newton decrement, and most iterations.
PIXELS, TOLERANCE, ITERATIONS = 200_000, 0.3, 20
# Name of the model that adds a learned shape of the light.
LIGHT_SHAPE = "light shape"
# Least gap of the declared model beyond noise, in standard deviations, of which shares are reported.
SIGNIFICANT_Z = 4.0


@dataclass(frozen=True)
class FittedParts:
    """Fits from which the chain is built."""

    declared: JointFit  # fit without effects
    with_shape: JointFit | None  # fit with the learned shape and no effect; None if the declared shape is kept
    final: JointFit  # fit with all effects of the mean image
    search: LawSearch  # search for laws in the spots of the final fit
    laws: tuple[NamedLaw, ...]  # named laws
    scatter: tuple[NamedScatter, ...]  # named random effects
    images: ResidualImages  # residuals of the final fit, from which gains of pixels are estimated


def build_chain(parts: FittedParts) -> list[NestedModel]:
    """Return the models of the chain.

    They are the declared model, the light shape, effects of the mean image as they were found, laws from the largest
    gain on, and random effects.
    """
    chain = [NestedModel("", _with_law(parts.declared.model, parts, _fit_law(parts.declared, parts).law))]
    names = list(parts.final.model.effect_names)
    if parts.with_shape is not None:
        model = parts.with_shape.model.with_fine_structure(parts.final.model)
        chain.append(NestedModel(LIGHT_SHAPE, _with_law(model, parts, _fit_law(parts.with_shape, parts).law)))
    for count in range(1, len(names)):
        fit = _fit_without(parts.final, names[count:])
        chain.append(NestedModel(names[count - 1], _with_law(fit.model, parts, _fit_law(fit, parts).law)))
    if names:
        chain.append(NestedModel(names[-1], _with_law(parts.final.model, parts, parts.search.fit([]).law)))
    by_gain = [law.applied.effect for law in sorted(parts.laws, key=lambda law: -law.gain)]
    for count, added in enumerate(by_gain, 1):
        fitted = parts.search.fit(by_gain[:count])
        chain.append(NestedModel(added.name, _with_law(parts.final.model, parts, fitted.law, fitted.effects)))
    return _add_scatter(chain, parts)


def _fit_law(fit: JointFit, parts: FittedParts) -> LawFit:
    """Return the law of the exposure, without effects, fitted to the spots of a fit.

    The covariance of the spots is taken from the final fit, to which `parts.search` belongs.
    """
    return parts.search.with_measurements(replace(parts.search.measurements, spots=fit.model.spots)).fit([])


def _fit_without(final: JointFit, names: Sequence[str]) -> JointFit:
    """Return a fit of the spots to thinned pixels with some effects of the final fit removed.

    Shape, sensor and the other effects are fixed. If they were fitted again, they would take over part of what the
    removed effects explain.
    """
    model = replace(final.model, grid=None, free=())
    for name in names:
        model = model.without_effect(name)
    return fit_jointly(model, thin_pixels(final.pixels, PIXELS), tolerance=TOLERANCE, iterations=ITERATIONS)


def _with_law(
    model: JointModel, parts: FittedParts, law: ExposureLaw, laws: tuple[AppliedEffect, ...] = ()
) -> ForwardModel:
    """Return the forward model of a fit with a law of the exposure, further laws, and the sensor of the law search.

    The light shape and the effects of the mean image are those of `model`.
    """
    baseline = replace(parts.search.forward.baseline, learned=model.forward.baseline.learned)
    return ForwardModel(baseline, parts.search.forward.sensor, law, (*model.forward.effects, *laws))


def _add_scatter(chain: list[NestedModel], parts: FittedParts) -> list[NestedModel]:
    """Return the chain with a further model for each named random effect.

    The scatter of brightness and width between sites is part of every model instead, since without it no new site can
    be predicted.
    """
    of_sites = [named for named in parts.scatter if _scope_of(named) is Scope.SITE and not is_field(named.applied)]
    site_sd = {Stage.BRIGHTNESS: 0.0, Stage.WIDTH: 0.0}
    for named in of_sites:
        for step in _steps_of(named):
            if isinstance(step, RandomStep):
                site_sd[step.stage] = named.applied.parameters[named.parameter_of(step)]
    sds = (site_sd[Stage.BRIGHTNESS], site_sd[Stage.WIDTH])
    chain = [replace(nested, scatter=replace(nested.scatter, site_sd=sds)) for nested in chain]
    for named in parts.scatter:
        name = named.applied.effect.name
        if named not in of_sites and name not in parts.final.model.effect_names:
            nested = replace(chain[-1], added=name)
            for step in _steps_of(named):
                nested = _with_step(nested, named, step, parts)
            chain.append(nested)
    return chain


def _steps_of(named: NamedScatter) -> tuple[Step | RandomStep, ...]:
    """Return the steps of the variant of a random effect."""
    return named.applied.effect.variants[named.applied.variant]


def _scope_of(named: NamedScatter) -> Scope | None:
    """Return the scope of what an effect draws; None if it draws nothing, as one that increases the read noise."""
    return next((step.scope for step in _steps_of(named) if isinstance(step, RandomStep)), None)


def _with_step(nested: NestedModel, named: NamedScatter, step: Step | RandomStep, parts: FittedParts) -> NestedModel:
    """Return the model with the scatter of one step of an effect.

    Steps that `FrameScatter` does not describe leave the model as it is.
    """
    scatter, forward = nested.scatter, nested.forward
    if not isinstance(step, RandomStep):
        return replace(nested, forward=replace(forward, effects=(*forward.effects, named.applied)))
    value = named.applied.parameters[named.parameter_of(step)]
    # Granular light among the effects of the mean image is in the distribution of a reading already.
    if step.stage is Stage.SPECKLE_FIELD and not has_field(parts.final.model):
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

    chain: tuple[NestedModel, ...]  # models, from the declared to the extended one
    predictions: tuple[Prediction, ...]  # prediction of each model

    @property
    def is_significant(self) -> bool:
        """Whether the declared model has a gap of which shares can be reported."""
        first = self.predictions[0]
        return (first.gap - 1) > SIGNIFICANT_Z * first.deviation

    def share_of(self, effect: str) -> float:
        """Return the share of the declared model's gap that an effect closes.

        It is negative for an effect that widens the gap, and NaN without a significant gap or without such an effect.
        """
        for before, after, nested in zip(self.predictions, self.predictions[1:], self.chain[1:], strict=False):
            if nested.added == effect and self.is_significant:
                return (before.left_open - after.left_open) / (self.predictions[0].gap - 1)
        return float("nan")

    @property
    def closed(self) -> float:
        """Share of the declared model's gap that all effects together close; NaN without a significant gap."""
        if not self.is_significant:
            return float("nan")
        return 1 - max(self.predictions[-1].left_open, 0.0) / (self.predictions[0].gap - 1)

    def refuted(self) -> tuple[str, ...]:
        """Return the names of effects that increase −2 ln p of held-out frames by more than `MIN_GAIN`.

        The best of all models that contain the effect counts, since effects may need one another: a clip without a law
        that follows it in the chain can predict worse than no clip.
        """
        scores = [prediction.score for prediction in self.predictions]
        return tuple(
            nested.added for k, nested in enumerate(self.chain[1:], 1) if min(scores[k:]) - scores[k - 1] > MIN_GAIN
        )


def validate_chain(chain: Sequence[NestedModel], frames: FrameSet, start: FrameParameters) -> ValidatedChain:
    """Predict held-out frames by each model of a chain.

    Parameters
    ----------
    chain : sequence of NestedModel
        Models, from the declared to the extended one.
    frames : FrameSet
        Held-out frames.
    start : FrameParameters
        Centres of their spots, from which fits start; peak and width are not used.
    """
    predictions = tuple(predict_frames(nested, frames, start) for nested in chain)
    return ValidatedChain(tuple(chain), predictions)
