"""Upper limits (95 %) on the strength of effects that are not named, and effects that a design cannot show.

The limit of an effect of the mean image, or of a law across frames, is the weakest strength that is excluded
(`strength_trials`). A trial is a strength on one side of where the effect vanishes. Its estimate is the size s ± e of
the change that this strength makes, as a fraction, by a score test; the strength is excluded if s + k e < 1 with the
normal quantile k. Directions are the starts of an effect that differ in its direction parameter alone. A clip vanishes
at infinity: its limit is a lower one. A `Trial` has the `sign` of its side and the tried `distance` from where the
effect vanishes (1/strength for a clip). It also has the `estimate` (`size` s, `error` e, `z` = s/e) and the `limit`.

Errors are inflated by √(Q/(n − 1)) if Cochran's Q over n cells of the data exceeds n − 1 (the scale factor of the
Particle Data Group, Review of Particle Physics, introduction). Random effects are limited by the interval of their
standard deviation. Scales are sizes of the dataset, from which effects derive bounds and starting values. A law is a
dependence of brightness and width of the spot on the conditions of a frame, such as its exposure. "Named" effects are
those that the verdict reports as present.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from scipy import stats

from spotcheck.discrepancy.analysis import Analysis
from spotcheck.discrepancy.candidates import changes_mean_image
from spotcheck.discrepancy.criteria import MIN_Z, MISFIT_INFLATION, PRESENT_Z
from spotcheck.discrepancy.evidence import LEAST_CELL_SHARE, is_negligible
from spotcheck.discrepancy.findings import UpperLimit
from spotcheck.discrepancy.frames import Design, thin_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.laws import LawSearch, is_law
from spotcheck.discrepancy.named_scatter import NamedScatter
from spotcheck.discrepancy.normal_equations import assemble
from spotcheck.discrepancy.projected_changes import SEPARABLE_SHARE, project_trials, sum_trials
from spotcheck.discrepancy.strength_trials import (
    LARGEST_ERROR,
    Estimate,
    Trial,
    add_directions,
    choose_farthest,
    list_trials,
    solve_trials,
)
from spotcheck.model.baseline import Baseline
from spotcheck.model.effect import Effect, EffectScales, Need, RandomStep, Scope

# Most distances that are tried: before the farthest start of each variant is chosen, then on thinned pixels or laws,
# and on all pixels.
FIRST_TRIES, TRIES, FULL_TRIES = 1, 12, 3
# Search for a clip that may be present below its limit; the distance of a clip is 1/level. Score tests are made at the
# first multiples of the distance of the limit. If z of any is above `SCANNED_Z`, fits are made at the second multiples.
SCANNED_FACTORS, SCANNED_Z = (1.01, 1.03, 1.08), 1.5
FITTED_FACTORS = (1.0, 1.01, 1.02, 1.03, 1.05, 1.08, 1.15)
# Newton decrement of these fits, most iterations, and number of bisections between the largest distance that is allowed
# and the next one, which is excluded.
PROFILE_TOLERANCE, PROFILE_ITERATIONS, PROFILE_BISECTIONS = 0.1, 6, 4
# Part of the information on a law that must be left beside the other laws. It may be small, since spots beside a free
# light shape are known far better in some directions than in others.
SEPARABLE_SHARE_OF_LAWS = 1e-10
# Thinned pixels without a free light shape; with one the default number is used.
THINNED_PIXELS = 50_000
# Angles of the fibres [rad] are rounded to this number of decimals before distinct ones are counted.
ANGLE_DECIMALS = 6

# Reasons why an effect is not named.
NOT_FOUND = "not found"
NOT_CONFIRMED = "not found in held-out frames"
TOO_SMALL = "too small to matter"
NOT_SHOWN = "the design cannot show it"
CONFOUNDED = "confounded with the light shape"
NO_SIZE = "stands in place of a part of the model and has no size that could be small"
NO_FORMULA = "a free light shape is not needed; what is left of the mean image limits it"
NOT_MEASURED = "the frames do not measure it"

# Remarks why more frames would not lower a limit.
ALREADY_PRESENT = "more frames would not: a part of it may be there"
SET_BY_MISFIT = "more frames would not: misfit of the model sets the limit, not noise"
SET_BY_LIGHT = "more frames would not: a brighter spot would"
NOT_FROM_ZERO = "its size does not count from 0"
BEYOND_RANGE = "these frames allow any strength"


def find_limits(analysis: Analysis, named: Collection[str], effects: Sequence[Effect]) -> tuple[UpperLimit, ...]:
    """Return the limits of all effects that are not named and that the design can show.

    Parameters
    ----------
    analysis : Analysis
        The `prepared` frames, the final fit of the mean image to all pixels (`selected`), the `search` for laws in its
        spots, and the random effects (`named_scatter`). Held-out frames refuted the effects that are `withdrawn`. If
        the declared model leaves the peak of each frame free, no law can be tested (None), and laws have no limit.
    named : collection of str
        Names of the effects that the verdict names.
    effects : sequence of Effect
        Effects that were searched for.

    Returns
    -------
    tuple of UpperLimit
        A limit for each of these effects, in the order of `effects`. For an effect without a limit `low` and `high` are
        NaN, and `reason` says why.
    """
    fit, scales = analysis.selected.fit, analysis.prepared.scales
    not_assessed = {
        name for name, _ in list_not_assessed(effects, fit.model.design, analysis.prepared.setting.baseline)
    }
    without_limit = {*named, *not_assessed, *fit.model.effect_names}
    limited_effects = [effect for effect in effects if effect.name not in without_limit]
    mean_effects = [effect for effect in limited_effects if is_limited_by_pixels(effect, fit.model)]
    limits = limit_mean_effects(fit, mean_effects, scales)
    if analysis.search is not None:
        named_laws = [effect for effect in effects if effect.name in named and is_law(effect)]
        limits |= limit_laws(analysis.search, named_laws, [effect for effect in limited_effects if is_law(effect)])
    for random_effect in analysis.named_scatter:
        limits[random_effect.applied.effect.name] = limit_scatter(random_effect, len(fit.model.spots.x), scales)
    upper_limits = [limits.get(effect.name) or explain_missing(effect, fit.model) for effect in limited_effects]
    return tuple(
        replace(limit, reason=NOT_CONFIRMED) if limit.effect in analysis.withdrawn else limit for limit in upper_limits
    )


def list_not_assessed(effects: Sequence[Effect], design: Design, baseline: Baseline) -> tuple[tuple[str, str], ...]:
    """Return (name, sentence on what is needed) of each effect that a design cannot show."""
    exposures = len(np.unique(design.exposure_s)) if design.has_exposures else 0
    # Effects of the angle have a period of half a turn. Two angles would fit any amplitude and phase of them.
    angles = len(np.unique(np.round(np.mod(design.angle, np.pi), ANGLE_DECIMALS)))
    frames = len(design.site)
    is_met = {
        Need.EXPOSURES: exposures > 1,
        Need.THREE_EXPOSURES: exposures > 2,
        Need.ANGLES: angles > 2,
        Need.ORDER: design.has_order and frames > 2,
        Need.FRAMES: frames > 2 and np.bincount(design.condition).max() > 1,
        Need.SITES: design.sites > 1,
        Need.LAW: design.has_exposures and baseline.photon_budget != "free",
    }
    missing = {effect.name: [need.value for need in effect.needs if not is_met[need]] for effect in effects}
    return tuple((name, f"needs {' and '.join(needs)}") for name, needs in missing.items() if needs)


def explain_missing(effect: Effect, model: JointModel) -> UpperLimit:
    """Return an `UpperLimit` without ends (NaN), and the reason why the effect has no limit."""
    if effect.is_static_shape and model.grid is not None:
        reason = CONFOUNDED
    elif not any(effect.variants.values()):
        reason = NO_FORMULA
    elif np.isnan(effect.vanishes_at) and is_law(effect):
        reason = NO_SIZE
    else:
        reason = NOT_SHOWN if changes_mean_image(effect) or is_law(effect) else NOT_MEASURED
    return UpperLimit.of_effect(effect, reason)


def summarize_sides(sides: Sequence[Trial], frames: int, scales: EffectScales) -> UpperLimit:
    """Return the limit of one effect.

    Parameters
    ----------
    sides : sequence of Trial
        Final trial on each side of where the effect vanishes: one or two.
    frames : int
        Number of frames, from which that of further ones follows.
    scales : EffectScales
        Scales of the dataset.
    """
    start = sides[0].start
    effect, strength = start.effect, start.effect.parameters[0]
    limit_of_side = {trial.sign: trial.limit for trial in sides}
    is_clip = np.isinf(effect.vanishes_at)
    low, high = (limit_of_side[1], np.nan) if is_clip else (limit_of_side.get(-1, np.nan), limit_of_side[1])
    ends = list(limit_of_side.values())
    z = max(trial.estimate.z for trial in sides)
    remark, reason = SET_BY_LIGHT if is_clip else "", NOT_FOUND
    if z > PRESENT_Z:
        remark = ALREADY_PRESENT
    if max(trial.estimate.inflation for trial in sides) > MISFIT_INFLATION:
        # Misfit may look like the effect, so that the range must include its absence.
        zero = effect.vanishes_at
        low, high, remark = float(np.minimum(low, zero)), float(np.maximum(high, zero)), SET_BY_MISFIT
    if np.isnan(ends).any():
        remark = BEYOND_RANGE
    elif z > MIN_Z and all(is_negligible(start.with_value(strength.name, end), scales) for end in ends):
        reason = TOO_SMALL
    # The change grows as distance**power, and the error of its size falls as 1/√frames: half the distance takes
    # 4**power as many frames.
    powers = [trial.power for trial in sides if np.isfinite(trial.power) and not trial.is_linear]
    more_frames = None if remark else int(np.ceil((4 ** max(powers, default=1.0) - 1) * frames))
    return UpperLimit.of_effect(effect, reason, low=low, high=high, frames=more_frames, remark=remark)


# Effects of the mean image


def is_limited_by_pixels(effect: Effect, model: JointModel) -> bool:
    """Return whether the mean image limits an effect: not a static one beside a free shape, which can absorb it."""
    return changes_mean_image(effect) and not (effect.is_static_shape and model.grid is not None)


def limit_mean_effects(fit: JointFit, effects: Sequence[Effect], scales: EffectScales) -> dict[str, UpperLimit]:
    """Return the limits of effects of the mean image that are not in the model, by name.

    Thinned pixels give the strength that frames without the effect (s = 0) would exclude, for each variant and start.
    The start with the weakest limit is chosen on each side. Its score is then taken on all pixels.
    """
    # A free shape needs more pixels.
    thin = thin_pixels(fit.pixels, THINNED_PIXELS) if fit.model.grid is None else thin_pixels(fit.pixels)
    thinned = replace(fit, pixels=thin, equations=assemble(fit.model, thin))
    share = thin.count / max(fit.pixels.count, 1)

    def predict(trials: Sequence[Trial]) -> list[Estimate]:
        """Return the estimates to expect without the effect, with the errors of all pixels."""
        projection = project_trials(thinned, [trial.applied()[0] for trial in trials])
        # All pixels have 1/share times the information of the thinned ones.
        errors = np.sqrt(share / np.maximum(projection.information, 1e-300))
        errors[(projection.information <= SEPARABLE_SHARE * projection.alone) | (errors > LARGEST_ERROR)] = np.inf
        return [Estimate(0.0, float(error), float(stats.norm.ppf(trial.quantile_level)))
                for trial, error in zip(trials, errors, strict=True)]  # fmt: skip

    def measure(trials: Sequence[Trial]) -> list[Estimate]:
        """Return the estimates by the score on all pixels.

        Nuisance parameters are projected off with coefficients that the thinned pixels give.
        """
        directions = [trial.applied() for trial in trials]
        applied = list(chain(*directions))
        score, information = sum_trials(fit, applied, project_trials(thinned, applied))
        # Position of the first direction of each trial in `applied`.
        offsets = np.cumsum([0, *map(len, directions)])
        return [estimate_size(trial, fit.model.design, score[start:stop], information[start:stop])
                for trial, start, stop in zip(trials, offsets, offsets[1:], strict=False)]  # fmt: skip

    trials = solve_trials(list_trials(effects, scales), predict, FIRST_TRIES)
    trials = solve_trials(list(chain(*choose_farthest(trials, of_variants=True).values())), predict, TRIES)
    farthest = chain(*choose_farthest(trials).values())
    trials = solve_trials([trial.restart() for trial in farthest if trial.is_limited], measure, FULL_TRIES)
    limits = {}
    for name, sides in choose_farthest(trials).items():
        limits[name] = summarize_sides(sides, len(fit.model.spots.x), scales)
        if np.isinf(sides[0].start.effect.vanishes_at) and np.isfinite(limits[name].low):
            # A clip at a lower level may be present all the same, since the change is not linear in the level.
            trial, low = sides[0], limits[name].low
            scanned = measure([replace(trial, distance=factor / low) for factor in SCANNED_FACTORS])
            if max(estimate.z for estimate in scanned) > SCANNED_Z:
                limits[name] = replace(limits[name], low=profile_clip(fit, trial, low), remark=ALREADY_PRESENT)
    return limits


def profile_clip(fit: JointFit, trial: Trial, highest: float) -> float:
    """Return the lower limit [DN] on the level of a clip that may be present, from fits at several levels.

    The limit is the lowest level at which −2 ln L, minimised over the spots, is less than k² above its minimum over all
    levels. The score test would put it too high, since the spots of a fit without the clip have absorbed a part of it.
    NaN if even the lowest level that is tried is allowed.

    Parameters
    ----------
    fit : JointFit
        Fit without the clip.
    trial : Trial
        The clip, at any level.
    highest : float
        Limit by the score test [DN]. It is returned if no spot is brighter than the lowest level that is tried.
    """
    distances = [factor / highest for factor in FITTED_FACTORS]
    # Frames with spots that the lowest level would clip; others do not depend on the clip.
    clipped_frames = np.flatnonzero(np.exp(fit.model.spots.log_peak) > 1 / distances[-1])
    if len(clipped_frames) == 0:
        return highest
    selected = fit.select(clipped_frames)
    # Sensor, other effects and light shape are fixed, so that only the spots are fitted.
    without_clip = replace(selected.model, free=(), grid=None)

    def deviance_at(distance: float) -> float:
        """Return −2 ln L, minimised over the spots, with the clip at the level 1/`distance`; distance in 1/DN."""
        # A clip has no direction, so that its trial applies a single effect.
        applied = replace(trial, distance=distance).applied()[0]
        forward = replace(without_clip.forward, effects=(*without_clip.forward.effects, applied))
        model = replace(without_clip, forward=forward)
        return fit_jointly(model, selected.pixels, tolerance=PROFILE_TOLERANCE, iterations=PROFILE_ITERATIONS).deviance

    deviances = {distance: deviance_at(distance) for distance in distances}
    best_without = fit_jointly(without_clip, selected.pixels, iterations=PROFILE_ITERATIONS)
    minimum = min(best_without.deviance, *deviances.values())
    bound = minimum + float(stats.norm.ppf(trial.quantile_level)) ** 2
    # Bracket of the limit: largest distance that is allowed, and the next one, which is excluded [1/DN].
    allowed = max((distance for distance, deviance in deviances.items() if deviance < bound), default=distances[0])
    excluded = min((distance for distance in distances if distance > allowed), default=np.inf)
    for _ in range(PROFILE_BISECTIONS if np.isfinite(excluded) else 0):
        middle = float(np.sqrt(allowed * excluded))
        allowed, excluded = (middle, excluded) if deviance_at(middle) < bound else (allowed, middle)
    return 1 / excluded if np.isfinite(excluded) else np.nan


def estimate_size(trial: Trial, design: Design, score: np.ndarray, information: np.ndarray) -> Estimate:
    """Return the estimate of a trial from sums over the pixels in each of its directions.

    `score` and `information` [direction, frame, place] are those of the change that the trial makes, beside all
    nuisance parameters; a place is a sector of a ring of the spot. Errors are inflated by the heterogeneity of places
    between conditions, or between sites if that is larger.
    """
    quantile = float(stats.norm.ppf(trial.quantile_level))
    total = information.sum(axis=(1, 2))
    if not total[0] > LARGEST_ERROR**-2:
        return Estimate(0.0, np.inf, quantile)
    size = add_directions(score.sum(axis=(1, 2)) / np.maximum(total, 1e-300))
    inflation = max(inflation_of(score[0], information[0], labels) for labels in (design.condition, design.site))
    error = inflation / float(np.sqrt(total[0]))
    return Estimate(max(size, 0.0) if trial.is_one_sided else size, error, quantile, inflation)


def inflation_of(score: np.ndarray, information: np.ndarray, labels: np.ndarray) -> float:
    """Return the inflation √(Q/(n − 1)) of an error, at least 1, with Cochran's Q over n cells.

    A cell is a label [frame], such as a site, and a place. `score` and `information` are [frame, place]. With their
    sums u and i over each cell, Q = Σ u²/i − (Σ u)²/Σ i. Cells with little information are left out.
    """
    number = np.unique(labels, return_inverse=True)[1].ravel()
    shape = (number.max() + 1, score.shape[1])
    u, i = np.zeros(shape), np.zeros(shape)
    np.add.at(u, number, score)
    np.add.at(i, number, information)
    used = i > LEAST_CELL_SHARE * i.sum()
    q = float(np.sum(u[used] ** 2 / i[used]) - u[used].sum() ** 2 / i[used].sum())
    return float(np.sqrt(max(q / max(int(used.sum()) - 1, 1), 1.0)))


# Laws and random effects


def limit_laws(search: LawSearch, named: Sequence[Effect], laws: Sequence[Effect]) -> dict[str, UpperLimit]:
    """Return the limits of laws beside the named ones, by name; the weakest limit of all variants and starts counts.

    A law that the frames cannot limit is left out. The observations of the search are ln peak and ln σ of all frames,
    with the inverse covariance W'W, where W is `search.whitening`.
    """
    fit = search.fit(named)
    present = replace(search.forward, law=fit.law, effects=fit.effects)
    mean = search.mean_of(present)
    # Whitened observations (covariance 1): `basis` spans the changes that the fitted parameters can make.
    basis = np.linalg.qr(search.whitening @ fit.jacobian)[0]
    residual = search.whitening @ fit.residual
    inflation = float(np.sqrt(max(fit.chi2 / max(len(residual) - basis.shape[1], 1), 1.0)))

    def estimate(trial: Trial) -> Estimate:
        """Return the size of the change that a trial makes to brightness and width."""
        models = [replace(present, effects=(*fit.effects, applied)) for applied in trial.applied()]
        # Whitened changes in each direction, before and after projection off the fitted parameters.
        whole = [search.whitening @ np.nan_to_num(search.mean_of(model) - mean) for model in models]
        changes = [change - basis @ (basis.T @ change) for change in whole]
        squares = [float(change @ change) for change in changes]
        if not squares[0] > SEPARABLE_SHARE_OF_LAWS * float(whole[0] @ whole[0]):
            return Estimate(0.0, np.inf, 1.0)
        size = add_directions(
            [change @ residual / max(square, 1e-300) for change, square in zip(changes, squares, strict=True)]
        )
        # The size is the sum of the observations with these weights, and has this variance.
        freedom = search.degrees_of_freedom(search.whitening.T @ changes[0] / squares[0], 1 / squares[0])
        quantile = float(stats.t.ppf(trial.quantile_level, freedom))
        size = max(size, 0.0) if trial.is_one_sided else size
        return Estimate(size, inflation / float(np.sqrt(squares[0])), quantile, inflation)

    trials = solve_trials(list_trials(laws, search.scales), lambda trials: list(map(estimate, trials)), TRIES)
    return {
        name: summarize_sides(sides, search.frame_count, search.scales)
        for name, sides in choose_farthest(trials).items()
        if all(trial.is_limited for trial in sides)
    }


def limit_scatter(random_effect: NamedScatter, frames: int, scales: EffectScales) -> UpperLimit:
    """Return the limit of a random effect: the upper end of the 95 % interval of its standard deviation.

    Its ends are NaN if the interval is unknown or exceeds the range of the parameter. `frames` is the number of frames.
    """
    effect = random_effect.applied.effect
    strength = effect.parameters[0]
    interval = random_effect.intervals[strength.name]
    if not (np.isfinite(interval.stderr) and interval.stderr > 0 and interval.high < effect.bounds(scales)[0, 1]):
        return UpperLimit.of_effect(effect, NOT_MEASURED)
    largest = random_effect.applied.with_value(strength.name, interval.high)
    is_small = random_effect.z > MIN_Z and is_negligible(largest, scales)
    steps = [step for step in effect.variants[largest.variant] if isinstance(step, RandomStep)]
    is_shared = any(step.scope is Scope.SENSOR for step in steps)
    remark = ALREADY_PRESENT if random_effect.z > PRESENT_Z else ""
    if np.isnan(effect.vanishes_at):
        remark = remark or NOT_FROM_ZERO
    # Half the standard deviation is a quarter of the variance. The error of a variance falls as 1/√frames, or as
    # 1/frames for a field of the sensor, which pairs of frames share.
    more_frames = None if remark else ((4 if is_shared else 16) - 1) * frames
    reason = TOO_SMALL if is_small else NOT_FOUND
    return UpperLimit.of_effect(effect, reason, high=interval.high, frames=more_frames, remark=remark)
