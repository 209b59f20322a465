"""Upper limits (95 %) on the strength of effects that are not named, and effects that a design cannot show.

The limit of an effect of the mean image, or of a law, is the strength that is just excluded (`strength_trials`).
Errors are inflated by √(Q/(n − 1)) if Cochran's Q over n cells of the data exceeds n − 1 (the scale factor of the
Particle Data Group, Review of Particle Physics, introduction). Scatter is limited by the interval of its standard
deviation.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from scipy import stats

from spotcheck.discrepancy.candidates import SEPARABLE_SHARE, changes_mean_image
from spotcheck.discrepancy.criteria import MIN_Z, MISFIT_INFLATION, PRESENT_Z
from spotcheck.discrepancy.evidence import LEAST_CELL_SHARE, is_negligible
from spotcheck.discrepancy.findings import UpperLimit
from spotcheck.discrepancy.frames import Design, thin_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.laws import LawSearch, is_law
from spotcheck.discrepancy.named_scatter import NamedScatter
from spotcheck.discrepancy.normal_equations import assemble
from spotcheck.discrepancy.projected_changes import project_trials, sum_trials
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

# Most tries of a strength on thinned pixels or laws; those after which the start that reaches farthest is chosen; and
# most tries on all pixels.
TRIES, FIRST_TRIES, FULL_TRIES = 12, 1, 3
# Distances beyond the limit of a clip, in terms of its own, at which it is looked for by the score test; z from which
# on it is looked for by fits, at more distances.
SCANNED_FACTORS, SCANNED_Z = (1.01, 1.03, 1.08), 1.5
FITTED_FACTORS = (1.0, 1.01, 1.02, 1.03, 1.05, 1.08, 1.15)
# Decrement of these fits, most iterations, and number of bisections.
PROFILE_TOLERANCE, PROFILE_ITERATIONS, PROFILE_BISECTIONS = 0.1, 6, 4
# Part of the information of a law that must be left beside the others: numbers beside a free light shape are known far
# better in some directions than in others.
SEPARABLE_SHARE_OF_LAWS = 1e-10
# Thinned pixels beside the declared light shape.
THINNED_PIXELS = 50_000

NOT_FOUND = "not found"
NOT_CONFIRMED = "not found in held-out frames"
TOO_SMALL = "too small to matter"
NOT_SHOWN = "the design cannot show it"
CONFOUNDED = "confounded with the light shape"
NO_SIZE = "stands in place of a part of the model and has no size that could be small"
NO_FORMULA = "a free light shape is not needed; what is left of the mean image limits it"
NOT_MEASURED = "the frames do not measure it"

ALREADY_PRESENT = "more frames would not: a part of it may be there"
SET_BY_MISFIT = "more frames would not: misfit of the model sets the limit, not noise"
SET_BY_LIGHT = "more frames would not: a brighter spot would"
NOT_FROM_ZERO = "its size does not count from 0"
BEYOND_RANGE = "these frames allow any strength"


def find_limits(
    fit: JointFit,
    named: Collection[str],
    effects: Sequence[Effect],
    scales: EffectScales,
    baseline: Baseline,
    laws: LawSearch | None,
    scatter: Sequence[NamedScatter],
    withdrawn: Collection[str] = (),
) -> tuple[UpperLimit, ...]:
    """Return the limits of all effects that are not named and that the design can show.

    Parameters
    ----------
    fit : JointFit
        Final fit of the mean image to all pixels.
    named : collection of str
        Names of the effects that are reported.
    effects : sequence of Effect
        Effects that were looked for.
    scales : EffectScales
        Scales of the dataset.
    baseline : Baseline
        Declared model of the light.
    laws : LawSearch, optional
        Search for laws of brightness and width beside the final fit; None without a law of the exposure.
    scatter : sequence of NamedScatter
        Effects that scatter, named or not.
    withdrawn : collection of str
        Names of effects that held-out frames refute.
    """
    impossible = {name for name, _ in list_not_assessed(effects, fit.model.design, baseline)}
    done = {*named, *impossible, *fit.model.effect_names}
    rest = [effect for effect in effects if effect.name not in done]
    of_images = limit_mean_effects(fit, [effect for effect in rest if is_limited_by_pixels(effect, fit.model)], scales)
    of_laws = {}
    if laws is not None:
        present = [effect for effect in effects if effect.name in named and is_law(effect)]
        of_laws = limit_laws(laws, present, [effect for effect in rest if is_law(effect)])
    deviations = {
        named_scatter.applied.effect.name: limit_scatter(named_scatter, len(fit.model.spots.x), scales)
        for named_scatter in scatter
    }
    known = of_images | of_laws | deviations
    limits = [known.get(effect.name) or explain_missing(effect, fit.model) for effect in rest]
    return tuple(replace(limit, reason=NOT_CONFIRMED) if limit.effect in withdrawn else limit for limit in limits)


def list_not_assessed(effects: Sequence[Effect], design: Design, baseline: Baseline) -> tuple[tuple[str, str], ...]:
    """Return the effects that a design cannot show, each with what it would need, in words."""
    exposures = len(np.unique(design.exposure_s)) if design.has_exposures else 0
    # Half a turn of the fibres is no other angle. Two angles fit any amplitude and phase.
    angles = len(np.unique(np.round(np.mod(design.angle, np.pi), 6)))
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
    """Return a limit without ends that says why there is none."""
    if effect.is_static_shape and model.grid is not None:
        reason = CONFOUNDED
    elif not any(effect.variants.values()):
        reason = NO_FORMULA
    elif np.isnan(effect.vanishes_at) and is_law(effect):
        reason = NO_SIZE
    else:
        reason = NOT_SHOWN if changes_mean_image(effect) or is_law(effect) else NOT_MEASURED
    strength = effect.parameters[0]
    return UpperLimit(effect.name, strength.name, strength.unit, reason)


def summarize_sides(sides: Sequence[Trial], frames: int, scales: EffectScales) -> UpperLimit:
    """Return the limit of one effect from the trials on its sides."""
    start = sides[0].start
    effect, strength = start.effect, start.effect.parameters[0]
    ends = {trial.sign: trial.limit for trial in sides}
    is_clip = np.isinf(effect.vanishes_at)
    low, high = (ends[1], np.nan) if is_clip else (ends.get(-1, np.nan), ends[1])
    z = max(trial.estimate.z for trial in sides)
    powers = [trial.power for trial in sides if np.isfinite(trial.power) and not trial.is_linear]
    remark, reason = SET_BY_LIGHT if is_clip else "", NOT_FOUND
    if z > PRESENT_Z:
        remark = ALREADY_PRESENT
    if max(trial.estimate.inflation for trial in sides) > MISFIT_INFLATION:
        # Misfit may look like the effect, which then need not be there.
        zero = effect.vanishes_at
        low, high, remark = float(np.minimum(low, zero)), float(np.maximum(high, zero)), SET_BY_MISFIT
    if np.isnan(list(ends.values())).any():
        remark = BEYOND_RANGE
    elif z > MIN_Z and all(is_negligible(start.with_value(strength.name, end), scales) for end in ends.values()):
        reason = TOO_SMALL
    more = None if remark else int(np.ceil((4 ** max(powers, default=1.0) - 1) * frames))
    return UpperLimit(effect.name, strength.name, strength.unit, reason, low, high, more, remark)


# Effects of the mean image


def is_limited_by_pixels(effect: Effect, model: JointModel) -> bool:
    """Return whether an effect has a limit from the mean image."""
    return changes_mean_image(effect) and not (effect.is_static_shape and model.grid is not None)


def limit_mean_effects(fit: JointFit, effects: Sequence[Effect], scales: EffectScales) -> dict[str, UpperLimit]:
    """Return the limits of effects of the mean image that are not in the model.

    Thinned pixels give the strength that would be excluded if the frames asked for nothing, and the variant and start
    that reach farthest. The score of that one is then taken on all pixels.
    """
    # A free shape needs more pixels.
    thin = thin_pixels(fit.pixels, THINNED_PIXELS) if fit.model.grid is None else thin_pixels(fit.pixels)
    thinned = replace(fit, pixels=thin, equations=assemble(fit.model, thin))
    share = thin.count / max(fit.pixels.count, 1)

    def foretell(trials: Sequence[Trial]) -> list[Estimate]:
        projection = project_trials(thinned, [trial.applied()[0] for trial in trials])
        errors = np.sqrt(share / np.maximum(projection.information, 1e-300))
        errors[(projection.information <= SEPARABLE_SHARE * projection.alone) | (errors > LARGEST_ERROR)] = np.inf
        return [Estimate(0.0, float(error), float(stats.norm.ppf(trial.quantile_level)))
                for trial, error in zip(trials, errors, strict=True)]  # fmt: skip

    def measure(trials: Sequence[Trial]) -> list[Estimate]:
        applied = [trial.applied() for trial in trials]
        every = [effect for directions in applied for effect in directions]
        score, information = sum_trials(fit, every, project_trials(thinned, every))
        first = np.cumsum([0, *(len(directions) for directions in applied)])
        return [estimate_size(trial, fit.model.design, score[a:b], information[a:b])
                for trial, a, b in zip(trials, first, first[1:], strict=False)]  # fmt: skip

    trials = solve_trials(list_trials(effects, scales), foretell, FIRST_TRIES)
    trials = solve_trials(list(chain(*choose_farthest(trials, of_variants=True).values())), foretell, TRIES)
    farthest = chain(*choose_farthest(trials).values())
    trials = solve_trials([trial.restart() for trial in farthest if trial.is_limited], measure, FULL_TRIES)
    limits = {}
    for name, sides in choose_farthest(trials).items():
        limits[name] = summarize_sides(sides, len(fit.model.spots.x), scales)
        if np.isinf(sides[0].start.effect.vanishes_at) and np.isfinite(limits[name].low):
            trial, low = sides[0], limits[name].low
            scanned = measure([replace(trial, distance=factor / low) for factor in SCANNED_FACTORS])
            if max(estimate.z for estimate in scanned) > SCANNED_Z:
                limits[name] = replace(limits[name], low=profile_clip(fit, trial, low), remark=ALREADY_PRESENT)
    return limits


def profile_clip(fit: JointFit, trial: Trial, highest: float) -> float:
    """Return the lower limit of the level of a clip that may be there, from fits at several levels.

    The score test would be too high: the spots of a fit without the clip have taken a share of it. The limit is the
    lowest level at which −2 ln L beside the spots is less than k² above its minimum.

    Parameters
    ----------
    fit : JointFit
        Fit without the clip.
    trial : Trial
        Any level of the clip.
    highest : float
        Limit by the score test.
    """
    distances = [factor / highest for factor in FITTED_FACTORS]
    reached = np.flatnonzero(np.exp(fit.model.spots.log_peak) > 1 / distances[-1])
    if len(reached) == 0:
        return highest
    design = fit.model.design.select(reached)
    arrays = {name: getattr(fit.pixels, name)[reached] for name in ("x", "y", "readings", "is_used", "row_share")}
    pixels = replace(fit.pixels, **arrays)
    plain = replace(fit.model, spots=fit.model.spots.select(reached), design=design, free=(), grid=None)

    def deviance_at(distance: float) -> float:
        (applied, *_) = replace(trial, distance=distance).applied()
        model = replace(plain, forward=replace(plain.forward, effects=(*plain.forward.effects, applied)))
        return fit_jointly(model, pixels, tolerance=PROFILE_TOLERANCE, iterations=PROFILE_ITERATIONS).deviance

    deviances = {distance: deviance_at(distance) for distance in distances}
    minimum = min(fit_jointly(plain, pixels, iterations=PROFILE_ITERATIONS).deviance, *deviances.values())
    most = minimum + float(stats.norm.ppf(trial.quantile_level)) ** 2
    allowed = max((distance for distance, deviance in deviances.items() if deviance < most), default=distances[0])
    excluded = min((distance for distance in distances if distance > allowed), default=np.inf)
    for _ in range(PROFILE_BISECTIONS if np.isfinite(excluded) else 0):
        middle = float(np.sqrt(allowed * excluded))
        allowed, excluded = (middle, excluded) if deviance_at(middle) < most else (allowed, middle)
    return 1 / excluded if np.isfinite(excluded) else np.nan


def estimate_size(trial: Trial, design: Design, score: np.ndarray, information: np.ndarray) -> Estimate:
    """Return the estimate of a trial from score and information [direction, frame, place] in all its directions.

    Errors are inflated by what places of a condition, or of a site, disagree beyond their noise.
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
    """Return √(Q/(n − 1)), at least 1, over n cells of a label and a place, from sums [frame, place]."""
    index = np.unique(labels, return_inverse=True)[1].ravel()
    shape = (index.max() + 1, score.shape[1])
    u, i = np.zeros(shape), np.zeros(shape)
    np.add.at(u, index, score)
    np.add.at(i, index, information)
    used = i > LEAST_CELL_SHARE * i.sum()
    count = int(used.sum())
    q = float(np.sum(u[used] ** 2 / i[used]) - u[used].sum() ** 2 / i[used].sum())
    return float(np.sqrt(max(q / max(count - 1, 1), 1.0)))


# Laws, fitted effects and scatter


def limit_laws(search: LawSearch, named: Sequence[Effect], laws: Sequence[Effect]) -> dict[str, UpperLimit]:
    """Return the limits of laws beside the named ones; the largest of all variants and starts counts."""
    fit = search.fit(named)
    present = replace(search.forward, law=fit.law, effects=fit.effects)
    mean = search.mean_of(present)
    basis = np.linalg.qr(search.whitening @ fit.jacobian)[0]
    residual = search.whitening @ fit.residual
    freedom = max(len(residual) - basis.shape[1], 1)
    inflation = float(np.sqrt(max(fit.chi2 / freedom, 1.0)))

    def measure(trials: Sequence[Trial]) -> list[Estimate]:
        return [measure_trial(trial) for trial in trials]

    def measure_trial(trial: Trial) -> Estimate:
        models = [replace(present, effects=(*fit.effects, applied)) for applied in trial.applied()]
        whole = [search.whitening @ np.nan_to_num(search.mean_of(model) - mean) for model in models]
        changes = [change - basis @ (basis.T @ change) for change in whole]
        squares = [float(change @ change) for change in changes]
        if not squares[0] > SEPARABLE_SHARE_OF_LAWS * float(whole[0] @ whole[0]):
            return Estimate(0.0, np.inf, 1.0)
        sizes = [change @ residual / max(square, 1e-300) for change, square in zip(changes, squares, strict=True)]
        size = add_directions(sizes)
        freedom = search.degrees_of_freedom(search.whitening.T @ changes[0] / squares[0], 1 / squares[0])
        quantile = float(stats.t.ppf(trial.quantile_level, freedom))
        size = max(size, 0.0) if trial.is_one_sided else size
        return Estimate(size, inflation / float(np.sqrt(squares[0])), quantile, inflation)

    trials = solve_trials(list_trials(laws, search.scales), measure, TRIES)
    return {
        name: summarize_sides(sides, search.frames, search.scales)
        for name, sides in choose_farthest(trials).items()
        if all(trial.is_limited for trial in sides)
    }


def limit_scatter(named: NamedScatter, frames: int, scales: EffectScales) -> UpperLimit:
    """Return the limit of an effect that scatters, from the interval of its standard deviation."""
    effect = named.applied.effect
    strength = effect.parameters[0]
    interval = named.intervals[strength.name]
    if not (np.isfinite(interval.stderr) and interval.stderr > 0 and interval.high < effect.bounds(scales)[0, 1]):
        return UpperLimit(effect.name, strength.name, strength.unit, NOT_MEASURED)
    is_small = named.z > MIN_Z and is_negligible(named.applied.with_value(strength.name, interval.high), scales)
    # The error of a variance falls with the root of the number of frames, or of pairs of frames that share a field.
    steps = [step for step in effect.variants[named.applied.variant] if isinstance(step, RandomStep)]
    is_shared = any(step.scope is Scope.SENSOR for step in steps)
    remark = ALREADY_PRESENT if named.z > PRESENT_Z else ""
    if np.isnan(effect.vanishes_at):
        remark = remark or NOT_FROM_ZERO
    more = None if remark else ((4 if is_shared else 16) - 1) * frames
    reason = TOO_SMALL if is_small else NOT_FOUND
    return UpperLimit(effect.name, strength.name, strength.unit, reason, np.nan, interval.high, more, remark)
