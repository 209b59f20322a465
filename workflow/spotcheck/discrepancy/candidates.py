"""Candidates: score tests of starting points of effects, and refits with the leading ones.

A score test estimates how much a starting point would lower −2 ln L, without a refit. Refits are made to thinned
pixels, a random subset.

A start is an effect with the parameter values from which a fit would begin; its first parameter is its strength. Its
change is what it adds to the mean [DN] and variance [DN²] of the readings, a pair of arrays. A column is the pair of
their derivatives by an unknown. A `JointFit` has the fitted `model`, its `pixels` and the normal `equations`. Nuisance
parameters are all unknowns of this fit: the four spot parameters of each frame (ln peak, ln σ, x, y), the fitted
parameters of sensor and effects, and the coefficients of a free shape. A free shape is a light shape whose values at
nodes are fitted, in place of the declared shape of the instrument. A candidate is a start with its score test. Granular
light is a random field in the light that neighbouring pixels share. It increases the variance of a score by a factor,
the dispersion. A drop is a decrease of −2 ln L.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from spotcheck.discrepancy.criteria import MIN_GAIN, PARAMETER_PRICE
from spotcheck.discrepancy.evaluation import SENSOR, differentiate_readings, evaluate, stages_of, sum_batches
from spotcheck.discrepancy.evidence import least_gain
from spotcheck.discrepancy.frames import conditions_of
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.projected_changes import SEPARABLE_SHARE, Absorbed, Projection, change_by, project_changes
from spotcheck.discrepancy.shape_grid import HALF_WIDTH
from spotcheck.discrepancy.site_draws import list_site_variants, start_draws
from spotcheck.io import progress
from spotcheck.model.effect import AppliedEffect, Effect, EffectScales, RandomStep
from spotcheck.model.stage import Stage

# Range of the multiple of a start's strength at which a fit begins. It is limited because the score test assumes that
# the change is proportional to the strength. Beside a free shape it is at most 1: the shape must change with it.
SIZES, SIZES_BESIDE_SHAPE = (0.3, 30.0), (0.3, 1.0)
# Least estimated multiple of a start's change for a clip: an effect that vanishes at an infinite strength, since it
# limits readings to a level. The multiple is about 1 if the clip is present.
LEAST_CLIP_SIZE = 0.15
# A candidate is a shape finer than the nodes of the free shape if the part of its information that nuisance parameters
# leave exceeds the part of its change that differs between frames by this factor.
UNRESOLVED = 5.0
# Leading candidates for which the share of granular light in the variance is measured.
MOST_FIELD_SHARES = 24
# Sampling of a change for `varying_share`: most frames; points along each axis, and the largest distance [σ].
MOST_COMPARED, POINTS, FARTHEST = 16, 61, 7.0
# Effort of a refit: Newton decrement of the effects at which it ends, and most iterations.
REFIT_TOLERANCE, REFIT_ITERATIONS = 0.1, 9
# Candidates whose score test is below this part of the best one are not refitted.
SCORE_SHARE = 0.05
# Most candidates that are refitted in one step of the selection, beside the declared and beside a free light shape.
MOST_REFITS, MOST_REFITS_BESIDE_SHAPE = 6, 4
# Most variants of one effect among them, and most starts of one variant; the best effect has all its variants refitted.
MOST_VARIANTS, MOST_STARTS = 2, 1
# Smallest denominator of a ratio of sums that may be 0.
TINY = 1e-300
# Stages that change only brightness and width of the spot of a frame, which its spot parameters absorb.
SPOT_STAGES = {Stage.EXPOSURE, Stage.WIDTH, Stage.BRIGHTNESS}


@dataclass(frozen=True)
class Candidate:
    """A starting point of an effect and its score test."""

    start: AppliedEffect  # where a fit of the effect begins
    score: float  # expected drop of −2 ln L beside all nuisance parameters on the tested pixels, less 1 for noise; ≥ 0
    place: int  # position among the screened starts, which orders variants that tie
    share: float  # part of the information on its strength that the nuisance parameters leave, 0 to 1
    # Part of the readings' variance that is due to granular light, averaged with the information on the strength as
    # weight. Candidates behind the first `MOST_FIELD_SHARES` have the average over the information on the light.
    field_share: float
    draws: int = 0  # number of values that the variant draws at the sites, which are fitted as well


def changes_mean_image(effect: Effect) -> bool:
    """Return whether an effect changes the mean image of a single frame in more than its brightness and width.

    Effects all of whose steps draw random numbers do not.
    """
    steps = [step for steps in effect.variants.values() for step in steps]
    is_law = all(step.stage in SPOT_STAGES for step in steps)
    return bool(steps) and not is_law and not all(isinstance(step, RandomStep) for step in steps)


def list_fixed_variants(effect: Effect) -> list[Enum]:
    """Return the variants of an effect that draw no random numbers."""
    variants = effect.variants.items()
    return [variant for variant, steps in variants if not any(isinstance(step, RandomStep) for step in steps)]


def list_starts(
    effects: Sequence[Effect],
    scales: EffectScales,
    variants_of: Callable[[Effect], Sequence[Enum]] = list_fixed_variants,
) -> list[AppliedEffect]:
    """Return the distinct starting points of variants of effects, by default of those that draw no random numbers.

    Values are clipped to the bounds; parameters that a variant does not have are NaN.
    """
    # Keys are texts, since NaN is not equal to itself.
    unique: dict[str, AppliedEffect] = {}
    for effect in effects:
        low, high = effect.bounds(scales).T
        for variant in variants_of(effect):
            has_parameter = [parameter in effect.parameters_of(variant) for parameter in effect.parameters]
            for values in effect.starts(scales):
                clipped = np.clip(np.where(has_parameter, values, np.nan), low, high)
                start = AppliedEffect(effect, variant, tuple(clipped))
                unique.setdefault(repr((effect.name, variant, start.values)), start)
    return list(unique.values())


def screen_candidates(fit: JointFit, starts: Sequence[AppliedEffect]) -> list[Candidate]:
    """Return the candidates of starting points, the most promising first.

    Starts that nuisance parameters can mimic, or whose estimated strength is impossible, are left out.

    Parameters
    ----------
    fit : JointFit
        Present model, fitted to the pixels of the test.
    starts : sequence of AppliedEffect
        Starting points of effects that the model does not contain.

    Notes
    -----
    A start changes the readings. The amplitude of this change, in units of the start, has the score U and the Fisher
    information I, both after projection on the nuisance parameters. Its estimate is U/I; −2 ln L then drops by U²/I.
    """
    changes = project_starts(fit, starts)
    candidates = []
    rows = zip(starts, changes.score, changes.information, changes.alone, strict=True)
    for place, (start, score, information, alone) in enumerate(rows):
        if not (np.isfinite(score) and information > SEPARABLE_SHARE * alone > 0):
            continue
        scaled = scale_start(start, float(score / information), fit.model)
        if scaled is not None:
            drop, share = float(max(score * score / information - 1, 0.0)), float(information / alone)
            candidates.append(Candidate(scaled, drop, place, share, fit.pixels.mean_field_share))
    candidates = select_clips(candidates, 2 * changes.score - changes.information)
    candidates.sort(key=lambda candidate: -candidate.score)
    if fit.pixels.mean_field_share == 0 or not candidates:
        return candidates
    places = [candidate.place for candidate in candidates[:MOST_FIELD_SHARES]]
    shares = measure_field_shares(fit, [starts[place] for place in places], changes.select(places).absorbed())
    leading = [replace(c, field_share=float(share)) for c, share in zip(candidates, shares, strict=False)]
    return [*leading, *candidates[len(places) :]]


def project_starts(fit: JointFit, starts: Sequence[AppliedEffect]) -> Projection:
    """Project the changes by starts on the nuisance parameters of a fit, and return their score tests."""
    return project_changes(
        fit, lambda evaluation: (change_by(fit.model, start, evaluation) for start in starts), len(starts)
    )


def screen_drawn_variants(fit: JointFit, effects: Sequence[Effect], scales: EffectScales) -> list[Candidate]:
    """Return the candidates of variants that modulate the light by a draw that is new at each site.

    The draws are estimated first, by start. By noise alone each of them raises the expected drop by about 1, which is
    subtracted. At a single site other variants have such a draw as a parameter.
    """
    sites, candidates = fit.model.design.sites, []
    if sites == 1:
        return []
    for start in list_starts(effects, scales, list_site_variants):
        design = start_draws(fit.model.with_effect(start, scales), fit.pixels).design
        with_draws = replace(fit, model=replace(fit.model, design=design))
        for candidate in screen_candidates(with_draws, [start]):
            candidates.append(replace(candidate, score=max(candidate.score - sites, 0.0), draws=sites))
    return candidates


def scale_start(start: AppliedEffect, size: float, model: JointModel) -> AppliedEffect | None:
    """Return the start with the strength at which its change would be `size` times as large.

    The multiple is limited to `SIZES`, or to `SIZES_BESIDE_SHAPE` if the model has a free shape. A clip stays as it is.
    None for a negative size of an effect that has one sign only, or a clip of at most `LEAST_CLIP_SIZE`.
    """
    effect = start.effect
    strength = effect.parameters[0].name
    value = start.parameters[strength]
    if not np.isfinite(effect.vanishes_at):
        return start if size > LEAST_CLIP_SIZE else None
    if size < 0 and value_is_one_sided(start):
        return None
    limits = SIZES if model.grid is None else SIZES_BESIDE_SHAPE
    size = float(np.sign(size) * np.clip(abs(size), *limits))
    return start.with_value(strength, effect.vanishes_at + size * (value - effect.vanishes_at))


def value_is_one_sided(start: AppliedEffect) -> bool:
    """Return whether the strength of an effect is bounded below by the value at which the effect vanishes."""
    low = start.effect.parameters[0].low
    return not callable(low) and low == start.effect.vanishes_at


def select_clips(candidates: Sequence[Candidate], drops: np.ndarray) -> list[Candidate]:
    """Return the candidates with one clip of each variant: that with the largest drop at its start.

    A clip begins at its start, unlike other effects, which begin at their estimated multiple of it. `drops` are the
    expected drops of −2 ln L at the starts, 2U − I, by the candidates' places.
    """
    best: dict[tuple, Candidate] = {}  # best clip by (effect, variant)
    for candidate in candidates:
        effect, variant = candidate.start.effect, (candidate.start.effect.name, candidate.start.variant)
        if not np.isfinite(effect.vanishes_at) and (
            variant not in best or drops[candidate.place] > drops[best[variant].place]
        ):
            best[variant] = candidate
    return [c for c in candidates if best.get((c.start.effect.name, c.start.variant), c) is c]


def measure_field_shares(fit: JointFit, starts: Sequence[AppliedEffect], absorbed: Absorbed) -> np.ndarray:
    """Return the part of the readings' variance that is due to granular light, as a mean for each start [start].

    The mean over pixels is weighted with the projected Fisher information of the start's change; `absorbed` is what
    nuisance parameters absorb of it.
    """
    model = fit.model

    def sum_batch(batch: slice) -> tuple[np.ndarray]:
        """Return the sums of field share × information, and of the information [2, start], of one batch."""
        evaluation = evaluate(model, fit.pixels, batch)
        changes = (change_by(model, start, evaluation) for start in starts)
        fitted = differentiate_readings(model, evaluation)
        sums = np.zeros((2, len(starts)))
        for k, change in enumerate(absorbed.subtract_from(changes, model, evaluation, batch, fitted)):
            information = evaluation.information_per_pixel(change)
            sums[:, k] = np.sum(evaluation.field_share * information), np.sum(information)
        return (sums,)

    ((weighted_share, information),) = sum_batches(sum_batch, fit.pixels)
    return weighted_share / np.maximum(information, TINY)


def is_unresolved_shape(fit: JointFit, candidate: Candidate) -> bool:
    """Return whether a candidate is a shape of the light that is finer than the nodes of the free shape of the fit.

    A free shape absorbs any change that is the same in all frames, in units of peak and σ, if its nodes are close
    enough. The rest is the part that differs between frames. A much larger rest means that the nodes are too coarse.
    """
    # What is drawn anew at each site is no shape.
    if fit.model.grid is None or candidate.draws or stages_of(candidate.start) & SENSOR:
        return False
    return candidate.share > UNRESOLVED * varying_share(fit, candidate.start)


def varying_share(fit: JointFit, applied: AppliedEffect) -> float:
    """Return the part (0 to 1) of an effect's change of the light that no free shape could absorb.

    The change is sampled in units of peak and σ of each frame's spot. A free shape can absorb its mean over frames
    within `HALF_WIDTH`. The part is the squared rest over the squared change. Frames are weighted with their peak, to
    which their information is proportional under photon noise.
    """
    model, pixels = fit.model, fit.pixels
    frames = np.unique(np.linspace(0, len(model.spots.x) - 1, MOST_COMPARED).astype(int))
    spots, compared = model.spots.select(frames), pixels.select(frames)
    points = np.linspace(-FARTHEST, FARTHEST, POINTS)
    sigma = np.exp(spots.log_sigma)[:, None]
    x, y = spots.x[:, None] + sigma * points, spots.y[:, None] + sigma * points
    is_inside_x, is_inside_y = (
        (point > pixel.min(axis=1, keepdims=True)) & (point < pixel.max(axis=1, keepdims=True))
        for point, pixel in ((x, compared.x[:, 0]), (y, compared.y[:, :, 0]))
    )
    # Pixels of made-up crops, which lie at the same points of every spot in units of its σ.
    sampled = replace(compared, x=x[:, None, :], y=y[:, :, None], row_share=np.ones((len(frames), POINTS, 1)))
    conditions = conditions_of(model.design.select(frames), spots, sampled)
    with_effect = replace(model.forward, effects=(*model.forward.effects, applied))
    change = (with_effect.light(conditions).total - model.forward.light(conditions).total) / conditions.peak_dn
    weight = conditions.peak_dn * is_inside_x[:, None, :] * is_inside_y[:, :, None]
    mean = np.sum(weight * change, axis=0) / np.maximum(np.sum(weight, axis=0), TINY)
    mean[np.hypot(points[:, None], points) > HALF_WIDTH] = 0.0
    return float(np.sum(weight * (change - mean) ** 2) / max(np.sum(weight * change**2), TINY))


# Refits


@dataclass(frozen=True)
class Refit:
    """The present model with a candidate, fitted to the thinned pixels."""

    candidate: Candidate  # the effect with its start
    model: JointModel  # the fitted model
    value: float  # drop over the light's dispersion, scaled to all pixels, less `PARAMETER_PRICE` for each parameter

    @property
    def effect_name(self) -> str:
        """Name of the effect."""
        return self.candidate.start.effect.name

    @property
    def is_at_bound(self) -> bool:
        """Whether a parameter of the effect is at its bound, where the variant acts much as another one does."""
        return self.model.is_at_bound(self.effect_name)


def least_drop_of(candidate: Candidate, present: JointFit) -> float:
    """Return the least drop of an effect, over the dispersion of the light.

    The least gain is a drop over the dispersion of the candidate's own score, which depends on where it changes the
    light.
    """
    pixels = present.pixels
    return least_gain(present.model) * float(pixels.dispersion_of(candidate.field_share)) / pixels.dispersion


def price_of(candidate: Candidate) -> float:
    """Return the price of a candidate's parameters in −2 ln L."""
    start = candidate.start
    return PARAMETER_PRICE * (len(start.effect.parameters_of(start.variant)) + candidate.draws)


def refit_candidates(
    thinned: JointFit, candidates: Sequence[Candidate], present: JointFit, scales: EffectScales
) -> list[Refit]:
    """Refit the leading candidates and all variants of the best effect; the best refit comes first.

    Parameters
    ----------
    thinned, present : JointFit
        Fits of the present model to the thinned and to all pixels; drops are scaled to the latter.
    candidates : sequence of Candidate
        Candidates by falling score.
    scales : EffectScales
        Typical sizes of the dataset, from which effects derive bounds.
    """
    ratio = present.pixels.count / thinned.pixels.count / present.pixels.dispersion
    refits: list[Refit] = []
    starts_of: dict[tuple, int] = {}  # number of refits by (effect, variant)
    most = MOST_REFITS if thinned.model.grid is None else MOST_REFITS_BESIDE_SHAPE
    for candidate in candidates:
        start = candidate.start
        variant = (start.effect.name, start.variant)
        other_variants = len({key for key in starts_of if key[0] == start.effect.name} - {variant})
        if candidate.score < SCORE_SHARE * candidates[0].score or len(refits) >= most:
            break
        if (
            candidate.score * ratio < least_drop_of(candidate, present)
            or starts_of.get(variant, 0) >= MOST_STARTS
            or other_variants >= MOST_VARIANTS
            or is_unresolved_shape(thinned, candidate)
        ):
            continue
        refits.append(refit_candidate(thinned, candidate, ratio, scales))
        starts_of[variant] = starts_of.get(variant, 0) + 1
    if not refits:
        return []
    best = max(refits, key=lambda refit: refit.value).effect_name
    for candidate in candidates:
        variant = (candidate.start.effect.name, candidate.start.variant)
        if variant[0] == best and variant not in starts_of and candidate.score * ratio > MIN_GAIN:
            refits.append(refit_candidate(thinned, candidate, ratio, scales))
            starts_of[variant] = 1
    return sorted(refits, key=lambda refit: -refit.value)


def refit_candidate(thinned: JointFit, candidate: Candidate, ratio: float, scales: EffectScales) -> Refit:
    """Fit the present model with a candidate to the thinned pixels; `ratio` scales drops to all pixels."""
    start = start_draws(thinned.model.with_effect(candidate.start, scales), thinned.pixels)
    fit = fit_jointly(
        start, thinned.pixels, tolerance=REFIT_TOLERANCE, iterations=REFIT_ITERATIONS, rival=thinned.deviance
    )
    drop = (thinned.deviance - fit.deviance) * ratio
    progress.advance("")
    return Refit(candidate, fit.model, drop - price_of(candidate))
