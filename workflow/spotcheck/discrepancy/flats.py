"""Assessment of datasets of flats and darks without spots: search of their levels for effects of the sensor.

A level is a set of flats of the same light, with mean [DN] and variance [DN²] of a reading less those of darks. The
declared model is a linear sensor: the mean is proportional to the light (with R, the light of the lamp at the largest
level), and the variance to the mean (with the gain K). R and K are nuisance parameters. The extended model is the
declared one with the named effects, which act at the same stages of the sensor as for spots. A scatter
(`LevelScatter`) is that of the levels beyond their stated errors: by the lamp, by the converter, and of the variances.

`FlatLevels` has the `values` [2, level] (means, then variances), their `errors`, the relative `light`, and whether a
level `is_held_out` from fits. A `LevelFit` has the fitted `model`, the `residual` [2, level], the derivatives of the
readings by the light (`slopes`), the estimated `scatter`, and the `deviance`, −2 ln L.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from scipy.stats import norm

from spotcheck.characterization.levels import make_linearizing_sensor, measure_levels
from spotcheck.characterization.photon_transfer import Transfer, analyse_photon_transfer
from spotcheck.crops.ingest import exclude_copies
from spotcheck.dataset.folder import Dataset
from spotcheck.discrepancy import findings
from spotcheck.discrepancy.candidates import list_starts, value_is_one_sided
from spotcheck.discrepancy.criteria import MIN_GAIN, PRESENT_Z
from spotcheck.discrepancy.evidence import is_negligible
from spotcheck.discrepancy.flat_fit import LevelFit, LevelScatter, estimate_covariance, fit_levels
from spotcheck.discrepancy.flat_levels import FEWEST_LEVELS, FlatLevels, collect_levels
from spotcheck.discrepancy.flat_selection import (
    SelectedLevelEffects,
    add_effect,
    assess_smoothness,
    estimate_rough_scatter,
    measure_held_out_gain,
    screen_starts,
    select_level_effects,
)
from spotcheck.discrepancy.limits import NOT_FOUND, TOO_SMALL
from spotcheck.discrepancy.places import correct_for_number
from spotcheck.model.effect import AppliedEffect, Effect, RandomStep

# Reason if nothing can be assessed.
TOO_FEW = f"fewer than {FEWEST_LEVELS} levels of different light below saturation, in pairs of frames"
# Names of the two values of a level.
VALUES = ("mean", "variance")
# Smallest p-value that is reported.
LEAST_P = 1e-300
# Most values of levels that are listed as places of disagreement.
MOST_PLACES = 3
# Normal quantiles of 95 %, for limits with one end and with two.
ONE_SIDED, TWO_SIDED = 1.645, 1.960
# Least promised drop of −2 ln L at which a limit is taken from a fit of the effect instead of score tests.
LEAST_FIT = 9.0
# Most strengths that are tried for a limit, and the relative accuracy of the limit.
LIMIT_TRIALS, LIMIT_ACCURACY = 16, 0.01
# Further frames that halve errors, in numbers of present frames: errors are proportional to 1/√(number).
HALVING_FRAMES = 3


def analyse_flats(dataset: Dataset, frames_table: xr.Dataset, effects: Sequence[Effect]) -> findings.Findings:
    """Return the findings from a dataset of flats and darks.

    Parameters
    ----------
    dataset : Dataset
        The dataset, as it was ingested.
    frames_table : xarray.Dataset
        Table of its frames (frames.nc).
    effects : sequence of Effect
        Effects to search for; those that levels cannot show are listed in `Findings.not_assessed`.
    """
    full_scale_dn = float(frames_table["full_scale"])
    dataset = exclude_copies(dataset, frames_table)
    transfer = analyse_photon_transfer(measure_levels(dataset, full_scale_dn), full_scale_dn)
    # `measure_levels` removes a stated curvature of the response, which changes the largest reading.
    linear_full_scale_dn = make_linearizing_sensor(dataset, full_scale_dn).without_curvature().full_scale_dn
    return analyse_levels(transfer, linear_full_scale_dn, effects)


def analyse_levels(transfer: Transfer, full_scale_dn: float, effects: Sequence[Effect]) -> findings.Findings:
    """Return the findings from levels of light; only a reason if the levels cannot be assessed.

    Parameters
    ----------
    transfer : Transfer
        Levels, and `quantities` of the photon transfer by straight lines: each has `value`, `stderr`, and in `why` the
        reason if it is unknown.
    full_scale_dn : float
        Largest reading [DN].
    effects : sequence of Effect
        Effects to search for.
    """
    levels, gain_of_line = collect_levels(transfer, full_scale_dn), transfer.quantities["gain"]
    if levels is None:
        return findings.Findings(reason=f"the manifest names no frame of kind spot; {gain_of_line.why or TOO_FEW}")
    reasons = {effect.name: reason_not_assessed(effect, levels) for effect in effects}
    assessed = [effect for effect in effects if not reasons[effect.name]]
    selected = select_level_effects(levels, assessed)
    declared, fit = selected.declared, selected.fit
    scatter = estimate_rough_scatter(levels, fit)
    detection = detect(levels, declared, scatter)
    gap, shares = measure_gap(levels, selected, scatter)
    covariance = estimate_covariance(levels, fit)
    position = fit.position("", "gain_dn_per_e")
    gain_variance = covariance[position, position]
    # Scatter of the lamp beyond the stated errors, relative to the light.
    lamp_scatter = (scatter.lamp**2 - 1) ** 0.5 * float(np.median(levels.errors[0] / levels.values[0]))
    return findings.Findings(
        has_converged=declared.has_converged and fit.has_converged,
        detection=detection,
        rms_of_peak=max(mean_square_beyond_noise(levels, declared, scatter)[0], 0.0) ** 0.5,
        places=list_places(levels, declared, scatter),
        effects=name_effects(selected, covariance, shares),
        limits=tuple(
            limit_effect(levels, selected, effect) for effect in assessed if effect.name not in selected.tests
        ),
        unexplained=measure_unexplained(levels, fit, scatter, gap, detect(levels, fit, scatter).p_value),
        gap=gap,
        not_assessed=tuple((name, reason) for name, reason in reasons.items() if reason),
        levels=findings.LevelFindings(
            number=len(levels.light),
            gain=findings.ParameterValue(fit.model.sensor.gain_dn_per_e, float(gain_variance**0.5), "DN/e-"),
            straight_line=findings.ParameterValue(gain_of_line.value, gain_of_line.stderr, "DN/e-"),
            light_scatter=lamp_scatter,
        ),
    )


def reason_not_assessed(effect: Effect, levels: FlatLevels) -> str:
    """Return why levels cannot show an effect; "" if they can."""
    if effect.hidden_in_flats:
        return effect.hidden_in_flats
    if all(any(isinstance(step, RandomStep) for step in steps) for steps in effect.variants.values()):
        return "levels are means over the frame, which hold no scatter"
    missing = [need.value for need in effect.needs if need not in levels.needs_met]
    return f"it needs {missing[0]}" if missing else ""


# Detection


def detect(levels: FlatLevels, fit: LevelFit, scatter: LevelScatter) -> findings.Detection:
    """Test whether the residuals of a fit have a part that is smooth in light.

    A rough residual, from level to level, is taken for scatter of the lamp. The p-value of all tests is corrected for
    their number.
    """
    tests = []
    # Number `value` is 0 for the means and 1 for the variances.
    z = deviations_in_errors(levels, fit, scatter)
    for value, smoothness in enumerate(assess_smoothness(levels, fit, scatter)):
        where = name_place(levels, value, int(np.argmax(np.abs(z[value]))))
        p_value = max(smoothness.p_value, LEAST_P)
        name = f"{VALUES[value]}: smooth in light"
        tests.append(findings.ResidualTest(name, where, smoothness.excess, p_value, float(norm.isf(p_value))))
    tests.sort(key=lambda test: test.p_value)
    return findings.Detection(correct_for_number(tests[0].p_value, len(tests)), tuple(tests))


def deviations_in_errors(levels: FlatLevels, fit: LevelFit, scatter: LevelScatter) -> np.ndarray:
    """Return the residuals of means, and of variances at given means, in standard errors [2, level]."""
    return scatter.standardize(levels, fit.slopes).apply(fit.residual)


def name_place(levels: FlatLevels, value: int, level: int) -> str:
    """Return the description of the mean (`value` 0) or the variance (1) of a level."""
    return f"the {VALUES[value]} of the level at {levels.values[0, level]:.4g} DN"


def list_places(levels: FlatLevels, fit: LevelFit, scatter: LevelScatter) -> tuple[findings.Place, ...]:
    """Return the means and variances of levels that disagree most with a fit, the strongest first."""
    z = deviations_in_errors(levels, fit, scatter)
    places = [divmod(int(k), z.shape[1]) for k in np.argsort(-np.abs(z), axis=None)[:MOST_PLACES]]
    return tuple(findings.Place(name_place(levels, value, level), float(z[value, level])) for value, level in places)


# Held-out levels and the unexplained residual


def measure_gap(
    levels: FlatLevels, selected: SelectedLevelEffects, scatter: LevelScatter
) -> tuple[findings.Gap, dict[str, float]]:
    """Return the gap on held-out levels, and the part of it that each effect of the extended model closes, by name.

    All fits are compared under the same scatter, that of the extended model, so that the expected mean square is 1 for
    noise alone.
    """
    is_held_out, declared, fit = levels.is_held_out, selected.declared, selected.fit
    standardization = scatter.standardize(levels, fit.slopes)

    def mean_square(other: LevelFit) -> float:
        """Return the mean squared standardized residual of the held-out levels."""
        return float(np.mean(standardization.apply(other.residual)[:, is_held_out] ** 2))

    before, after = mean_square(declared), mean_square(fit)
    noise = standardization.errors[0, is_held_out] ** 2
    rms_before, rms_after = (
        float(max(np.mean(other.residual[0, is_held_out] ** 2 - noise), 0.0) ** 0.5) for other in (declared, fit)
    )
    excess = max(before - 1.0, 1e-12)
    gap = findings.Gap(
        before=before, after=after, noise_floor=1.0, closed=(before - after) / excess, rms_dn_before=rms_before,
        rms_dn_after=rms_after, gain=measure_held_out_gain(levels, declared, fit), on="held-out levels",
    )  # fmt: skip
    return gap, {name: (mean_square(test.without) - after) / excess for name, test in selected.tests.items()}


def mean_square_beyond_noise(levels: FlatLevels, fit: LevelFit, scatter: LevelScatter) -> tuple[float, float]:
    """Return the mean square [peak²] of the residuals of means less that by the lamp, and its standard error [peak²].

    The peak is the mean of the brightest level. Scatter of the converter is not subtracted: it counts as misfit.
    """
    is_fitted, peak_dn = ~levels.is_held_out, levels.values[0].max()
    lamp_variance = (scatter.lamp * levels.errors[0, is_fitted] / peak_dn) ** 2
    square = float(np.mean((fit.residual[0, is_fitted] / peak_dn) ** 2 - lamp_variance))
    return square, float(np.sqrt(2 * np.sum(lamp_variance**2)) / len(lamp_variance))


def measure_unexplained(
    levels: FlatLevels, fit: LevelFit, scatter: LevelScatter, gap: findings.Gap, p_value: float
) -> findings.Unexplained:
    """Return the residual of the means about the extended model; `p_value` is that of its detection.

    The share of the gap is NaN if the gap under the declared model may be due to noise.
    """
    square, error = mean_square_beyond_noise(levels, fit, scatter)
    # Two standard deviations of the mean square of 2 n standard normal values, for n levels.
    chance = 2 * np.count_nonzero(levels.is_held_out) ** -0.5
    share = float(np.clip(1 - gap.closed, 0.0, 1.0)) if gap.before > gap.noise_floor + chance else float("nan")
    return findings.Unexplained(max(square, 0.0) ** 0.5, error, square / error, share, p_value)


# Effects and limits


def name_effects(
    selected: SelectedLevelEffects, covariance: np.ndarray, shares: dict[str, float]
) -> tuple[findings.NamedEffect, ...]:
    """Return the effects of the extended model, the one that closes most of the gap first.

    `covariance` [parameter, parameter] is that of the fit, `shares` the part of the gap that each effect closes.
    """
    named, fit = [], selected.fit
    for applied in fit.model.effects:
        name, values = applied.effect.name, {}
        for parameter in applied.effect.parameters_of(applied.variant):
            position = fit.position(name, parameter.name)
            stderr = float(covariance[position, position] ** 0.5)
            values[parameter.name] = findings.ParameterValue(applied.parameters[parameter.name], stderr, parameter.unit)
        test = selected.tests[name]
        named.append(
            findings.NamedEffect(applied, values, test.gain, test.z, test.consistency, test.rivals, shares[name])
        )
    return tuple(sorted(named, key=lambda effect: -effect.gap_closed))


def limit_effect(levels: FlatLevels, selected: SelectedLevelEffects, effect: Effect) -> findings.UpperLimit:
    """Return the range of the strength of an effect that is not named.

    The range comes from a fit if its score test promises a drop of −2 ln L by at least `LEAST_FIT`, else from score
    tests at several strengths. Both ends are NaN for a rival of a named effect, and for an effect that the levels do
    not show. `selected` has the fit of the extended model, the `tests` of its effects, and `objections`: why an effect
    was removed from it.
    """
    limit = findings.UpperLimit.of_effect(effect, selected.objections.get(effect.name, NOT_FOUND))
    named = [name for name, test in selected.tests.items() if effect.name in test.rivals]
    if named:
        return replace(limit, reason=f"does as well in the place of {named[0]}")
    candidates = screen_starts(levels, selected.fit, list_starts([effect], levels.scales))
    if not candidates:
        return replace(limit, reason="these levels do not show it")
    # The limit is that of the first variant, in the effect's list, that the levels can show.
    variants = {candidate.start.variant for candidate in candidates}
    first = next(variant for variant in effect.variants if variant in variants)
    best, fit = next(candidate for candidate in candidates if candidate.start.variant is first), None
    if best.promise >= LEAST_FIT and np.isfinite(effect.vanishes_at):
        fit = add_effect(levels, selected.fit, effect)
    if fit is not None and selected.fit.deviance - fit.deviance >= MIN_GAIN and limit.reason == NOT_FOUND:
        is_nothing = is_negligible(fit.model.effects[-1], levels.scales)
        limit = replace(limit, reason=TOO_SMALL if is_nothing else "not distinct from what is named")
    if fit is not None:
        return limit_fitted(levels, fit, limit)
    if not np.isfinite(effect.vanishes_at):
        level = find_limit(levels, selected.fit, best.start, 1, ONE_SIDED)
        return replace(limit, low=level, remark="only a brighter level can raise it")
    if value_is_one_sided(best.start):
        limit = replace(limit, high=find_limit(levels, selected.fit, best.start, 1, ONE_SIDED))
    else:
        low, high = (find_limit(levels, selected.fit, best.start, sign, TWO_SIDED) for sign in (-1, 1))
        limit = replace(limit, low=low, high=high)
    return replace(limit, frames=HALVING_FRAMES * levels.frames)


def limit_fitted(levels: FlatLevels, fit: LevelFit, limit: findings.UpperLimit) -> findings.UpperLimit:
    """Return a limit with the range of the strength of the last effect of a fit: its value and error after a refit."""
    fit = fit_levels(levels, fit.model.effects, fit)
    applied = fit.model.effects[-1]
    position, value = fit.position(limit.effect, limit.parameter), applied.values[0]
    error = float(estimate_covariance(levels, fit)[position, position] ** 0.5)
    if value_is_one_sided(applied):
        limit = replace(limit, high=max(value, applied.effect.vanishes_at) + ONE_SIDED * error)
    else:
        limit = replace(limit, low=value - TWO_SIDED * error, high=value + TWO_SIDED * error)
    if abs(value - applied.effect.vanishes_at) > PRESENT_Z * error:
        return replace(limit, remark="something like it is there, which more frames will not make smaller")
    return replace(limit, frames=HALVING_FRAMES * levels.frames)


def find_limit(levels: FlatLevels, fit: LevelFit, start: AppliedEffect, sign: int, quantile: float) -> float:
    """Return the weakest strength of an effect that the levels exclude; NaN if they exclude none within its bounds.

    Strengths are on the side `sign` (1 or −1) of the value at which the effect vanishes. At a tried strength, the score
    test finds an amplitude s ± e, in units of the change that this strength makes. The strength is excluded if
    max(s, 0) + `quantile` e < 1. Several strengths are tried, since the change by a clip is not proportional to its
    strength. The search is in a distance: from the value at which the effect vanishes, or 1/strength if it vanishes at
    infinity (a clip; `sign` does not matter then).
    """
    effect, name = start.effect, start.effect.parameters[0].name
    vanishes_at_infinity = not np.isfinite(effect.vanishes_at)

    def strength_at(distance: float) -> float:
        """Return the strength at a distance, in the unit of the strength."""
        return 1 / distance if vanishes_at_infinity else effect.vanishes_at + sign * distance

    def largest_amplitude_at(distance: float) -> float:
        """Return the upper limit on the amplitude s; infinite if the levels carry no information on it."""
        candidates = screen_starts(levels, fit, [start.with_value(name, strength_at(distance))])
        return max(candidates[0].size, 0.0) + quantile * candidates[0].stderr if candidates else np.inf

    low, high = effect.bounds(levels.scales)[0]
    # The limit lies between `inside`, which is not excluded, and `outside`, which is excluded or the bound.
    inside, outside = 0.0, abs((low if sign < 0 else high) - effect.vanishes_at)
    trial = abs(start.values[0] - effect.vanishes_at)
    if vanishes_at_infinity:
        inside, outside, trial = 1 / high, 1 / low, 1 / start.values[0]
    has_excluded = False
    for _ in range(LIMIT_TRIALS):
        amplitude = largest_amplitude_at(trial)
        inside, outside = (inside, trial) if amplitude < 1 else (trial, outside)
        has_excluded |= amplitude < 1
        if outside - inside < LIMIT_ACCURACY * outside:
            break
        # If the change is proportional to the distance, the limit is at trial × amplitude. The next trial is slightly
        # past it, so that the limit is bracketed from the other side.
        trial *= amplitude * (1 + LIMIT_ACCURACY / 3 * np.sign(amplitude - 1))
        if not inside < trial < outside:
            trial = 0.5 * (inside + outside) if has_excluded else outside
    return float(strength_at(outside)) if has_excluded else float("nan")
