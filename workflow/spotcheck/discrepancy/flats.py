"""Assessment of flats and darks without spots: what their levels of light say of the sensor.

The declared model is a linear sensor: a signal in proportion to the light (R), and a variance in proportion to the
signal (K). R and K are nuisance parameters. Effects act through the stages of the sensor that spots have.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from scipy.stats import norm

from spotcheck.characterization.levels import make_linearizing_sensor, measure_levels
from spotcheck.characterization.photon_transfer import Transfer, analyse_photon_transfer
from spotcheck.crops.ingest import exclude_copies
from spotcheck.dataset.folder import Dataset
from spotcheck.discrepancy.candidates import list_starts, value_is_one_sided
from spotcheck.discrepancy.criteria import MIN_GAIN
from spotcheck.discrepancy.evidence import is_negligible
from spotcheck.discrepancy.findings import (
    Detection,
    Findings,
    Gap,
    LevelFindings,
    NamedEffect,
    ParameterValue,
    Place,
    ResidualTest,
    Unexplained,
    UpperLimit,
)
from spotcheck.discrepancy.flat_fit import LevelFit, LevelScatter, deviance_of, estimate_covariance, fit_levels
from spotcheck.discrepancy.flat_levels import FEWEST_LEVELS, FlatLevels, collect_levels
from spotcheck.discrepancy.flat_selection import (
    SelectedLevelEffects,
    add_effect,
    assess_smoothness,
    estimate_rough_scatter,
    screen_starts,
    select_level_effects,
    without_effect,
)
from spotcheck.model.effect import AppliedEffect, Effect, RandomStep

TOO_FEW = f"fewer than {FEWEST_LEVELS} levels of different light below saturation, in pairs of frames"
BLOCKS = ("mean", "variance")
# Least p-value that is reported.
LEAST_P = 1e-300
# Number of levels that disagree most which are reported.
MOST_PLACES = 3
# Normal quantiles of 95 %, for limits with one end and with two.
ONE_SIDED, TWO_SIDED = 1.645, 1.960
# Standard errors beyond which an effect that is not named is there all the same, so that more frames do not lower its
# limit.
IS_THERE = 3.0
# Promised drop of −2 ln L from which on a limit comes from a fit, not from score tests.
LEAST_FIT = 9.0
NOT_FOUND = "not found"
# Most strengths that are tried for a limit, and its relative accuracy.
LIMIT_TRIALS, LIMIT_ACCURACY = 16, 0.01

Log = Callable[[str], None]


def analyse_flats(
    dataset: Dataset, frames_table: xr.Dataset, effects: Sequence[Effect], log: Log = lambda text: None
) -> Findings:
    """Return all that is concluded of a dataset of flats and darks.

    Parameters
    ----------
    dataset : Dataset
        The dataset, as it was ingested.
    frames_table : xarray.Dataset
        Table of its frames (frames.nc).
    effects : sequence of Effect
        Effects to look for; those that levels cannot show are listed in `not_assessed`.
    log : callable
        Receives lines of text on the progress.
    """
    full_scale_dn = float(frames_table["full_scale"])
    dataset = exclude_copies(dataset, frames_table)
    transfer = analyse_photon_transfer(measure_levels(dataset, full_scale_dn), full_scale_dn)
    # Levels are those of readings whose stated curvature was removed.
    linear_end = make_linearizing_sensor(dataset, full_scale_dn).without_curvature().full_scale_dn
    return analyse_levels(transfer, linear_end, effects, log)


def analyse_levels(
    transfer: Transfer, full_scale_dn: float, effects: Sequence[Effect], log: Log = lambda text: None
) -> Findings:
    """Return all that is concluded of levels of light; see `analyse_flats`.

    Parameters
    ----------
    transfer : Transfer
        Levels and the photon transfer by straight lines.
    full_scale_dn : float
        Largest reading [DN].
    effects : sequence of Effect
        Effects to look for.
    log : callable
        Receives lines of text on the progress.
    """
    levels, line = collect_levels(transfer, full_scale_dn), transfer.quantities["gain"]
    if levels is None:
        return Findings(reason=f"the manifest names no frame of kind spot; {line.why or TOO_FEW}")
    reasons = {effect.name: reason_not_assessed(effect, levels) for effect in effects}
    assessed = [effect for effect in effects if not reasons[effect.name]]
    selected = select_level_effects(levels, assessed, log)
    declared, fit = selected.declared, selected.fit
    scatter = estimate_rough_scatter(levels, fit)
    detection = detect(levels, declared, scatter)
    without = {name: without_effect(levels, fit, name) for name in fit.effect_names}
    gap, shares = measure_gap(levels, declared, fit, scatter, without)
    covariance = estimate_covariance(levels, fit)
    noise = (scatter.lamp**2 - 1) ** 0.5 * float(np.median(levels.errors[0] / levels.values[0]))
    return Findings(
        has_converged=declared.has_converged and fit.has_converged,
        detection=detection,
        rms_of_peak=max(mean_square_beyond_noise(levels, declared, scatter)[0], 0.0) ** 0.5,
        places=list_places(levels, declared, scatter),
        effects=name_effects(selected, covariance, shares),
        limits=tuple(limit_effect(levels, selected, effect) for effect in assessed if effect.name not in without),
        unexplained=measure_unexplained(levels, fit, scatter, gap, detect(levels, fit, scatter).p_value),
        gap=gap,
        not_assessed=tuple((name, reason) for name, reason in reasons.items() if reason),
        levels=LevelFindings(
            number=len(levels.light),
            frames=levels.frames,
            gain=ParameterValue(fit.model.sensor.gain_dn_per_e, float(covariance[1, 1] ** 0.5), "DN/e-"),
            straight_line=ParameterValue(line.value, line.stderr, "DN/e-"),
            light_scatter=noise,
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


def detect(levels: FlatLevels, fit: LevelFit, scatter: LevelScatter) -> Detection:
    """Return whether the residuals of a fit are smooth in light; scatter from level to level is that of a lamp."""
    tests = []
    z = deviations_in_errors(levels, fit, scatter)
    for k, smoothness in enumerate(assess_smoothness(levels, fit, scatter)):
        where = name_place(levels, k, int(np.argmax(np.abs(z[k]))))
        p_value = max(smoothness.p_value, LEAST_P)
        tests.append(
            ResidualTest(f"{BLOCKS[k]}: smooth in light", where, smoothness.excess, p_value, float(norm.isf(p_value)))
        )
    tests.sort(key=lambda test: test.p_value)
    return Detection(float(-np.expm1(len(tests) * np.log1p(-tests[0].p_value))), tuple(tests))


def deviations_in_errors(levels: FlatLevels, fit: LevelFit, scatter: LevelScatter) -> np.ndarray:
    """Return the residuals of a fit in standard errors [2, level]."""
    return scatter.standardize(levels, fit.slopes).apply(fit.residual)


def name_place(levels: FlatLevels, block: int, level: int) -> str:
    """Return a level in words."""
    return f"the {BLOCKS[block]} of the level at {levels.values[0, level]:.4g} DN"


def list_places(levels: FlatLevels, fit: LevelFit, scatter: LevelScatter) -> tuple[Place, ...]:
    """Return the levels that disagree most with a fit."""
    z = deviations_in_errors(levels, fit, scatter)
    places = [divmod(int(k), z.shape[1]) for k in np.argsort(-np.abs(z), axis=None)[:MOST_PLACES]]
    return tuple(Place(name_place(levels, block, level), float(z[block, level])) for block, level in places)


# Held-out levels and what is left


def measure_gap(
    levels: FlatLevels, declared: LevelFit, fit: LevelFit, scatter: LevelScatter, without: dict[str, LevelFit]
) -> tuple[Gap, dict[str, float]]:
    """Return the gap on held-out levels, and by effect the part of it that the effect closes.

    All fits are compared under the same scatter, that beside the extended model.
    """
    held_out = levels.is_held_out
    standard = scatter.standardize(levels, fit.slopes)
    square = {
        name: float(np.mean(standard.apply(other.residual)[:, held_out] ** 2))
        for name, other in {"": declared, **without}.items()
    }
    after = float(np.mean(standard.apply(fit.residual)[:, held_out] ** 2))
    noise = standard.errors[0, held_out] ** 2
    rms_before, rms_after = (
        float(max(np.mean(other.residual[0, held_out] ** 2 - noise), 0.0) ** 0.5) for other in (declared, fit)
    )
    excess = max(square[""] - 1.0, 1e-12)
    gain = deviance_of(levels, declared, held_out, MIN_GAIN) - deviance_of(levels, fit, held_out, MIN_GAIN)
    gap = Gap(
        before=square[""], after=after, noise_floor=1.0, closed=(square[""] - after) / excess,
        rms_dn_before=rms_before, rms_dn_after=rms_after, gain=gain, on="held-out levels",
    )  # fmt: skip
    return gap, {name: (square[name] - after) / excess for name in without}


def mean_square_beyond_noise(levels: FlatLevels, fit: LevelFit, scatter: LevelScatter) -> tuple[float, float]:
    """Return the mean square of the residuals of means [peak²] less that of the lamp's scatter, and its standard error;
    the scatter of the converter counts as misfit."""
    searched, peak = ~levels.is_held_out, levels.values[0].max()
    lamp = (scatter.lamp * levels.errors[0, searched] / peak) ** 2
    square = float(np.mean((fit.residual[0, searched] / peak) ** 2 - lamp))
    return square, float(np.sqrt(2 * np.sum(lamp**2)) / len(lamp))


def measure_unexplained(
    levels: FlatLevels, fit: LevelFit, scatter: LevelScatter, gap: Gap, p_value: float
) -> Unexplained:
    """Return what is left of the means beside the effects."""
    square, error = mean_square_beyond_noise(levels, fit, scatter)
    chance = 2 * np.count_nonzero(levels.is_held_out) ** -0.5
    share = float(np.clip(1 - gap.closed, 0.0, 1.0)) if gap.before > gap.noise_floor + chance else float("nan")
    return Unexplained(max(square, 0.0) ** 0.5, error, square / error, share, p_value)


# Effects and limits


def name_effects(
    selected: SelectedLevelEffects, covariance: np.ndarray, shares: dict[str, float]
) -> tuple[NamedEffect, ...]:
    """Return the effects of the extended model, the one that closes most of the gap first."""
    named, fit = [], selected.fit
    for applied in fit.model.effects:
        test, name = selected.tests[applied.effect.name], applied.effect.name
        values = {
            parameter.name: ParameterValue(
                applied.parameters[parameter.name],
                float(covariance[(k := fit.position(name, parameter.name)), k] ** 0.5),
                parameter.unit,
            )
            for parameter in applied.effect.parameters_of(applied.variant)
        }
        named.append(
            NamedEffect(applied, values, test.gain, test.z, test.consistency, test.rivals, shares[applied.effect.name])
        )
    return tuple(sorted(named, key=lambda effect: -effect.gap_closed))


def limit_effect(levels: FlatLevels, selected: SelectedLevelEffects, effect: Effect) -> UpperLimit:
    """Return the range of the strength of an effect that is not named."""
    parameter = effect.parameters[0]
    limit = UpperLimit(effect.name, parameter.name, parameter.unit, selected.objections.get(effect.name, NOT_FOUND))
    rivals = [name for name, test in selected.tests.items() if effect.name in test.rivals]
    if rivals:
        return replace(limit, reason=f"does as well in the place of {rivals[0]}")
    candidates = screen_starts(levels, selected.fit, list_starts([effect], levels.scales))
    if not candidates:
        return replace(limit, reason="these levels do not show it")
    # The first variant that levels show stands for all.
    variants = {candidate.start.variant for candidate in candidates}
    first = next(variant for variant in effect.variants if variant in variants)
    best, fit = next(candidate for candidate in candidates if candidate.start.variant is first), None
    if best.promise >= LEAST_FIT and np.isfinite(effect.vanishes_at):
        fit = add_effect(levels, selected.fit, effect)
    if fit is not None and selected.fit.deviance - fit.deviance >= MIN_GAIN and limit.reason == NOT_FOUND:
        is_nothing = is_negligible(fit.model.effects[-1], levels.scales)
        limit = replace(limit, reason="too small to matter" if is_nothing else "not distinct from what is named")
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
    # Errors fall with the root of the number of frames.
    return replace(limit, frames=3 * levels.frames)


def limit_fitted(levels: FlatLevels, fit: LevelFit, limit: UpperLimit) -> UpperLimit:
    """Return the range of the strength of the last effect of a fit, to which the levels react."""
    fit = fit_levels(levels, fit.model.effects, fit)
    applied = fit.model.effects[-1]
    position, value = fit.position(limit.effect, limit.parameter), applied.values[0]
    error = float(estimate_covariance(levels, fit)[position, position] ** 0.5)
    if value_is_one_sided(applied):
        limit = replace(limit, high=max(value, applied.effect.vanishes_at) + ONE_SIDED * error)
    else:
        limit = replace(limit, low=value - TWO_SIDED * error, high=value + TWO_SIDED * error)
    if abs(value - applied.effect.vanishes_at) > IS_THERE * error:
        return replace(limit, remark="something like it is there, which more frames will not make smaller")
    return replace(limit, frames=3 * levels.frames)


def find_limit(levels: FlatLevels, fit: LevelFit, start: AppliedEffect, sign: int, quantile: float) -> float:
    """Return the strength on one side of where an effect vanishes of which all is just excluded; NaN if none is.

    The score test estimates the part s ± e of the change that a strength makes. All of it is excluded if
    s + `quantile` e < 1, where s < 0 counts as 0. Strengths are tried, since a clip does not follow a straight line. A
    distance is that from where the effect vanishes, or one over the strength of an effect that vanishes at infinity.
    """
    effect, name = start.effect, start.effect.parameters[0].name
    is_clip = not np.isfinite(effect.vanishes_at)

    def strength_at(distance: float) -> float:
        return 1 / distance if is_clip else effect.vanishes_at + sign * distance

    def part_left(distance: float) -> float:
        candidates = screen_starts(levels, fit, [start.with_value(name, strength_at(distance))])
        return max(candidates[0].size, 0.0) + quantile * candidates[0].stderr if candidates else np.inf

    low, high = effect.bounds(levels.scales)[0]
    inside, outside = 0.0, abs((low if sign < 0 else high) - effect.vanishes_at)
    trial = abs(start.values[0] - effect.vanishes_at)
    if is_clip:
        inside, outside, trial = 1 / high, 1 / low, 1 / start.values[0]
    is_excluded = False
    for _ in range(LIMIT_TRIALS):
        part = part_left(trial)
        inside, outside = (inside, trial) if part < 1 else (trial, outside)
        is_excluded |= part < 1
        if outside - inside < LIMIT_ACCURACY * outside:
            break
        # A change in proportion to the distance has its limit here; a bit beyond, so that the other end is met.
        trial *= part * (1 + LIMIT_ACCURACY / 3 * np.sign(part - 1))
        if not inside < trial < outside:
            trial = 0.5 * (inside + outside) if is_excluded else outside
    return float(strength_at(outside)) if is_excluded else float("nan")
