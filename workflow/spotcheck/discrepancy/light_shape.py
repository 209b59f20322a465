"""Free light shape: its fit, the evidence for it, and its explanation by named static shapes."""

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

# Effort of the fits of a shape: decrement of the effects, and most iterations on thinned and on all pixels.
TOLERANCE, THINNED_ITERATIONS, ITERATIONS = 0.1, 18, 8
# The same of fits that only measure how much a shape, or a static effect that may stand for it, takes.
EVIDENCE_PIXELS = 200_000
EVIDENCE_TOLERANCE, EVIDENCE_ITERATIONS, STATIC_ITERATIONS = 0.3, 10, 15
# Distance from the centre [σ] within which the rms of a shape is taken.
RMS_RADIUS = 3.0
# Coefficients below this size [peak] are not fitted ones.
ZERO = 1e-12
# Static effects that are fitted in one step of the explanation.
MOST_STATIC_REFITS = 3


@dataclass(frozen=True)
class ShapeEvidence:
    """What speaks for a free shape instead of the declared one."""

    drop: float  # drop of −2 ln L beyond what noise gives; 0 if the rms is below `SHAPE_FLOOR`
    rms: float  # rms of the shape within `RMS_RADIUS` [peak]


@dataclass(frozen=True)
class ShapeExplanation:
    """What stands for a free shape in the verdict."""

    effects: tuple[AppliedEffect, ...]  # static effects; empty if no named shape takes enough
    covariance: np.ndarray  # of their fitted parameters, in the order of `names`
    names: tuple[tuple[str, str], ...]  # (effect, parameter)
    rms: float  # rms of the shape [peak]
    drops: tuple[float, ...] = ()  # drop of −2 ln L by each effect


def fit_free_shape(declared: JointFit) -> JointFit:
    """Fit a free shape to the pixels of a fit with the declared one, first to thinned pixels."""
    thinned = fit_jointly(
        declared.model.with_free_shape(ShapeGrid()),
        thin_pixels(declared.pixels),
        tolerance=TOLERANCE,
        iterations=THINNED_ITERATIONS,
    )
    return fit_jointly(thinned.model, declared.pixels, tolerance=TOLERANCE, iterations=ITERATIONS)


def measure_evidence(declared: JointFit, free: JointFit) -> ShapeEvidence:
    """Return the evidence for a free shape from two fits of the same pixels.

    Each coefficient lowers −2 ln L by 1 through noise alone. The rms follows from the rest: a deviation s of the light
    lowers it by Σ (peak s)² information.
    """
    by_noise = declared.pixels.dispersion * count_coefficients(free.model)
    return evidence_of_drop(declared, declared.deviance - free.deviance - by_noise)


def count_coefficients(model: JointModel) -> int:
    """Return the number of coefficients of the shape that pixels determine."""
    return int(np.count_nonzero(np.abs(model.coefficients) > ZERO))


def evidence_of_drop(declared: JointFit, drop: float) -> ShapeEvidence:
    """Return the evidence by a drop of −2 ln L beyond what noise gives."""

    def of_batch(part: slice) -> float:
        at = evaluate(declared.model, declared.pixels, part, with_slopes=False)
        conditions = at.conditions
        distance = np.hypot(conditions.pixels.x - conditions.x0, conditions.pixels.y - conditions.y0)
        is_inside = distance < RMS_RADIUS * conditions.sigma_px
        return float(np.sum(conditions.peak_dn**2 * at.light_information * is_inside))

    rms = float(np.sqrt(max(drop, 0.0) / sum(map_batches(of_batch, declared.pixels))))
    return ShapeEvidence(drop / declared.pixels.dispersion if rms > SHAPE_FLOOR else 0.0, rms)


def measure_thinned_evidence(fit: JointFit) -> ShapeEvidence:
    """Return the evidence for a free shape beside the effects of a fit, on thinned pixels and scaled to all.

    Parameters of sensor and effects are kept: spots and shape alone move. A shape is fitted to half of the sites and
    predicts the others. What noise and granular light add to the drop of the former, they take from that of the latter,
    so that the mean of both is that of the shape alone. Of the two halves the one with less evidence counts. With a
    single site the noise is that of `measure_evidence`.
    """
    site = fit.model.design.site
    is_first = np.isin(site, np.unique(site)[::2])
    if is_first.all():
        thinned, free = fit_thinned_shape(fit)
        evidence = measure_evidence(thinned, free)
    else:
        halves = [
            fit_thinned_shape(fit.select(np.flatnonzero(half)), EVIDENCE_PIXELS // 2) for half in (is_first, ~is_first)
        ]
        drops = [measure_predicted_drop(*half, other[0]) for half, other in (halves, halves[::-1])]
        thinned = halves[int(np.argmin(drops))][0]
        evidence = evidence_of_drop(thinned, min(drops))
    ratio = fit.pixels.count / thinned.pixels.count * thinned.pixels.dispersion / fit.pixels.dispersion
    return replace(evidence, drop=ratio * evidence.drop)


def measure_predicted_drop(declared: JointFit, free: JointFit, others: JointFit) -> float:
    """Return the mean of two drops of −2 ln L by a free shape: where it was fitted, and where it predicts frames."""
    shape = free.model.forward.baseline
    predicted = replace(others.model, forward=replace(others.model.forward, baseline=shape))
    fit = fit_jointly(predicted, others.pixels, tolerance=EVIDENCE_TOLERANCE, iterations=EVIDENCE_ITERATIONS)
    outside = (others.deviance - fit.deviance) * declared.pixels.count / others.pixels.count
    return (declared.deviance - free.deviance + outside) / 2


def fit_thinned_shape(fit: JointFit, count: int = EVIDENCE_PIXELS) -> tuple[JointFit, JointFit]:
    """Return fits of the spots alone and of spots and a free shape to about `count` pixels, beside the effects of a
    fit."""
    thin = thin_pixels(fit.pixels, count)
    model = replace(fit.model, free=())
    thinned = fit_jointly(model, thin, tolerance=EVIDENCE_TOLERANCE, iterations=EVIDENCE_ITERATIONS)
    model = thinned.model.with_free_shape(ShapeGrid())
    return thinned, fit_jointly(model, thin, tolerance=EVIDENCE_TOLERANCE, iterations=EVIDENCE_ITERATIONS)


def explain_shape(
    final: JointFit, effects: Sequence[Effect], scales: EffectScales, log: Callable[[str], None]
) -> ShapeExplanation:
    """Return the fewest static effects that take `EXPLAINED_SHARE` of what a free shape takes.

    The effects and the shape of the final model are fixed. Frame parameters and the sensor are fitted anew to thinned
    pixels.
    """
    thin = thin_pixels(final.pixels)
    sensor = tuple(parameter for parameter in final.model.free if not parameter.effect)
    fixed = replace(final.model, grid=None, free=sensor)
    free = fit_jointly(fixed, thin, tolerance=EVIDENCE_TOLERANCE, iterations=EVIDENCE_ITERATIONS)
    declared = fit_jointly(without_shape(fixed), thin, tolerance=EVIDENCE_TOLERANCE)
    # The shape was fitted to all pixels: the thinned ones have their part of what noise gave.
    by_noise = final.pixels.dispersion * count_coefficients(final.model) * thin.count / final.pixels.count
    evidence = evidence_of_drop(declared, declared.deviance - free.deviance - by_noise)
    none = ShapeExplanation((), np.zeros((0, 0)), (), evidence.rms)
    if not evidence.drop > 0:
        return none
    drops: list[float] = []
    present = final.model.effect_names
    fit, static = declared, [effect for effect in effects if effect.is_static_shape and effect.name not in present]
    for least_share in EXPLAINED_STEPS:
        absent = [effect for effect in static if effect.name not in fit.model.effect_names]
        best = add_static_effect(fit, absent, scales)
        if best is None:
            return none
        drops.append((fit.deviance - best.deviance) * final.pixels.share / thin.share)
        fit = best
        share = (declared.deviance - fit.deviance) / thin.dispersion / evidence.drop
        log(f"  static {', '.join(fit.model.effect_names)}: {100 * share:.1f} % of the free shape")
        if share > EXPLAINED_SHARE:
            fit = fit_jointly(fit.model, thin, tolerance=EVIDENCE_TOLERANCE)
            names = {effect.name for effect in static}
            index = [k for k, parameter in enumerate(fit.model.free) if parameter.effect in names]
            applied = tuple(a for a in fit.model.forward.effects if a.effect.name in names)
            # Errors of the fit to all pixels.
            covariance = estimate_covariance(fit)[np.ix_(index, index)] * thin.share / final.pixels.share
            parameters = tuple((fit.model.free[k].effect, fit.model.free[k].name) for k in index)
            errors = dict(zip(parameters, np.sqrt(np.diag(covariance)), strict=True))
            if not all(is_significant(effect, errors) for effect in applied):
                return none
            return ShapeExplanation(applied, covariance, parameters, evidence.rms, tuple(drops))
        if share < least_share:
            return none
    return none


def is_significant(applied: AppliedEffect, errors: Mapping[tuple[str, str], float]) -> bool:
    """Return whether the strength of an effect differs from none by `MIN_Z` of its errors, by (effect, parameter)."""
    stderr = errors.get((applied.effect.name, applied.effect.parameters[0].name), np.nan)
    return bool(abs(applied.values[0] - applied.effect.vanishes_at) >= MIN_Z * stderr)


def add_static_effect(fit: JointFit, effects: Sequence[Effect], scales: EffectScales) -> JointFit | None:
    """Return the fit with the static effect that lowers −2 ln L most, or None if none gains `MIN_GAIN`."""
    refits, least = [], MIN_GAIN * fit.pixels.dispersion
    for candidate in screen_candidates(fit, list_starts(effects, scales))[:MOST_STATIC_REFITS]:
        if candidate.score > least:
            model = fit.model.with_effect(candidate.start, scales)
            refits.append(fit_jointly(model, fit.pixels, tolerance=EVIDENCE_TOLERANCE, iterations=STATIC_ITERATIONS))
    best = min(refits, key=lambda refit: refit.deviance, default=None)
    return best if best is not None and best.deviance < fit.deviance - least else None


def without_shape(model: JointModel) -> JointModel:
    """Return the model with the declared shape."""
    return replace(model, grid=None).with_learned(None)
