"""Selection of the effects of the mean image: forward by score tests and refits, backward by tests of the fits.

A drop is a decrease of −2 ln L. A free shape is a light shape that is fitted at the nodes of a grid, instead of the
declared shape of the instrument. A static shape is an effect that changes the light in the same way in every frame. The
dispersion is the variance of a score over that of independent readings: it exceeds 1 if granular light is common to
neighbouring pixels. Drops are divided by it before they are compared with thresholds. Thinned pixels are a random
subset of the pixels, on which candidates are ranked. A candidate is a `start` of an effect with the expected drop by
its score test (`score`). A refit is its fit to the thinned pixels, with the drop less a price for parameters (`value`).
A `JointFit` has the fitted `model`, its `pixels` and its `deviance`, −2 ln L.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from spotcheck.discrepancy.candidates import (
    Refit,
    least_drop_of,
    list_starts,
    price_of,
    refit_candidates,
    screen_candidates,
    screen_drawn_variants,
)
from spotcheck.discrepancy.criteria import EXPLAINED_SHARE, MOST_EFFECTS, PARAMETER_PRICE, SHAPE_SHARES, VARIANT_TIE
from spotcheck.discrepancy.evidence import (
    EffectTest,
    add_error_of_nodes,
    assess_effect,
    compare_cells,
    estimate_covariance,
    is_negligible,
    least_gain,
    square_z,
)
from spotcheck.discrepancy.frames import FrameParameters, Pixels, thin_pixels
from spotcheck.discrepancy.joint_fit import JointFit, JointModel, fit_jointly
from spotcheck.discrepancy.light_shape import (
    ShapeEvidence,
    add_fine_structure,
    fit_free_shape,
    measure_thinned_evidence,
)
from spotcheck.io import progress
from spotcheck.model.effect import Effect, EffectScales

# Effort of the fit to thinned pixels beside which candidates are ranked: Newton decrement of the effects at which it
# ends, and most iterations.
SCREEN_TOLERANCE, SCREEN_ITERATIONS = 0.1, 25
# Most refits of which a fit to all pixels is made, and most iterations of that fit.
MOST_FULL_FITS, FULL_ITERATIONS = 4, 25
# Refits that may still win on all pixels: another variant of the leading effect if its drop is at most this much
# smaller than the largest, or at most this part of it; another effect if its drop is at least the last part of the
# largest.
VARIANT_MARGIN, VARIANT_MARGIN_SHARE, RIVAL_SHARE = 50.0, 0.01, 0.9
# Parts of the least gain of an effect, and of what is demanded of it beside a free shape, that its refit must reach
# before all pixels are fitted: refits stop early.
REFIT_GAIN_SHARE, REFIT_SHARE = 0.5, 0.8

Update = Callable[[JointFit], JointFit]


@dataclass(frozen=True)
class FullFit:
    """The present model with one more effect, fitted to all pixels."""

    fit: JointFit  # the fit
    value: float  # drop over the light's dispersion, less `PARAMETER_PRICE` for each parameter of the effect
    place: int  # position of its start among all starts: of variants that tie the first one is taken
    dispersion: float  # dispersion of the effect's score


@dataclass(frozen=True)
class SelectedEffects:
    """Final model of the mean image with the tests of its effects."""

    fit: JointFit  # fit to all pixels
    covariance: np.ndarray  # of the fitted parameters of sensor and effects [free parameter, free parameter]
    tests: dict[str, EffectTest]  # test of each effect by its name
    # For each effect with rivals, by name: rivals that do as well in its place, and how much larger −2 ln L is with
    # them.
    rivals: Mapping[str, Mapping[str, float]]
    # Fit with the free shape before any effect was sought; None if the declared shape is kept.
    with_shape: JointFit | None = None


@dataclass(frozen=True)
class SelectionStep:
    """A fit of the forward selection, with one effect more than the step before it."""

    fit: JointFit  # fit to all pixels with the effects so far
    gain: float  # drop by the last effect over its dispersion; NaN if unknown
    # As in `SelectedEffects`, for the effects so far.
    rivals: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def last_effect(self) -> Effect:
        """The effect that was added last."""
        return self.fit.model.forward.effects[-1].effect


def select_effects(
    declared: JointFit,
    effects: Sequence[Effect],
    scales: EffectScales,
    update: Update = lambda fit: fit,
) -> SelectedEffects:
    """Select the effects of the mean image.

    Effects are sought beside the declared light shape first. Each must explain its share of the drop that a free shape
    would give, and beside all of them a free shape must give none. Otherwise the light does not have the declared
    shape, and the effects are sought anew beside a free shape. Static shapes are sought there as well: one whose size
    is fixed on the sensor is not the same in every frame in units of the spot's width, so that a free shape cannot
    replace it.

    Parameters
    ----------
    declared : JointFit
        Fit with the declared shape. Effects that it contains take part from the start.
    effects : sequence of Effect
        Effects of the mean image that are sought.
    scales : EffectScales
        Typical sizes of the dataset (light, widths, exposures, noise), from which effects derive starting values,
        bounds and negligible strengths.
    update : callable
        Returns a fit with the dispersion of its pixels estimated anew from its residuals; called after each effect that
        is added.

    Returns
    -------
    SelectedEffects
        The final fit to all pixels, with the tests of its effects.
    """
    evidence = measure_thinned_evidence(declared)
    path = select_forward(declared, effects, scales, update, evidence)
    if path is not None:
        selected = eliminate_backward(path, scales)
        if selected.fit is not declared:
            evidence = measure_thinned_evidence(selected.fit)
        # The drop is set to 0 if the shape differs less than `SHAPE_FLOOR` from the declared one.
        if evidence.drop == 0:
            return replace_removed(selected, path, effects, scales, update)
    free = fit_free_shape(declared)
    free = free if free.has_converged else fit_jointly(free.model, free.pixels)
    path = select_forward(free, effects, scales, update)
    assert path is not None
    last = path[-1] if path[-1].fit.has_converged else finish_step(path[-1])
    # Structure of the light between the nodes of the free shape; the same fit if the frames show none.
    fine = add_fine_structure(last.fit)
    if fine is not last.fit:
        path = [finish_step(replace(last, fit=fine, gain=np.nan))]
    selected = eliminate_backward(path, scales)
    return replace(replace_removed(selected, path, effects, scales, update), with_shape=free)


def replace_removed(
    selected: SelectedEffects,
    path: Sequence[SelectionStep],
    effects: Sequence[Effect],
    scales: EffectScales,
    update: Update,
) -> SelectedEffects:
    """Return a selection in which other effects were sought in place of those that the backward elimination removed.

    A removed effect may have won against the true one. `path` holds the steps before the elimination; other parameters
    are as in `select_effects`.
    """
    removed = set(path[-1].fit.model.effect_names) - set(selected.tests)
    if not removed:
        return selected
    others = [effect for effect in effects if effect.name not in removed]
    path_of_others = select_forward(selected.fit, others, scales, update)
    assert path_of_others is not None
    return eliminate_backward(path_of_others, scales) if len(path_of_others) > 1 else selected


def select_again(
    selected: SelectedEffects, pixels: Pixels, effects: Sequence[Effect], scales: EffectScales, update: Update
) -> SelectedEffects:
    """Return the selection on pixels with another variance or dispersion.

    The effects that are selected already are tested anew, and others are sought beside those that pass. Other
    parameters are as in `select_effects`.
    """
    start = SelectionStep(fit_jointly(selected.fit.model, pixels), np.nan)
    passed = eliminate_backward([start], scales)
    path = select_forward(passed.fit, effects, scales, update)
    assert path is not None
    if len(path) > 1:
        passed = eliminate_backward(path, scales)
    return replace(passed, with_shape=selected.with_shape)


def select_forward(
    fit: JointFit,
    effects: Sequence[Effect],
    scales: EffectScales,
    update: Update,
    shape: ShapeEvidence | None = None,
) -> list[SelectionStep] | None:
    """Return the steps of the forward selection, the first with `fit` as it is.

    `shape` is the evidence for a free shape beside `fit`. The result is None if no effect takes enough of the drop by
    that shape. With None nothing is demanded, and the result is never None. Other parameters are as in
    `select_effects`.
    """
    path = [SelectionStep(fit, np.nan)]
    for added in range(MOST_EFFECTS):
        present = path[-1].fit
        absent = [effect for effect in effects if effect.name not in present.model.effect_names]
        demand = ShapeDemand(present, added, shape)
        best = add_best_effect(present, absent, scales, demand)
        if not demand.is_met_by(best):
            return None
        if best is None:
            break
        # An effect whose strength differs between parts of the spot by more than it gains has a wrong formula.
        cells = compare_cells(best.fit, best.last_effect.name)
        if cells.q > max(best.gain, cells.limit(best.gain)):
            break
        path.append(replace(best, fit=update(best.fit), rivals={**path[-1].rivals, **best.rivals}))
    return path


class ShapeDemand:
    """Drop that the next effect beside the declared shape must give, as a share of the drop by a free shape.

    Parameters
    ----------
    present : JointFit
        Fit with the effects so far.
    added : int
        Number of effects that the selection has added.
    shape : ShapeEvidence or None
        Evidence for a free shape without added effects; None beside a free shape, where nothing is demanded.
    """

    def __init__(self, present: JointFit, added: int, shape: ShapeEvidence | None) -> None:
        self._present, self._added, self._shape = present, added, shape

    @cached_property
    def drop_of_shape(self) -> float:
        """Drop by a free shape beside the effects so far; 0 if nothing is demanded."""
        if self._shape is None:
            return 0.0
        return self._shape.drop if self._added == 0 else measure_thinned_evidence(self._present).drop

    def least_drop(self, effect: Effect) -> float:
        """Return the drop over the dispersion that an effect must give.

        A static shape must leave little for a free shape: if it does not, the declared light is not kept, and the
        explanation of the free shape names the static shape as well. An effect that acts on the noise explains nothing
        of a shape, it only makes misfit count less: it must wait until a free shape gives no drop.
        """
        if effect.acts_on_noise:
            return np.inf if self.drop_of_shape > 0 else 0.0
        share = SHAPE_SHARES[min(self._added, len(SHAPE_SHARES) - 1)]
        return (max(share, EXPLAINED_SHARE) if effect.is_static_shape else share) * self.drop_of_shape

    def is_met_by(self, best: SelectionStep | None) -> bool:
        """Return whether the next effect gives enough.

        Without a next effect (None) the demand is met, unless a free shape gives a drop and no effect was added yet.
        """
        if best is None:
            return not self.is_unmet()
        drop_of_effect = (self._present.deviance - best.fit.deviance) / self._present.pixels.dispersion
        return drop_of_effect >= self.least_drop(best.last_effect)

    def is_unmet(self) -> bool:
        """Return whether a free shape gives a drop and no effect was added yet."""
        return self._added == 0 and self.drop_of_shape > 0


def add_best_effect(
    present: JointFit, effects: Sequence[Effect], scales: EffectScales, demand: ShapeDemand
) -> SelectionStep | None:
    """Return the step with the effect that gains most, or None if none gains enough.

    Candidates are ranked by score tests, then by refits, on the thinned pixels; the best ones are fitted to all pixels.

    Parameters
    ----------
    present : JointFit
        Fit to all pixels with the effects so far.
    effects : sequence of Effect
        Effects that it does not contain.
    scales : EffectScales
        Typical sizes of the dataset.
    demand : ShapeDemand
        What the effect must give; refits far below it are not fitted to all pixels.
    """
    thin = thin_pixels(present.pixels)
    thinned = fit_jointly(present.model, thin, tolerance=SCREEN_TOLERANCE, iterations=SCREEN_ITERATIONS)
    if demand.is_unmet():
        effects = [effect for effect in effects if not effect.acts_on_noise]
    candidates = screen_candidates(thinned, list_starts(effects, scales))
    candidates += screen_drawn_variants(thinned, effects, scales)
    candidates.sort(key=lambda candidate: -candidate.score)
    refits = refit_candidates(thinned, candidates, present, scales)
    fits: dict[str, FullFit] = {}  # best fit of each effect, by name
    best = ""  # name of the best effect so far
    for refit in refits[:MOST_FULL_FITS]:
        if not may_win(refit, refits[0], best) or not is_worth_fitting(refit, present, scales, demand):
            continue
        full = fit_all_pixels(refit, thinned, present, scales)
        if full is None:
            continue
        name = refit.effect_name
        known = fits.get(name)
        is_tied = known is not None and abs(full.value - known.value) < VARIANT_TIE
        if known is None or (full.place < known.place if is_tied else full.value > known.value):
            fits[name] = full
        best = max(fits, key=lambda name: fits[name].value)
    if not best:
        return None
    best = find_special_case(best, fits, least_gain(present.model))
    # An effect that has the best one as a special case fits as well in any case: it is no rival.
    general = {effect.name for effect in effects if best in effect.special_cases}
    behind = {name: max(fits[best].value - fits[name].value, 0.0) for name in fits if name not in {best, *general}}
    rivals = {name: difference for name, difference in behind.items() if difference < VARIANT_TIE}
    gain = (present.deviance - fits[best].fit.deviance) / fits[best].dispersion
    return SelectionStep(fits[best].fit, gain, {best: rivals} if rivals else {})


def may_win(refit: Refit, leader: Refit, best: str) -> bool:
    """Return whether a refit may give more on all pixels than the best effect so far ("" for none).

    `leader` is the refit with the largest drop on the thinned pixels.
    """
    if not best:
        return True
    if refit.effect_name != best:
        return refit.value >= RIVAL_SHARE * leader.value
    margin = max(VARIANT_MARGIN, VARIANT_MARGIN_SHARE * leader.value)
    return not refit.is_at_bound and refit.value >= leader.value - margin


def is_worth_fitting(refit: Refit, present: JointFit, scales: EffectScales, demand: ShapeDemand) -> bool:
    """Return whether a refit reaches its parts of the least gain and of the demand, with a strength that matters."""
    effect = refit.model.effect_named(refit.effect_name)
    if refit.value < REFIT_GAIN_SHARE * least_drop_of(refit.candidate, present) or is_negligible(effect, scales):
        return False
    return refit.value >= REFIT_SHARE * demand.least_drop(effect.effect)


def fit_all_pixels(refit: Refit, thinned: JointFit, present: JointFit, scales: EffectScales) -> FullFit | None:
    """Return the fit of a refit's model to all pixels; None if it fails, gains too little or is negligible.

    `thinned` and `present` are fits of the model without the effect, to the thinned and to all pixels. The fit ends
    early if the least drop is out of its reach (`target` of `fit_jointly`).
    """
    candidate, dispersion = refit.candidate, present.pixels.dispersion
    start = transfer_refit(refit.model, thinned.model, present.model)
    # The least drop is that of an effect with one parameter. Values are drops less the price of all parameters.
    least_value = least_drop_of(candidate, present) - PARAMETER_PRICE
    target = present.deviance - (least_value + price_of(candidate)) * dispersion
    fit = fit_jointly(start, present.pixels, iterations=FULL_ITERATIONS, target=target)
    value = (present.deviance - fit.deviance) / dispersion - price_of(candidate)
    progress.advance("")
    applied = fit.model.effect_named(refit.effect_name)
    if not fit.has_converged or value < least_value or is_negligible(applied, scales):
        return None
    return FullFit(fit, value, candidate.place, float(present.pixels.dispersion_of(candidate.field_share)))


def find_special_case(name: str, fits: Mapping[str, FullFit], least_drop: float) -> str:
    """Return the name of a special case of an effect that fits nearly as well, else the effect's own name.

    The strength of an effect is what it has beyond its special case: it must give a drop of `least_drop` itself.
    `fits` are the best fits by the names of effects.
    """
    for other in fits[name].fit.model.effect_named(name).effect.special_cases:
        if other in fits:
            drop = (fits[other].fit.deviance - fits[name].fit.deviance) / fits[name].dispersion
            if drop < least_drop:
                return other
    return name


def transfer_refit(refit: JointModel, thinned: JointModel, present: JointModel) -> JointModel:
    """Return a start on all pixels for a model that was fitted to the thinned pixels.

    Spots and shape are those of the present model, plus what the new effect changed on the thinned pixels. The noise of
    the thinned pixels cancels in this difference.

    Parameters
    ----------
    refit : JointModel
        Model with the effect, fitted to the thinned pixels.
    thinned, present : JointModel
        Model without the effect, fitted to the thinned and to all pixels.
    """
    spots = present.spots.as_rows() + refit.spots.as_rows() - thinned.spots.as_rows()
    start = replace(refit, spots=FrameParameters(*spots))
    if refit.grid is None:
        return start
    return start.with_coefficients(present.coefficients + refit.coefficients - thinned.coefficients)


def eliminate_backward(path: Sequence[SelectionStep], scales: EffectScales) -> SelectedEffects:
    """Remove effects that fail their test, the worst first, and refit, until all pass.

    `path` holds the steps of the forward selection. If the last effect of a path fails, the step before it is taken. An
    `EffectTest` has the `gain` of an effect, its z² (`wald`), Cochran's Q (`heterogeneity`) with its `limit`, and the
    rank for removal (`badness`).
    """
    path = list(path)
    if not path[-1].fit.has_converged:
        path[-1] = finish_step(path[-1])
    rivals = path[-1].rivals
    while True:
        fit = path[-1].fit
        covariance = estimate_covariance(fit)
        names = fit.model.effect_names
        # The gain of the last effect is known from the fit without it, if that has converged.
        known = {names[-1]: path[-1].gain} if len(path) > 1 and path[-2].fit.has_converged else {}
        tests = {name: assess_effect(fit, name, covariance, scales, known.get(name)) for name in names}
        failed = {name: test.badness for name, test in tests.items() if not test.passes}
        if not failed:
            # Beside a free shape two effects may be told apart by nothing but the positions of the nodes.
            covariance = add_error_of_nodes(covariance, fit)
            tests = {name: replace(test, wald=square_z(fit.model, name, covariance)) for name, test in tests.items()}
            failed = {name: test.badness for name, test in tests.items() if not test.passes}
        if not failed:
            return SelectedEffects(fit, covariance, tests, {name: rivals[name] for name in names if name in rivals})
        worst = max(failed, key=lambda name: failed[name])
        if worst == names[-1] and len(path) > 1:
            path.pop()
        else:
            path = [SelectionStep(fit_jointly(fit.model.without_effect(worst), fit.pixels), np.nan)]


def finish_step(step: SelectionStep) -> SelectionStep:
    """Return a step with its fit continued until it converges."""
    return replace(step, fit=fit_jointly(step.fit.model, step.fit.pixels))


def withdraw_effects(selected: SelectedEffects, names: Sequence[str], scales: EffectScales) -> SelectedEffects:
    """Return the selection without the effects of some names; the remaining ones are fitted and tested anew."""
    model = selected.fit.model
    removed = [name for name in names if name in model.effect_names]
    if not removed:
        return selected
    for name in removed:
        model = model.without_effect(name)
    path = [SelectionStep(fit_jointly(model, selected.fit.pixels), np.nan)]
    return replace(eliminate_backward(path, scales), with_shape=selected.with_shape)
