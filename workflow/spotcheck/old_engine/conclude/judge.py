"""The whole way of a set of spot frames: from shots to all that is concluded."""

from collections.abc import Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from spotcheck import progress
from spotcheck.old_engine import criteria
from spotcheck.old_engine.conclude.advise import advise
from spotcheck.old_engine.conclude.detect import looked_at
from spotcheck.old_engine.conclude.judgement import NOTHING, Fits, Judgement, Light, Shift, untested
from spotcheck.old_engine.conclude.light import Seen, gauge_of, in_gauge, light_of, present_of, seen_of
from spotcheck.old_engine.conclude.limits import limits_of
from spotcheck.old_engine.conclude.places import places_of
from spotcheck.old_engine.conclude.unexplained import unexplained
from spotcheck.old_engine.conclude.unseen import Unseen, unseen
from spotcheck.old_engine.evidence.influence import numbers_of
from spotcheck.old_engine.evidence.laws import Laws, laws_of
from spotcheck.old_engine.model.chain import Law, spot_state
from spotcheck.old_engine.model.effect import NEEDS, Context, Effect, Place
from spotcheck.old_engine.nuisance.darkness import offset_of
from spotcheck.old_engine.nuisance.fit import Fitted, fit
from spotcheck.old_engine.nuisance.numbers import fit_numbers
from spotcheck.old_engine.nuisance.parameters import free_of_sheet
from spotcheck.old_engine.nuisance.sheet import Against, against_dark, against_sheet, fit_sheet
from spotcheck.old_engine.observe.design import Design, missing, view_of
from spotcheck.old_engine.observe.frames import Observed, Setting, observed
from spotcheck.old_engine.observe.pixels import Model, Numbers, Sheet
from spotcheck.old_engine.observe.shots import Shot, parted
from spotcheck.old_engine.search.forward import Outcome
from spotcheck.old_engine.search.laws import search_laws
from spotcheck.old_engine.search.light import PENALTY, find


# Frames are shared out among threads already: with threads of its own beneath them linear algebra is slower many times.
@threadpool_limits.wrap(limits=1)
def judge(shots: Sequence[Shot], setting: Setting, effects: Sequence[Effect]) -> Judgement:
    """Everything that is concluded of some frames; those that are kept unseen are opened last."""
    if not shots:
        return untested("there is no usable spot frame")
    progress.step("fit of the declared model", 0.0, 0.05)
    own, out = parted(shots)
    searched, kept = [shots[k] for k in own], [shots[k] for k in out]
    seen = observed(searched, setting)
    if isinstance(seen, str):
        return untested(seen)
    lawful = setting.baseline.photon_budget != "free"
    why = {e.name: missing(e, seen.design, law=lawful) for e in effects if e.place is not Place.SHAPE}
    usable = [e for e in effects if why.get(e.name) == ""]
    frames, design, context = seen.frames, seen.design, seen.context
    model = Model(setting.baseline, setting.sensor, (), seen.numbers, Sheet(setting.sensor, setting.stderr))
    # The sheet is declared with its errors.
    declared = fit(frames, model, PENALTY)
    progress.step("search for effects", 0.05, 0.85)
    outcome = find(frames, design, model, usable, context)
    progress.step("laws of exposure, angle and order", 0.85, 0.88)
    laws = search_laws(outcome.frames, design, outcome.after, setting.baseline, context.crop_px, usable, context)
    progress.step("unseen frames", 0.88, 0.92)
    unseen_frames = observed(kept, setting) if kept else None
    unseen_frames = None if isinstance(unseen_frames, str) else unseen_frames
    compared = _compared(unseen_frames, seen, declared.model, outcome)
    every = {one.own.effect.name: one for one in (*outcome.found, *laws.found)}
    beyond = tuple(name for name, gain in compared.gains.items() if name in every and gain <= 0)
    progress.step("what is left", 0.92, 1.0)
    at_first, detection = looked_at(frames, declared.model if any(setting.stderr) else model, design)
    at_last, rest = looked_at(outcome.frames, outcome.after, design)
    within = seen_of(outcome.frames, outcome.after.model)
    lights = lights_of(outcome.after, within, effects, context)
    wide = float(np.exp(np.mean([np.log(gauge_of(outcome.after.model, own, k).wide) for k, own in enumerate(within)]
                                or [0.0])))  # fmt: skip
    fits = _fits(searched, kept, seen, unseen_frames, declared.model, outcome, laws.told, within, wide)
    return Judgement(
        why_not="",
        detection=detection,
        found=tuple(sorted(every.values(), key=lambda one: -compared.gap.by_effect.get(one.own.effect.name, 0.0))),
        beyond=beyond,
        light=max(lights, key=lambda own: own.power, default=None),
        lights=lights,
        sheet=tuple(own for own in sheet_of(outcome) if own.name in setting.beforehand),
        unexplained=unexplained(at_last),
        gap=compared.gap,
        shift=_shift(declared, laws.told, seen, setting, wide) if lawful else NOTHING,
        limits=limits_of(outcome, laws.told, design, [e for e in usable if e.name not in every], context),
        where=places_of(detection.parts),
        off=unexplained(at_first).size,
        rest=rest,
        errors=errors_of(outcome) | laws.errors,
        not_assessed=tuple((name, NEEDS[need]) for name, need in why.items() if need),
        black_level_dn=setting.sensor.black_level_dn + offset_of(frames[0].view, outcome.after.model.present),
        advice=advise(outcome, fits.law, design, context),
        fits=fits,
    )


def lights_of(fitted: Fitted, within: Sequence[Seen], effects: Sequence[Effect], context: Context) -> tuple[Light, ...]:
    """The learned lights, where the shape of one at least is told, and its power more than an effect calls nothing. A
    shape that has more than all light elsewhere is no light's, and tells nothing."""
    lights = tuple(light_of(fitted, own, k) for k, own in enumerate(within))
    if any(light.power > 1 for light in lights):
        return ()
    for light in lights:
        own, told = present_of(light, effects), light.power > criteria.STATED.value * light.error
        if told and own is not None and own.effect.excess(light.power, context) >= 1:
            return lights
    return ()


def _compared(kept: Observed | None, seen: Observed, before: Model, outcome: Outcome) -> Unseen:
    """The gap on frames that were kept unseen; where there are none, on those that were searched."""
    if kept is None:
        numbers = outcome.after.model.numbers
        return unseen(outcome.frames, seen.design, numbers, before, outcome.after, "the frames themselves")
    after = outcome.after._replace(model=_for(kept, seen, outcome.after.model))
    return unseen(kept.frames, kept.design, kept.numbers, before, after, "unseen repeats")


def _for(kept: Observed, seen: Observed, model: Model) -> Model:
    """A model of frames that were seen for others, each under the light of its pose."""
    if model.lights is None:
        return model
    light = dict(zip(seen.design.pose.tolist(), model.lights.which.tolist(), strict=True))
    # A pose that no searched frame had has no light of its own.
    which = np.array([light.get(pose, 0) for pose in kept.design.pose.tolist()])
    return model._replace(lights=model.lights._replace(which=which))


def _fits(
    searched: Sequence[Shot],
    kept: Sequence[Shot],
    seen: Observed,
    unseen_frames: Observed | None,
    before: Model,
    outcome: Outcome,
    laws: Laws,
    within: Sequence[Seen],
    wide: float,
) -> Fits:
    """The fits as pictures and the extended model take them."""
    after = outcome.after.model
    after = after if after.lights is None else in_gauge(after, within)
    unseen_numbers = Numbers(*(np.zeros(0) for _ in Numbers._fields))
    if unseen_frames is not None:
        own = _for(unseen_frames, seen, after)._replace(numbers=unseen_frames.numbers)
        unseen_numbers = fit_numbers(unseen_frames.frames, own).model.numbers
    shots = (*searched, *(kept if unseen_frames is not None else ()))
    law = _law(after, laws, seen.design, wide)
    return Fits(tuple(shots), outcome.frames, seen.design, before, after, unseen_numbers, law)


def _law(after: Model, laws: Laws, design: Design, wide: float) -> Law | None:
    """The law that the frames' numbers follow, in the gauge of the light's shape, which is `wide` [σ]."""
    if laws.base is None:
        return None
    own, laser = laws.base.law, after.baseline.laser_px
    law = Law(wide * own.p1, wide * (laser + own.p2) - laser, 1.0)
    peak, _ = spot_state(view_of(design), after.baseline, law, laws.base.present)
    return law._replace(peak=float(np.exp(np.mean(after.numbers.log_peak - np.log(np.ravel(peak))))))


def sheet_of(outcome: Outcome) -> tuple[Against, ...]:
    """By how much frames move the numbers of the sheet: by a fit, or by dark pixels where no effect is what these
    tell."""
    places = {own.own.effect.place for own in outcome.found}
    told = () if Place.NOISE in places else against_dark(outcome.frames, outcome.after.model)
    moved = any(own.own.effect.moves_level(own.own.form) for own in outcome.found)
    found = against_sheet(fit_sheet(outcome.frames, outcome.after)) if free_of_sheet(outcome.after.model) else ()
    return (*found, *(own for own in told if not (moved and own.name == "black_level_dn")))


def errors_of(outcome: Outcome) -> dict[str, tuple[float, ...]]:
    """Standard errors of the parameters of a fit's effects, NaN where one is not fitted; of a strength that dark pixels
    or a code tell, theirs."""
    fitted = outcome.after
    errors = np.sqrt(np.diag(fitted.covariance)[len(fitted.schur.left) - len(fitted.free) :])
    out = {own.effect.name: [np.nan] * len(own.values) for own in fitted.model.present}
    for free, error in zip(fitted.free, errors, strict=True):
        if free.effect >= 0:
            out[fitted.model.present[free.effect].effect.name][free.parameter] = float(error)
    for found in outcome.found:
        name = found.own.effect.name
        if name in out:
            out[name] = [found.holding.wider * error for error in out[name]]
            out[name][0] = float(np.fmin(out[name][0], found.holding.error))
    return {name: tuple(own) for name, own in out.items()}


def _shift(declared: Fitted, after: Laws, seen: Observed, setting: Setting, wide: float) -> Shift:
    """p1 and p2 under the declared shape, and beside all that was found, in the gauge of a shape that is `wide` [σ];
    nothing for one exposure, which tells neither."""
    if seen.design.exposures.size < 2:
        return NOTHING
    numbers = numbers_of(declared)
    before = laws_of(numbers, seen.design, setting.baseline, setting.sensor, seen.context.crop_px, effects=())
    if before.base is None or after.base is None:
        return NOTHING
    first, last, laser = before.base.law, after.base.law, setting.baseline.laser_px
    moved = (wide * last.p1, wide * (laser + last.p2) - laser)
    p1, p2 = after.base.law_errors
    return Shift((first.p1, first.p2), moved, (wide * p1, wide * p2))
