"""Free light shape: its fit, the evidence for it, its fine structure, and its explanation by named static shapes.

A free light shape is a spline with some thousand coefficients, in units of each spot's peak and σ, that is added to the
declared shape of the light. A static effect changes the shape in the same way in every frame, so that a free shape can
replace it. "Thinned pixels" are a random subset of rows and columns. The dispersion is the variance of the score
(derivative of ln L) over that of independent readings: above 1 with granular light, whose grains neighbouring pixels
share. Drops of −2 ln L grow in proportion to it by noise alone. The frames of a site share one field of grains.
A `JointFit` has the fitted `model`, its `pixels` and its `deviance`, −2 ln L; `pixels.share` is the fraction that these
pixels are of those of a full fit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spotcheck.discrepancy.candidates import list_starts, screen_candidates
from spotcheck.discrepancy.criteria import EXPLAINED_SHARE, EXPLAINED_STEPS, MIN_GAIN, MIN_Z, SHAPE_FLOOR
from spotcheck.discrepancy.evaluation import evaluate, map_batches, sum_batches
from spotcheck.discrepancy.evidence import distance_from_nothing, estimate_covariance
from spotcheck.discrepancy.frames import thin_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.shape_grid import STEP, ShapeGrid
from spotcheck.discrepancy.shape_sums import ShapeSums
from spotcheck.model.effect import AppliedEffect, Effect, EffectScales
from spotcheck.model.light_shape import LightShape

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
# Distance of the fine nodes, and bounds of the rings about the centre in which the fine structure has one variance [σ].
FINE_STEP, RING_BOUNDS = STEP / 2, (0.0, 0.75, 1.5, 2.25, 3.0, 4.0)
# Number of estimates of it. Splines smooth the values at the nodes, so that each estimate leaves a residual.
PASSES = 3
# Smallest denominator of a ratio of sums that may be 0.
TINY = 1e-300
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

    effects: tuple[AppliedEffect, ...]  # the static effects
    errors: Mapping[tuple[str, str], float]  # standard errors of their fitted parameters, by (effect, parameter)
    drops: tuple[float, ...]  # drop of −2 ln L by each effect when it was added, scaled to all pixels


def fit_free_shape(declared: JointFit) -> JointFit:
    """Return a fit with a free shape to the pixels of a fit with the declared one; thinned pixels give its start."""
    start, thin = declared.model.with_free_shape(ShapeGrid()), thin_pixels(declared.pixels)
    thinned = fit_jointly(start, thin, tolerance=TOLERANCE, iterations=THINNED_ITERATIONS)
    return fit_jointly(thinned.model, declared.pixels, tolerance=TOLERANCE, iterations=ITERATIONS)


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
    true shape would cause. The smaller result of the two halves counts. With a single site the drop by noise is
    subtracted.
    """
    site = fit.model.design.site
    is_first = np.isin(site, np.unique(site)[::2])
    if is_first.all():
        thinned, free = fit_thinned_shape(fit)
        # By noise alone each fitted coefficient lowers −2 ln L by the dispersion.
        drop_by_noise = thinned.pixels.dispersion * count_coefficients(free.model)
        evidence = evidence_of_drop(thinned, thinned.deviance - free.deviance - drop_by_noise)
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


# Fine structure


def add_fine_structure(fit: JointFit) -> JointFit:
    """Add the structure between the nodes of a fit's free shape, and refit; the fit is unchanged if sites share none.

    If the structure is left out of the model, it looks like noise that increases with the light, and a curved response
    of the sensor would be fitted to it.

    With a single site, structure of the light cannot be distinguished from noise.
    """
    if fit.model.design.sites == 1:
        return fit
    nodes = 2 * int(RING_BOUNDS[-1] / FINE_STEP) + 1
    for _ in range(PASSES):
        learned, structure = fit.model.forward.baseline.learned, estimate_structure(fit, nodes)
        assert learned is not None
        if not structure.any():
            break
        total = structure if learned.finer is None else learned.finer.coefficients + structure
        model = fit.model.with_learned(replace(learned, finer=LightShape(FINE_STEP, total)))
        fit = fit_jointly(model, fit.pixels, tolerance=TOLERANCE, iterations=ITERATIONS)
    return fit


def estimate_structure(fit: JointFit, nodes: int) -> np.ndarray:
    """Return the light that residuals show about each fine node, in parts of the peak [row, column].

    There are `nodes` rows and columns. The light about a node has the score U and the information I, so that U/I is its
    estimate. It is shrunk by the factor T/(T + 1/I). T is the variance of the structure in a ring about the centre: the
    mean product of the estimates from two halves of the sites, which share no noise. The structure is 0 beyond the
    rings.
    """
    site = fit.model.design.site
    half_of_frame = np.isin(site, np.unique(site)[::2]).astype(int)
    middle = (nodes - 1) // 2

    def sum_batch(batch: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return score and information of each node of each half [half × row × column] of a batch of frames."""
        evaluation = evaluate(fit.model, fit.pixels, batch, with_slopes=False)
        # Place of each pixel in the shape [σ], and derivative of its light by the shape there [frame, pixel].
        u, v, factor = ShapeSums(fit.model, evaluation).strongest
        column, row = (np.rint(place / FINE_STEP).astype(int) + middle for place in (u, v))
        is_inside = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < nodes)
        node = ((half_of_frame[batch][:, None] * nodes + row) * nodes + column)[is_inside]
        score, information = (
            np.bincount(node, (values.reshape(factor.shape) * weight)[is_inside], 2 * nodes**2)
            for values, weight in ((evaluation.light_score, factor), (evaluation.light_information, factor**2))
        )
        return score, information

    score, information = (sums.reshape(2, nodes, nodes) for sums in sum_batches(sum_batch, fit.pixels))
    estimates = np.divide(score, information, out=np.zeros_like(score), where=information > 0)
    total = information.sum(axis=0)
    # Weight of the product of both estimates: proportional to the harmonic mean of their information.
    weight = np.divide(information[0] * information[1], total, out=np.zeros_like(total), where=total > 0)
    from_middle = np.arange(nodes) - middle
    ring = np.digitize(FINE_STEP * np.hypot(from_middle[:, None], from_middle[None, :]), RING_BOUNDS) - 1
    rings = len(RING_BOUNDS) - 1
    products, weights = (np.bincount(ring.ravel(), values.ravel(), rings + 1)[:rings]
                         for values in (weight * estimates[0] * estimates[1], weight))  # fmt: skip
    variance = np.append(np.maximum(products / np.maximum(weights, TINY), 0.0), 0.0)[ring]
    return np.divide(variance * score.sum(axis=0), variance * total + 1)


# Explanation by static effects


def explain_shape(final: JointFit, effects: Sequence[Effect], scales: EffectScales) -> ShapeExplanation | None:
    """Return the fewest static effects that explain `EXPLAINED_SHARE` of the drop of −2 ln L by a free shape.

    Static effects are added one by one to the declared shape. The search ends without an explanation (None) when their
    share of the drop is too small for their number (`EXPLAINED_STEPS`), or when the strength of one is not significant.

    Parameters
    ----------
    final : JointFit
        Fit with a free shape. Its effects and its shape are fixed; spots and sensor are fitted again to thinned pixels.
    effects : sequence of Effect
        Effects of the vocabulary, of which the static ones that the fit does not contain are tried.
    scales : EffectScales
        Sizes of the dataset, such as the width of the spot, from which effects derive bounds and starting values.
    """
    thin = thin_pixels(final.pixels)
    sensor = tuple(parameter for parameter in final.model.free if not parameter.effect)
    fixed = replace(final.model, grid=None, free=sensor)
    free = fit_jointly(fixed, thin, tolerance=EVIDENCE_TOLERANCE, iterations=EVIDENCE_ITERATIONS)
    declared = fit_jointly(fixed.with_learned(None), thin, tolerance=EVIDENCE_TOLERANCE)
    # The shape was fitted to all pixels: its drop by noise is spread over these, and the thinned ones have their part.
    drop_by_noise = final.pixels.dispersion * count_coefficients(final.model) * thin.count / final.pixels.count
    evidence = evidence_of_drop(declared, declared.deviance - free.deviance - drop_by_noise)
    if not evidence.drop > 0:
        return None
    drops: list[float] = []
    present = final.model.effect_names
    fit, static = declared, [effect for effect in effects if effect.is_static_shape and effect.name not in present]
    for least_share in EXPLAINED_STEPS:
        absent = [effect for effect in static if effect.name not in fit.model.effect_names]
        best = add_static_effect(fit, absent, scales)
        if best is None:
            return None
        drops.append((fit.deviance - best.deviance) * final.pixels.share / thin.share)
        fit = best
        share = (declared.deviance - fit.deviance) / thin.dispersion / evidence.drop
        if share > EXPLAINED_SHARE:
            fit = fit_jointly(fit.model, thin, tolerance=EVIDENCE_TOLERANCE)
            return summarize_static_effects(fit, static, final.pixels.share, tuple(drops))
        if share < least_share:
            return None
    return None


def summarize_static_effects(
    fit: JointFit, static: Sequence[Effect], full_share: float, drops: tuple[float, ...]
) -> ShapeExplanation | None:
    """Return the explanation by the static effects of a fit to thinned pixels.

    None if the strength of one differs from no effect by less than `MIN_Z` standard errors. Errors are scaled to
    `full_share`, the share of all pixels. `drops` are those of −2 ln L by the effects.
    """
    names = {effect.name for effect in static}
    effects = tuple(applied for applied in fit.model.forward.effects if applied.effect.name in names)
    variances = np.diag(estimate_covariance(fit)) * fit.pixels.share / full_share
    errors = {
        (parameter.effect, parameter.name): float(np.sqrt(variance))
        for parameter, variance in zip(fit.model.free, variances, strict=True)
        if parameter.effect in names
    }
    for applied in effects:
        stderr = errors.get((applied.effect.name, applied.effect.parameters[0].name), np.nan)
        if not distance_from_nothing(applied) >= MIN_Z * stderr:
            return None
    return ShapeExplanation(effects, errors, drops)


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
