"""Selection of effects on levels of flats: forward over sets of effects, then tests of each effect of the best set."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from spotcheck.discrepancy.candidates import list_starts
from spotcheck.discrepancy.criteria import CELL_MISFIT, CELL_SLACK, MIN_GAIN, MOST_EFFECTS, PARAMETER_PRICE, VARIANT_TIE
from spotcheck.discrepancy.evidence import distance_from_nothing, is_negligible
from spotcheck.discrepancy.findings import Consistency
from spotcheck.discrepancy.flat_fit import (
    LevelFit,
    LevelScatter,
    deviance_of,
    estimate_covariance,
    estimate_scatter,
    fit_levels,
    standardize_data,
    standardized_jacobian,
    standardized_residual,
)
from spotcheck.discrepancy.flat_levels import FlatLevels, expect_levels
from spotcheck.model.effect import AppliedEffect, Effect

# Sets of each size that are extended by one more effect: two effects together may look like a third.
BEAM = 3
# Drop of −2 ln L that the score test must promise before a start is fitted, and starts of an effect that are.
LEAST_PROMISE, MOST_STARTS = 5.0, 2
# Part of a change's information that must be left beside all other parameters; else these can do the same.
SEPARABLE_SHARE = 1e-5
# Part of an effect's gain that the score test of a rival must promise before it is fitted.
RIVAL_SHARE = 0.2
# Information of a start below which the levels say nothing of it.
LEAST_INFORMATION = 1e-8
# P-value of smoothness above which nothing more is sought.
SMOOTH_P = 0.1
# A smooth misfit is a polynomial of a level's place among the levels up to this order, or a third of their number.
SMOOTH_ORDER = 4
# A smooth direction of which a fit leaves less than this part is not tested.
LEAST_SMOOTH_PART = 0.1
# Cells of levels by their light in the consistency test, for means and for variances each.
CELLS = 3
# Part of the information below which a direction of the cells' scores is left out.
LEAST_CELL_SHARE = 1e-3

Log = Callable[[str], None]


@dataclass(frozen=True)
class LevelCandidate:
    """Score test of a starting point of an effect."""

    start: AppliedEffect  # where a fit begins
    size: float  # estimated part of the start that is there
    stderr: float  # standard error of the size
    promise: float  # expected drop of −2 ln L


@dataclass(frozen=True)
class LevelTest:
    """Evidence for one fitted effect."""

    gain: float  # drop of −2 ln L by the effect
    z: float  # strength in standard errors; by the drop of χ² if that is less
    consistency: Consistency  # of its strength over low, middle and high levels, means and variances
    rivals: dict[str, float]  # effects that do as well in its place: how much larger −2 ln L is
    held_out_gain: float  # drop of −2 ln L of the held-out levels, no level counting more than `MIN_GAIN`
    objection: str  # why it is not named; "" if it is


@dataclass(frozen=True)
class SelectedLevelEffects:
    """Effects that levels show."""

    declared: LevelFit  # fit of the linear sensor
    fit: LevelFit  # fit with the effects
    tests: dict[str, LevelTest]  # by effect of the fit
    objections: dict[str, str]  # why other effects of the best set are not named, by effect


@dataclass(frozen=True)
class SmoothnessTest:
    """F test of whether residuals are smooth in light."""

    excess: float  # sum of squares over the smooth directions, less its expectation, in its standard deviations
    p_value: float


def select_level_effects(levels: FlatLevels, effects: Sequence[Effect], log: Log) -> SelectedLevelEffects:
    """Return the effects that levels show, with their tests."""
    declared = fit_levels(levels, ())
    best = _search(levels, declared, effects, log)
    objections: dict[str, str] = {}
    while True:
        tests = {name: assess_level_effect(levels, best, name, effects) for name in best.effect_names}
        for name, test in tests.items():
            log(f"  test {name}: gain {test.gain:.0f}, z {test.z:.1f}, Q {test.consistency.q:.1f}"
                f" of {test.consistency.limit:.0f}, rivals {test.rivals}, {test.objection or 'passes'}")  # fmt: skip
        failed = [name for name, test in tests.items() if test.objection]
        if not failed:
            return SelectedLevelEffects(declared, best, tests, objections)
        worst = max(failed, key=lambda name: tests[name].consistency.q / tests[name].consistency.limit)
        objections[worst] = tests[worst].objection
        best = without_effect(levels, best, worst)


def _search(levels: FlatLevels, declared: LevelFit, effects: Sequence[Effect], log: Log) -> LevelFit:
    """Return the fit with the best set of effects; sets grow from the best of a size less."""
    best, beam = declared, [declared]
    for _ in range(MOST_EFFECTS):
        p_values = [test.p_value for test in assess_smoothness(levels, best, estimate_rough_scatter(levels, best))]
        log(f"  residuals of {' + '.join(best.effect_names) or 'the linear sensor'}: p {min(p_values):.2g}")
        if len(p_values) * min(p_values) > SMOOTH_P:
            break
        extended: dict[frozenset[str], LevelFit] = {}
        for fit in beam:
            for effect in effects:
                names = frozenset((*fit.effect_names, effect.name))
                fits = [] if effect.name in fit.effect_names else [add_effect(levels, fit, effect)]
                for other in (*fits, extended.get(names)):
                    if other is not None and not _has_negligible(levels, other):
                        extended[names] = min(extended.get(names, other), other, key=_cost)
        beam = sorted(extended.values(), key=_cost)[:BEAM]
        for fit in beam:
            log(f"  {' + '.join(fit.effect_names)}: {best.deviance - fit.deviance:.0f}")
        if not beam or _cost(best) - _cost(beam[0]) < MIN_GAIN - PARAMETER_PRICE:
            break
        best = beam[0]
    if best is declared:
        return declared
    best = fit_levels(levels, best.model.effects, best)
    for effect in (applied.effect for applied in best.model.effects):
        best = _try_variants(levels, best, effect)
    return best


def _cost(fit: LevelFit) -> float:
    """Return −2 ln L and the price of the parameters."""
    return fit.deviance + PARAMETER_PRICE * len(fit.names)


def _has_negligible(levels: FlatLevels, fit: LevelFit) -> bool:
    """Return whether a user would call the last effect of a fit nothing."""
    return is_negligible(fit.model.effects[-1], levels.scales)


def screen_starts(levels: FlatLevels, fit: LevelFit, starts: Sequence[AppliedEffect]) -> list[LevelCandidate]:
    """Return the score test of each starting point of effects beside a fit, the most promising first. Those of which
    the levels say nothing beside the other parameters are left out.

    With score U and information I of the change that a start makes, beside all parameters, the size is U/I. The drop of
    −2 ln L is that of χ² under a scatter that shrinks with it.
    """
    standard = fit.scatter.standardize(levels, fit.slopes)
    basis = np.linalg.qr(standardized_jacobian(levels, fit, standard).T)[0]
    residual, expected = standardized_residual(levels, fit, standard), levels.values - fit.residual
    chi2, candidates = float(residual @ residual), []
    for start in starts:
        other = expect_levels(levels, replace(fit.model, effects=(*fit.model.effects, start)))
        change = standardize_data(levels, standard, other.values - expected, other.dark_misfit - fit.dark_misfit)
        beside = change - basis @ (basis.T @ change)
        information = float(beside @ beside)
        if not information >= max(SEPARABLE_SHARE * float(change @ change), LEAST_INFORMATION):  # or NaN
            continue
        score = float(beside @ residual)
        explained = min(score**2 / information, 0.999 * chi2)
        promise = -len(residual) * np.log1p(-explained / max(chi2, len(residual)))
        candidates.append(LevelCandidate(start, score / information, information**-0.5, float(promise)))
    return sorted(candidates, key=lambda candidate: -candidate.promise)


def add_effect(
    levels: FlatLevels, fit: LevelFit, effect: Effect, least_promise: float = LEAST_PROMISE
) -> LevelFit | None:
    """Return the best fit with one more effect; None if no start of it promises enough."""
    variants: dict = {}
    for candidate in screen_starts(levels, fit, list_starts([effect], levels.scales)):
        if candidate.promise >= least_promise:
            variants.setdefault(candidate.start.variant, candidate.start)
    fits = [
        fit_levels(levels, (*fit.model.effects, start), fit, is_ranking=True)
        for start in list(variants.values())[:MOST_STARTS]
    ]
    return min(fits, key=_cost, default=None)


def _try_variants(levels: FlatLevels, fit: LevelFit, effect: Effect) -> LevelFit:
    """Return the fit with the best variant of an effect; of variants that tie, the first of the effect."""
    others = tuple(applied for applied in fit.model.effects if applied.effect is not effect)
    now = next(applied for applied in fit.model.effects if applied.effect is effect)
    best = {now.variant: fit}
    beside = fit_levels(levels, others, fit, is_ranking=True) if len(effect.variants) > 1 else fit
    starts = list_starts([effect], levels.scales) if len(effect.variants) > 1 else []
    for candidate in screen_starts(levels, beside, starts):
        if candidate.start.variant not in best:
            best[candidate.start.variant] = fit_levels(levels, (*others, candidate.start), fit, is_ranking=True)
    least = min(_cost(other) for other in best.values())
    chosen = next(best[v] for v in effect.variants if v in best and _cost(best[v]) < least + VARIANT_TIE)
    return chosen if chosen is fit else fit_levels(levels, chosen.model.effects, chosen)


def without_effect(levels: FlatLevels, fit: LevelFit, name: str) -> LevelFit:
    """Return the fit without an effect."""
    return fit_levels(levels, [applied for applied in fit.model.effects if applied.effect.name != name], fit)


# Tests


def smooth_basis(count: int) -> np.ndarray:
    """Return orthonormal smooth functions [level, order] of the place of a level among so many."""
    order = min(SMOOTH_ORDER, count // 3)
    return np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, count), order))[0]


def estimate_rough_scatter(levels: FlatLevels, fit: LevelFit) -> LevelScatter:
    """Return the scatter by what is left of the residuals beyond all that is smooth in light."""
    searched = ~levels.is_held_out
    smooth, standard = smooth_basis(int(searched.sum())), fit.scatter.standardize(levels, fit.slopes)
    rough = standard.apply(fit.residual)
    rough[:, searched] -= rough[:, searched] @ smooth @ smooth.T
    return estimate_scatter(levels, standard.invert(rough), fit.slopes, smooth.shape[1])


def assess_smoothness(levels: FlatLevels, fit: LevelFit, scatter: LevelScatter) -> list[SmoothnessTest]:
    """Return whether the residuals of means and of variances are smooth in light, given the scatter beyond that.

    Each is a sum of squares over the smooth directions that the fit has not absorbed. The scatter is at best as well
    known as that of the rough part, so that the sum follows Fisher's F law.
    """
    searched = ~levels.is_held_out
    standard, smooth = scatter.standardize(levels, fit.slopes), smooth_basis(int(searched.sum()))
    rows = standard.apply(fit.jacobian)[..., searched].reshape(len(fit.names), -1)
    absorbed = np.linalg.qr(rows.T)[0]
    residual, tests = standard.apply(fit.residual)[:, searched].ravel(), []
    for block in np.eye(2):
        basis = np.kron(block[:, None], smooth)
        directions, parts, _ = np.linalg.svd(basis - absorbed @ (absorbed.T @ basis), full_matrices=False)
        directions = directions[:, parts > LEAST_SMOOTH_PART]
        count = directions.shape[1]
        square = float(np.sum((directions.T @ residual) ** 2))
        p_value = float(stats.f.sf(square / count, count, len(smooth) - smooth.shape[1])) if count else 1.0
        tests.append(SmoothnessTest((square - count) / max(2 * count, 1) ** 0.5, p_value))
    return tests


def assess_level_effect(levels: FlatLevels, fit: LevelFit, name: str, effects: Sequence[Effect]) -> LevelTest:
    """Test one effect of a fit."""
    without = without_effect(levels, fit, name)
    gain = without.deviance - fit.deviance
    rivals, has_negligible_rival = {}, False
    for effect in effects:
        other = None if effect.name in fit.effect_names else add_effect(levels, without, effect, RIVAL_SHARE * gain)
        if other is not None and other.deviance - fit.deviance < VARIANT_TIE:
            other = fit_levels(levels, other.model.effects, other)
            if other.deviance - fit.deviance < VARIANT_TIE:
                rivals[effect.name] = max(other.deviance - fit.deviance, 0.0)
                has_negligible_rival |= _has_negligible(levels, other)
    consistency, z = assess_consistency(levels, fit, without, name)
    held_out_gain = measure_held_out_gain(levels, without, fit)
    applied = next(applied for applied in fit.model.effects if applied.effect.name == name)
    objection = ""
    if gain < MIN_GAIN or z**2 < MIN_GAIN:
        objection = "not significant"
    elif is_negligible(applied, levels.scales):
        objection = "too small to matter"
    elif has_negligible_rival:
        objection = "another effect that is too small to matter does as well"
    elif not consistency.is_consistent:
        objection = "low, middle and high levels disagree about its size"
    elif held_out_gain <= 0:
        objection = "it does not improve the prediction of held-out levels"
    return LevelTest(gain, z, consistency, rivals, held_out_gain, objection)


def measure_held_out_gain(levels: FlatLevels, before: LevelFit, after: LevelFit) -> float:
    """Return the drop of −2 ln L of the held-out levels; no deviation counts more than `MIN_GAIN`, for at the edge of a
    clip the light's unevenness counts."""
    first, second = (deviance_of(levels, fit, levels.is_held_out, MIN_GAIN) for fit in (before, after))
    return first - second


def assess_consistency(levels: FlatLevels, fit: LevelFit, without: LevelFit, name: str) -> tuple[Consistency, float]:
    """Return Cochran's Q of an effect's strength over low, middle and high levels, means and variances apart, and its
    strength in standard errors.

    With few levels the parameters absorb part of each cell's score U, so that Q = U' C⁺ U with the covariance C of what
    is left. The scatter is the smaller one of the fits with and without the effect: an effect that moves a misfit from
    means to variances explains nothing.
    """
    size = float(np.median(levels.errors[0]))
    of_means = min(fit.scatter, without.scatter, key=lambda s: (s.lamp * size) ** 2 + s.converter_dn**2)
    scatter: LevelScatter = replace(of_means, variance=min(fit.scatter.variance, without.scatter.variance))
    standard, count = scatter.standardize(levels, fit.slopes), int((~levels.is_held_out).sum())
    rows, residual = standardized_jacobian(levels, fit, standard), standardized_residual(levels, fit, standard)
    position = fit.position(name, next(parameter for effect, parameter in fit.names if effect == name))
    others = np.linalg.qr(np.delete(rows, position, axis=0).T)[0]
    change = rows[position] - others @ (others.T @ rows[position])
    information = float(change @ change)
    cell = np.add.outer(CELLS * np.arange(2), np.arange(count) * CELLS // count).ravel()
    parts = change * (np.concatenate([cell, [-1] * len(fit.dark_misfit)]) == np.arange(2 * CELLS)[:, None])
    absorbed = np.linalg.qr(rows.T)[0]
    left = parts - parts @ absorbed @ absorbed.T
    eigenvalues, directions = np.linalg.eigh(left @ left.T)
    is_used = eigenvalues > LEAST_CELL_SHARE * information
    q = float(((directions.T @ parts @ residual)[is_used] ** 2 / eigenvalues[is_used]).sum())
    before = standardized_residual(levels, without, standard)
    drop = float(before @ before - residual @ residual)
    distance = distance_from_nothing(next(applied for applied in fit.model.effects if applied.effect.name == name))
    wald = distance**2 / estimate_covariance(levels, fit)[position, position]
    square = max(min(drop, wald if np.isfinite(distance) else np.inf), 0.0)
    freedom = int(is_used.sum())
    limit = freedom + max(CELL_SLACK * np.sqrt(2 * max(freedom, 1)), CELL_MISFIT * square)
    return Consistency(q, freedom + 1, float(limit), bool(q <= limit)), float(np.sqrt(square))
