"""Selection of effects on levels of flats: forward over sets of effects, then tests of each effect of the best set.

A level is a set of flats of the same light, with mean [DN] and variance [DN²] of a reading less those of darks. A start
is an effect with the values from which its fit would begin. Standardized data are means, variances and darks of all
fitted levels, transformed to unit covariance [datum]. The declared model is a linear sensor. A scatter is that of the
levels beyond their stated errors: by the lamp, by the converter, and of the variances. Rivals are effects that explain
the levels about as well as a selected one, in its place.

`FlatLevels` has the `values` [2, level] (means, then variances), their `errors`, and whether a level `is_held_out` from
fits. A `LevelFit` has the fitted `model`, the `residual` [2, level], the derivatives of the expected values by its
parameters (`jacobian`) and of the readings by the light (`slopes`), the `scatter`, and the `deviance`, −2 ln L.
"""

from collections.abc import Sequence
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
from spotcheck.discrepancy.limits import TOO_SMALL
from spotcheck.model.effect import AppliedEffect, Effect

# Number of sets of each size that are extended by one more effect, since two effects together may look like a third.
BEAM = 3
# Least drop of −2 ln L that the score test of a start must promise before it is fitted; most starts that are fitted.
LEAST_PROMISE, MOST_STARTS = 5.0, 2
# Least part of a change's Fisher information that the other parameters must leave; below, they can mimic the change.
SEPARABLE_SHARE = 1e-5
# Least part of an effect's gain that the score test of a rival must promise before the rival is fitted.
RIVAL_SHARE = 0.2
# Least Fisher information of a start on which the levels carry information at all.
LEAST_INFORMATION = 1e-8
# Largest part of χ² that a score test may explain, so that its logarithm stays finite.
MOST_EXPLAINED = 0.999
# Smallest corrected p-value of the smoothness tests at which no further effect is searched for.
SMOOTH_P = 0.1
# Highest order of the polynomials in the position of a level that count as smooth; at most a third of the levels.
SMOOTH_ORDER = 4
# Least singular value of a smooth direction after projection on the parameters (1 if these absorb none of it).
LEAST_SMOOTH_PART = 0.1
# Number of cells in the consistency test, by the light of the levels: for means, and as many for variances.
CELLS = 3
# Least part of the information that a direction of the cells' scores must have to count.
LEAST_CELL_SHARE = 1e-3


@dataclass(frozen=True)
class LevelCandidate:
    """Score test of a starting point of an effect."""

    start: AppliedEffect  # effect with the values from which a fit begins
    size: float  # estimated amplitude of the change by the effect, in units of the start
    stderr: float  # standard error of the size
    promise: float  # expected drop of −2 ln L


@dataclass(frozen=True)
class LevelTest:
    """Evidence for one fitted effect."""

    gain: float  # drop of −2 ln L by the effect
    z: float  # strength in standard errors, or the root of the drop of χ² if that is smaller
    consistency: Consistency  # test of equal strength at low, middle and high levels, in means and in variances
    rivals: dict[str, float]  # by how much −2 ln L is larger with a rival in place of the effect, by name
    without: LevelFit  # fit without the effect
    objection: str  # why the effect is not named; "" if it is named


@dataclass(frozen=True)
class SelectedLevelEffects:
    """Effects that the levels show, and the fits behind them."""

    declared: LevelFit  # fit of the linear sensor
    fit: LevelFit  # fit with the selected effects
    tests: dict[str, LevelTest]  # test of each selected effect, by name
    objections: dict[str, str]  # why an effect was removed from the best set again, by name


@dataclass(frozen=True)
class SmoothnessTest:
    """F test of residuals for a part that is smooth in light."""

    excess: float  # sum of squares over the smooth directions, less its expectation, in its standard deviations
    p_value: float  # probability of a larger sum if there is no smooth part


def select_level_effects(levels: FlatLevels, effects: Sequence[Effect]) -> SelectedLevelEffects:
    """Select the effects that the levels show: search for the best set, then remove effects that fail a test.

    The effect with the worst consistency is removed first. All others are tested again after each removal.

    Parameters
    ----------
    levels : FlatLevels
        All levels.
    effects : sequence of Effect
        Effects to search for.
    """
    declared = fit_levels(levels, ())
    best = _search(levels, declared, effects)
    objections: dict[str, str] = {}
    while True:
        tests = {name: assess_level_effect(levels, best, name, effects) for name in best.effect_names}
        failed = [name for name, test in tests.items() if test.objection]
        if not failed:
            return SelectedLevelEffects(declared, best, tests, objections)
        worst = max(failed, key=lambda name: tests[name].consistency.q / tests[name].consistency.limit)
        objections[worst] = tests[worst].objection
        best = tests[worst].without


def _search(levels: FlatLevels, declared: LevelFit, effects: Sequence[Effect]) -> LevelFit:
    """Search for the best set of effects, and return its fit; that of the declared model if no effect gains enough.

    The best sets of one size are extended by one effect each. The search ends when the residuals are smooth, or when
    the best extension gains too little. Finally the variants of each effect are compared.
    """
    best, beam = declared, [declared]
    for _ in range(MOST_EFFECTS):
        p_values = [test.p_value for test in assess_smoothness(levels, best, estimate_rough_scatter(levels, best))]
        if len(p_values) * min(p_values) > SMOOTH_P:
            break
        # Best fit of each extended set: several sets of the beam may lead to the same one.
        extended: dict[frozenset[str], LevelFit] = {}
        for fit in beam:
            for effect in effects:
                if effect.name in fit.effect_names:
                    continue
                names, extension = frozenset((*fit.effect_names, effect.name)), add_effect(levels, fit, effect)
                if extension is not None and not _has_negligible(levels, extension):
                    extended[names] = min(extended.get(names, extension), extension, key=_cost)
        beam = sorted(extended.values(), key=_cost)[:BEAM]
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
    """Return −2 ln L plus the price of the parameters, by which fits are compared."""
    return fit.deviance + PARAMETER_PRICE * len(fit.names)


def _has_negligible(levels: FlatLevels, fit: LevelFit) -> bool:
    """Return whether the last effect of a fit is too small to matter to a user."""
    return is_negligible(fit.model.effects[-1], levels.scales)


def screen_starts(levels: FlatLevels, fit: LevelFit, starts: Sequence[AppliedEffect]) -> list[LevelCandidate]:
    """Return the score tests of starts that would be added to a fit, the most promising first.

    Starts whose change the parameters of the fit can mimic, or on which the levels carry no information, are left out.

    Notes
    -----
    A start changes the expected data. After projection on the parameters of the fit, the amplitude of this change, in
    units of the start, has the score U and the Fisher information I. Its estimate is U/I, and χ² drops by U²/I. The
    promised drop of −2 ln L assumes that the scatter decreases with χ².
    """
    standardization = fit.scatter.standardize(levels, fit.slopes)
    basis = np.linalg.qr(standardized_jacobian(levels, fit, standardization).T)[0]
    residual, expected = standardized_residual(levels, fit, standardization), levels.values - fit.residual
    chi2, candidates = float(residual @ residual), []
    for start in starts:
        with_start = expect_levels(levels, replace(fit.model, effects=(*fit.model.effects, start)))
        dark_change = with_start.dark_misfit - fit.dark_misfit
        change = standardize_data(levels, standardization, with_start.values - expected, dark_change)
        projected = change - basis @ (basis.T @ change)
        information = float(projected @ projected)
        # The negated comparison also leaves out NaN: starts at which the model has no value.
        if not information >= max(SEPARABLE_SHARE * float(change @ change), LEAST_INFORMATION):
            continue
        score = float(projected @ residual)
        explained = min(score**2 / information, MOST_EXPLAINED * chi2)
        promise = -len(residual) * np.log1p(-explained / max(chi2, len(residual)))
        candidates.append(LevelCandidate(start, score / information, information**-0.5, float(promise)))
    return sorted(candidates, key=lambda candidate: -candidate.promise)


def add_effect(
    levels: FlatLevels, fit: LevelFit, effect: Effect, least_promise: float = LEAST_PROMISE
) -> LevelFit | None:
    """Return the best fit with one more effect; None if no start of it promises a drop of `least_promise`.

    The most promising start of each variant is fitted, for at most `MOST_STARTS` variants.
    """
    start_of_variant: dict = {}
    for candidate in screen_starts(levels, fit, list_starts([effect], levels.scales)):
        if candidate.promise >= least_promise:
            start_of_variant.setdefault(candidate.start.variant, candidate.start)
    starts = list(start_of_variant.values())[:MOST_STARTS]
    fits = [fit_levels(levels, (*fit.model.effects, start), fit, is_ranking=True) for start in starts]
    return min(fits, key=_cost, default=None)


def _try_variants(levels: FlatLevels, fit: LevelFit, effect: Effect) -> LevelFit:
    """Return the fit with the best variant of an effect; among variants that tie, the first in the effect's list."""
    if len(effect.variants) == 1:
        return fit
    others = tuple(applied for applied in fit.model.effects if applied.effect is not effect)
    fit_of_variant = {fit.applied(effect.name).variant: fit}
    without = fit_levels(levels, others, fit, is_ranking=True)
    for candidate in screen_starts(levels, without, list_starts([effect], levels.scales)):
        variant = candidate.start.variant
        if variant not in fit_of_variant:
            fit_of_variant[variant] = fit_levels(levels, (*others, candidate.start), fit, is_ranking=True)
    limit = min(map(_cost, fit_of_variant.values())) + VARIANT_TIE
    fits = (fit_of_variant[variant] for variant in effect.variants if variant in fit_of_variant)
    best = next(other for other in fits if _cost(other) < limit)
    return best if best is fit else fit_levels(levels, best.model.effects, best)


# Tests


def smooth_basis(count: int) -> np.ndarray:
    """Return orthonormal polynomials [level, order + 1] of the position of a level among `count` levels."""
    order = min(SMOOTH_ORDER, count // 3)
    return np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, count), order))[0]


def estimate_rough_scatter(levels: FlatLevels, fit: LevelFit) -> LevelScatter:
    """Estimate the scatter from the residuals of a fit after a smooth function of the light has been subtracted."""
    is_fitted = ~levels.is_held_out
    smooth, standardization = smooth_basis(int(is_fitted.sum())), fit.scatter.standardize(levels, fit.slopes)
    rough = standardization.apply(fit.residual)
    rough[:, is_fitted] -= rough[:, is_fitted] @ smooth @ smooth.T
    return estimate_scatter(levels, standardization.invert(rough), fit.slopes, smooth.shape[1])


def assess_smoothness(levels: FlatLevels, fit: LevelFit, scatter: LevelScatter) -> list[SmoothnessTest]:
    """Test the residuals of the means, and those of the variances, for a part that is smooth in light.

    The statistic is the sum of squares over the smooth directions that the parameters have not absorbed. `scatter` is
    that of the rough part (`estimate_rough_scatter`). It is an estimate as well, so that the sum follows an F
    distribution.
    """
    is_fitted = ~levels.is_held_out
    standardization, smooth = scatter.standardize(levels, fit.slopes), smooth_basis(int(is_fitted.sum()))
    rows = standardization.apply(fit.jacobian)[..., is_fitted].reshape(len(fit.names), -1)
    parameter_basis = np.linalg.qr(rows.T)[0]
    residual, tests = standardization.apply(fit.residual)[:, is_fitted].ravel(), []
    # Unit vectors that choose the means, then the variances.
    for block in np.eye(2):
        basis = np.kron(block[:, None], smooth)
        projected = basis - parameter_basis @ (parameter_basis.T @ basis)
        directions, singular, _ = np.linalg.svd(projected, full_matrices=False)
        directions = directions[:, singular > LEAST_SMOOTH_PART]
        count = directions.shape[1]
        square = float(np.sum((directions.T @ residual) ** 2))
        p_value = float(stats.f.sf(square / count, count, len(smooth) - smooth.shape[1])) if count else 1.0
        tests.append(SmoothnessTest((square - count) / max(2 * count, 1) ** 0.5, p_value))
    return tests


def assess_level_effect(levels: FlatLevels, fit: LevelFit, name: str, effects: Sequence[Effect]) -> LevelTest:
    """Test one effect of a fit; `effects` are those that may be its rivals."""
    others = [applied for applied in fit.model.effects if applied.effect.name != name]
    without = fit_levels(levels, others, fit)
    gain = without.deviance - fit.deviance
    rivals, has_negligible_rival = {}, False
    for effect in effects:
        rival = None if effect.name in fit.effect_names else add_effect(levels, without, effect, RIVAL_SHARE * gain)
        if rival is not None and rival.deviance - fit.deviance < VARIANT_TIE:
            # A second, complete fit: that of `add_effect` only ranks.
            rival = fit_levels(levels, rival.model.effects, rival)
            if rival.deviance - fit.deviance < VARIANT_TIE:
                rivals[effect.name] = max(rival.deviance - fit.deviance, 0.0)
                has_negligible_rival |= _has_negligible(levels, rival)
    consistency, z = assess_consistency(levels, fit, without, name)
    objections = (
        (gain < MIN_GAIN or z**2 < MIN_GAIN, "not significant"),
        (is_negligible(fit.applied(name), levels.scales), TOO_SMALL),
        (has_negligible_rival, "another effect that is too small to matter does as well"),
        (not consistency.is_consistent, "low, middle and high levels disagree about its size"),
        (measure_held_out_gain(levels, without, fit) <= 0, "it does not improve the prediction of held-out levels"),
    )
    objection = next((text for is_raised, text in objections if is_raised), "")
    return LevelTest(gain, z, consistency, rivals, without, objection)


def measure_held_out_gain(levels: FlatLevels, before: LevelFit, after: LevelFit) -> float:
    """Return the drop of −2 ln L of the held-out levels from one fit to another.

    Each squared standardized residual is limited to `MIN_GAIN`: a level at the edge of a clip deviates strongly, since
    the light is uneven.
    """
    deviances = [deviance_of(levels, fit, levels.is_held_out, MIN_GAIN) for fit in (before, after)]
    return deviances[0] - deviances[1]


def assess_consistency(levels: FlatLevels, fit: LevelFit, without: LevelFit, name: str) -> tuple[Consistency, float]:
    """Compare the strengths of an effect between low, middle and high levels, in means and in variances.

    These are the cells. With few levels, the parameters absorb a part of the score U of each cell. Cochran's Q is
    therefore U' C⁺ U, with the covariance C of the scores after projection on the parameters.

    Parameters
    ----------
    levels : FlatLevels
        All levels.
    fit, without : LevelFit
        Fits with and without the effect.
    name : str
        Name of the effect.

    Returns
    -------
    consistency : Consistency
        Cochran's Q test.
    z : float
        Strength in standard errors, or the root of the drop of χ² if that is smaller.
    """
    # The smaller scatter of both fits: an effect that only moves a misfit from means to variances must not pass.
    mean_error = float(np.median(levels.errors[0]))
    smaller = min(fit.scatter, without.scatter, key=lambda s: (s.lamp * mean_error) ** 2 + s.converter_dn**2)
    scatter: LevelScatter = replace(smaller, variance=min(fit.scatter.variance, without.scatter.variance))
    standardization, count = scatter.standardize(levels, fit.slopes), int((~levels.is_held_out).sum())
    rows = standardized_jacobian(levels, fit, standardization)
    residual = standardized_residual(levels, fit, standardization)
    # Derivative of the data by the strength, after projection on the other parameters; its part in each cell.
    position = fit.position(name, next(parameter for effect, parameter in fit.names if effect == name))
    others = np.linalg.qr(np.delete(rows, position, axis=0).T)[0]
    slope = rows[position] - others @ (others.T @ rows[position])
    information = float(slope @ slope)
    cell = np.add.outer(CELLS * np.arange(2), np.arange(count) * CELLS // count).ravel()
    cell = np.concatenate([cell, [-1] * len(fit.dark_misfit)])  # darks belong to no cell
    cell_slopes = slope * (cell == np.arange(2 * CELLS)[:, None])
    # Cochran's Q over the directions of the cells' scores that are not absorbed.
    basis = np.linalg.qr(rows.T)[0]
    projected = cell_slopes - cell_slopes @ basis @ basis.T
    eigenvalues, directions = np.linalg.eigh(projected @ projected.T)
    is_used = eigenvalues > LEAST_CELL_SHARE * information
    q = float(((directions.T @ cell_slopes @ residual)[is_used] ** 2 / eigenvalues[is_used]).sum())
    # Squared strength in standard errors. A clip vanishes at infinity and has no Wald test.
    before = standardized_residual(levels, without, standardization)
    drop = float(before @ before - residual @ residual)
    distance = distance_from_nothing(fit.applied(name))
    wald = distance**2 / estimate_covariance(levels, fit)[position, position]
    z_squared = max(min(drop, wald if np.isfinite(distance) else np.inf), 0.0)
    freedom = int(is_used.sum())
    limit = freedom + max(CELL_SLACK * np.sqrt(2 * max(freedom, 1)), CELL_MISFIT * z_squared)
    return Consistency(q, freedom + 1, float(limit), bool(q <= limit)), float(np.sqrt(z_squared))
