"""Free light shape: its fit, the evidence for it, and its explanation by named static shapes.

A free light shape is a spline with some thousand coefficients, in units of each spot's peak and σ, that is added to the
declared shape of the light. A static effect changes the shape in the same way in every frame, so that a free shape can
replace it. "Thinned pixels" are a random subset of rows and columns. The dispersion is the variance of the score
(derivative of ln L) over that of independent readings: above 1 with granular light, whose grains neighbouring pixels
share. Drops of −2 ln L grow in proportion to it by noise alone. The frames of a site share one field of grains.
A `JointFit` has the fitted `model`, its `pixels` and its `deviance`, −2 ln L; `pixels.share` is the fraction that these
pixels are of those of a full fit.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.candidates import list_starts, screen_candidates
from spotcheck.discrepancy.criteria import EXPLAINED_SHARE, EXPLAINED_STEPS, MIN_GAIN, MIN_Z, SHAPE_FLOOR
from spotcheck.discrepancy.evaluation import evaluate, map_batches
from spotcheck.discrepancy.evidence import estimate_covariance
from spotcheck.discrepancy.frames import thin_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.shape_grid import ShapeGrid
from spotcheck.model.effect import AppliedEffect, Effect, EffectScales

# Fit of a shape: Newton decrement of the effects, and most iterations on thinned and on all pixels.
TOLERANCE, THINNED_ITERATIONS, ITERATIONS = 0.1, 18, 8
# Fits that only measure how much a shape, or a static effect instead of it, lowers −2 ln L: pixels, decrement of the
# effects, and most iterations for a shape and for a static effect.
EVIDENCE_PIXELS = 200_000
EVIDENCE_TOLERANCE, EVIDENCE_ITERATIONS, STATIC_ITERATIONS = 0.3, 10, 15
# Distance from the centre [σ] within which the rms of a shape is taken.
RMS_RADIUS = 3.0
# Size [peak] below which a coefficient was not fitted: pixels do not determine it.
ZERO = 1e-12
# Most static effects that are fitted in one step of the explanation.
MOST_STATIC_REFITS = 3


@dataclass(frozen=True)
class ShapeEvidence:
    """Evidence for a free shape instead of the declared one."""

    drop: float  # drop of −2 ln L beyond that by noise, over the dispersion; 0 if the rms is not above `SHAPE_FLOOR`
    rms: float  # rms of the free shape within `RMS_RADIUS`, as a fraction of the peak


@dataclass(frozen=True)
class ShapeExplanation:
    """Static effects that replace a free shape in the verdict."""

    effects: tuple[AppliedEffect, ...]  # static effects; empty if no named shape explains enough
    covariance: np.ndarray  # covariance of their fitted parameters, in the order of `names`
    names: tuple[tuple[str, str], ...]  # (effect, parameter) of each fitted parameter
    rms: float  # rms of the free shape, as a fraction of the peak
    drops: tuple[float, ...] = ()  # drop of −2 ln L by each effect when it was added, scaled to all pixels


def fit_free_shape(declared: JointFit) -> JointFit:
    """Return a fit with a free shape to the pixels of a fit with the declared one; thinned pixels give its start."""
    thinned = fit_jointly(
        declared.model.with_free_shape(ShapeGrid()),
        thin_pixels(declared.pixels),
        tolerance=TOLERANCE,
        iterations=THINNED_ITERATIONS,
    )
    return fit_jointly(thinned.model, declared.pixels, tolerance=TOLERANCE, iterations=ITERATIONS)


def measure_evidence(declared: JointFit, free: JointFit) -> ShapeEvidence:
    """Return the evidence for a free shape from two fits to the same pixels, with the declared and with a free shape.

    By noise alone each fitted coefficient lowers −2 ln L by the dispersion; this is subtracted.
    """
    drop_by_noise = declared.pixels.dispersion * count_coefficients(free.model)
    return evidence_of_drop(declared, declared.deviance - free.deviance - drop_by_noise)


def count_coefficients(model: JointModel) -> int:
    """Return the number of coefficients of the free shape that pixels determine."""
    return int(np.count_nonzero(np.abs(model.coefficients) > ZERO))


def evidence_of_drop(declared: JointFit, drop: float) -> ShapeEvidence:
    """Return the evidence from the drop of −2 ln L by a free shape, without that by noise.

    A deviation s [peak] of the light lowers −2 ln L by Σ (peak s)² I, where I is the Fisher information of a reading on
    the light of its pixel [1/DN²]. The rms of s is the root of the drop over Σ peak² I.
    """

    def sum_information(batch: slice) -> float:
        """Return Σ peak² I over the pixels of some frames within `RMS_RADIUS`."""
        evaluation = evaluate(declared.model, declared.pixels, batch, with_slopes=False)
        conditions = evaluation.conditions
        distance = np.hypot(conditions.pixels.x - conditions.x0, conditions.pixels.y - conditions.y0)
        is_inside = distance < RMS_RADIUS * conditions.sigma_px
        return float(np.sum(conditions.peak_dn**2 * evaluation.light_information * is_inside))

    rms = float(np.sqrt(max(drop, 0.0) / sum(map_batches(sum_information, declared.pixels))))
    return ShapeEvidence(drop / declared.pixels.dispersion if rms > SHAPE_FLOOR else 0.0, rms)


def measure_thinned_evidence(fit: JointFit) -> ShapeEvidence:
    """Return the evidence for a free shape beside the effects of a fit, on thinned pixels and scaled to all.

    The fit has the declared shape. Its sensor and effects are fixed; spots and shape are fitted. A shape is fitted to
    half of the sites and predicts the frames of the others. Noise and granular light raise the drop of −2 ln L in the
    fitted half as much as they lower it in the predicted half. The mean of both drops is therefore the drop that the
    true shape would cause. The smaller result of the two halves counts. With a single site the noise is subtracted as
    in `measure_evidence`.
    """
    site = fit.model.design.site
    is_first = np.isin(site, np.unique(site)[::2])
    if is_first.all():
        thinned, free = fit_thinned_shape(fit)
        evidence = measure_evidence(thinned, free)
    else:
        # Fits to each half: with the declared shape, and with a free one.
        halves = [
            fit_thinned_shape(fit.select(np.flatnonzero(half)), EVIDENCE_PIXELS // 2) for half in (is_first, ~is_first)
        ]
        drops = [measure_cross_drop(*halves[k], others=halves[1 - k][0]) for k in (0, 1)]
        thinned = halves[int(np.argmin(drops))][0]
        evidence = evidence_of_drop(thinned, min(drops))
    # `evidence.drop` is over the dispersion of the thinned pixels.
    ratio = fit.pixels.count / thinned.pixels.count * thinned.pixels.dispersion / fit.pixels.dispersion
    return replace(evidence, drop=ratio * evidence.drop)


def measure_cross_drop(declared: JointFit, free: JointFit, others: JointFit) -> float:
    """Return the mean of the drops of −2 ln L by a free shape on its own pixels and on those of other frames.

    Parameters
    ----------
    declared, free : JointFit
        Fits to the same pixels with the declared shape and with a free one.
    others : JointFit
        Fit to other frames with the declared shape. Their drop is scaled to the number of pixels of `declared`.
    """
    baseline = free.model.forward.baseline
    predicted = replace(others.model, forward=replace(others.model.forward, baseline=baseline))
    fit = fit_jointly(predicted, others.pixels, tolerance=EVIDENCE_TOLERANCE, iterations=EVIDENCE_ITERATIONS)
    predicted_drop = (others.deviance - fit.deviance) * declared.pixels.count / others.pixels.count
    return (declared.deviance - free.deviance + predicted_drop) / 2


def fit_thinned_shape(fit: JointFit, count: int = EVIDENCE_PIXELS) -> tuple[JointFit, JointFit]:
    """Return two fits to about `count` pixels with sensor and effects fixed.

    The first fits the spots alone, the second also a free shape.
    """
    thin = thin_pixels(fit.pixels, count)
    model = replace(fit.model, free=())
    thinned = fit_jointly(model, thin, tolerance=EVIDENCE_TOLERANCE, iterations=EVIDENCE_ITERATIONS)
    model = thinned.model.with_free_shape(ShapeGrid())
    return thinned, fit_jointly(model, thin, tolerance=EVIDENCE_TOLERANCE, iterations=EVIDENCE_ITERATIONS)


def explain_shape(
    final: JointFit, effects: Sequence[Effect], scales: EffectScales, log: Callable[[str], None]
) -> ShapeExplanation:
    """Return the fewest static effects that explain `EXPLAINED_SHARE` of the drop of −2 ln L by a free shape.

    Static effects are added one by one to the declared shape. The search ends without an explanation when their share
    of the drop is too small for their number (`EXPLAINED_STEPS`), or when the strength of one is not significant.

    Parameters
    ----------
    final : JointFit
        Fit with a free shape. Its effects and its shape are fixed; spots and sensor are fitted again to thinned pixels.
    effects : sequence of Effect
        Effects of the vocabulary, of which the static ones that the fit does not contain are tried.
    scales : EffectScales
        Sizes of the dataset, such as the width of the spot, from which effects derive bounds and starting values.
    log : callable
        Receives lines of text on the progress.
    """
    thin = thin_pixels(final.pixels)
    sensor = tuple(parameter for parameter in final.model.free if not parameter.effect)
    fixed = replace(final.model, grid=None, free=sensor)
    free = fit_jointly(fixed, thin, tolerance=EVIDENCE_TOLERANCE, iterations=EVIDENCE_ITERATIONS)
    declared = fit_jointly(without_shape(fixed), thin, tolerance=EVIDENCE_TOLERANCE)
    # The shape was fitted to all pixels: its drop by noise is spread over these, and the thinned ones have their part.
    drop_by_noise = final.pixels.dispersion * count_coefficients(final.model) * thin.count / final.pixels.count
    evidence = evidence_of_drop(declared, declared.deviance - free.deviance - drop_by_noise)
    nothing = ShapeExplanation((), np.zeros((0, 0)), (), evidence.rms)
    if not evidence.drop > 0:
        return nothing
    drops: list[float] = []
    present = final.model.effect_names
    fit, static = declared, [effect for effect in effects if effect.is_static_shape and effect.name not in present]
    for least_share in EXPLAINED_STEPS:
        absent = [effect for effect in static if effect.name not in fit.model.effect_names]
        best = add_static_effect(fit, absent, scales)
        if best is None:
            return nothing
        drops.append((fit.deviance - best.deviance) * final.pixels.share / thin.share)
        fit = best
        share = (declared.deviance - fit.deviance) / thin.dispersion / evidence.drop
        log(f"  static {', '.join(fit.model.effect_names)}: {100 * share:.1f} % of the free shape")
        if share > EXPLAINED_SHARE:
            fit = fit_jointly(fit.model, thin, tolerance=EVIDENCE_TOLERANCE)
            return summarize_static_effects(fit, static, final.pixels.share, replace(nothing, drops=tuple(drops)))
        if share < least_share:
            return nothing
    return nothing


def summarize_static_effects(
    fit: JointFit, static: Sequence[Effect], full_share: float, nothing: ShapeExplanation
) -> ShapeExplanation:
    """Return the explanation by the static effects of a fit to thinned pixels; none if one is not significant.

    `full_share` is the share of the pixels to which errors are scaled. `nothing` is the explanation without effects.
    """
    names = {effect.name for effect in static}
    index = [k for k, parameter in enumerate(fit.model.free) if parameter.effect in names]
    effects = tuple(applied for applied in fit.model.forward.effects if applied.effect.name in names)
    covariance = estimate_covariance(fit)[np.ix_(index, index)] * fit.pixels.share / full_share
    parameters = tuple((fit.model.free[k].effect, fit.model.free[k].name) for k in index)
    errors = dict(zip(parameters, np.sqrt(np.diag(covariance)), strict=True))
    if not all(is_significant(applied, errors) for applied in effects):
        return replace(nothing, drops=())
    return replace(nothing, effects=effects, covariance=covariance, names=parameters)


def is_significant(applied: AppliedEffect, errors: Mapping[tuple[str, str], float]) -> bool:
    """Return whether the strength of an effect differs from no effect by at least `MIN_Z` standard errors.

    `errors` has the standard error of each fitted parameter by (effect, parameter).
    """
    stderr = errors.get((applied.effect.name, applied.effect.parameters[0].name), np.nan)
    return bool(abs(applied.values[0] - applied.effect.vanishes_at) >= MIN_Z * stderr)


def add_static_effect(fit: JointFit, effects: Sequence[Effect], scales: EffectScales) -> JointFit | None:
    """Return the fit with the static effect that lowers −2 ln L most, among the leading candidates of score tests.

    `effects` are the static effects that `fit` does not contain. None if none lowers −2 ln L by `MIN_GAIN` times the
    dispersion. An effect with a parameter at its bound does not count: it stands for something else, as a halo much
    larger than the crop stands for a pedestal.
    """
    refits, least_drop = [], MIN_GAIN * fit.pixels.dispersion
    for candidate in screen_candidates(fit, list_starts(effects, scales))[:MOST_STATIC_REFITS]:
        if candidate.score > least_drop:
            model = fit.model.with_effect(candidate.start, scales)
            refit = fit_jointly(model, fit.pixels, tolerance=EVIDENCE_TOLERANCE, iterations=STATIC_ITERATIONS)
            if not refit.model.is_at_bound(candidate.start.effect.name):
                refits.append(refit)
    best = min(refits, key=lambda refit: refit.deviance, default=None)
    return best if best is not None and best.deviance < fit.deviance - least_drop else None


def without_shape(model: JointModel) -> JointModel:
    """Return the model with the declared shape alone."""
    return replace(model, grid=None).with_learned(None)
