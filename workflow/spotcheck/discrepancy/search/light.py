"""Which light: the declared shape, where a few effects beside it explain the frames, or else one that is learned.

Where the declared shape is right, effects of its own kind (an ellipse, a halo) and weak ones can be told; beside a
learned shape only what no static shape could be.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy import criteria
from spotcheck.discrepancy.evidence.patterns import gathered
from spotcheck.discrepancy.evidence.pixels import Ready
from spotcheck.discrepancy.nuisance.fit import Fitted, fit, free_of
from spotcheck.discrepancy.nuisance.numbers import fit_numbers
from spotcheck.discrepancy.nuisance.taken import leverage
from spotcheck.discrepancy.nuisance.threads import shared
from spotcheck.discrepancy.observe.design import Design
from spotcheck.discrepancy.observe.pixels import Expectation, Frame, Model, Numbers, deviance_of, scatters
from spotcheck.discrepancy.search.candidates import at_frames, nth, some_of, striped, tied_of
from spotcheck.discrepancy.search.forward import (
    MOST_STEPS,
    Grown,
    Outcome,
    State,
    best_of,
    dark_of,
    grow,
    outcome_of,
    quiet,
)
from spotcheck.model import light_shape
from spotcheck.model.effect import Context, Effect, Present

# Distance of the nodes of a learned shape [σ]: twice as coarse, splines leave effects that are not there. Of one frame
# alone a shape so fine would be its stripes and grains; stripes are looked for beside one that is coarser still.
STEP, STEP_OF_ONE, COARSE = 0.12, 0.3, 0.6
# How far the nodes reach [σ], where a Gaussian has 2e-6 of its peak, and the price of second differences [1/peak²].
REACH, PENALTY = 5.1, 1.0
# The search begins with whole sites of so many frames [frames], where these are no more than that part of all; and an
# effect that is named by them must gain so much at least: what gains less, all frames tell better.
FEW, PLAIN, GAIN_OF_SOME = 24, 0.5, 400.0
# Steps that tell a shape which is to foretell other sites: beside what is fitted it is linear.
TOLD = 2
# Contrasts among which that of a nameless field begins.
CONTRASTS = (0.01, 0.03, 0.1, 0.3, 0.9)
# An effect that is to stand in the place of a shape must gain this part of what the shape would.
PART = 0.5


class Lit(NamedTuple):
    """What was found under the light that is right, the same without what was found, and whether that light is a shape
    that is learned."""

    grown: Grown
    before: Fitted
    learned: bool


def find(frames: Sequence[Frame], design: Design, model: Model, effects: Sequence[Effect], context: Context) -> Outcome:
    """The search under the light that is right, from a model that declares its shape.

    Some sites tell what is plain, and which light it is; what is faint all of the frames tell.
    """
    few = some_sites(design)
    if len(few) > PLAIN * len(frames):
        lit = searched(frames, design, with_fields(frames, design, model, effects, context), effects, context)
    else:
        some, own = [frames[k] for k in few], model.take(few)
        own = with_fields(some, design.take(few), own, effects, context)
        lit = searched(some, design.take(few), own, effects, context, GAIN_OF_SOME)
        lit = completed(frames, design, model, lit, few, effects, context)
    return outcome_of(lit.grown, lit.before, design, effects, context)


def searched(
    frames: Sequence[Frame],
    design: Design,
    model: Model,
    effects: Sequence[Effect],
    context: Context,
    gain: float = 0.0,
) -> Lit:
    """The search under the declared light and, where effects that gain so much do not explain the frames, beside a
    learned shape."""
    # Under a level or a noise that is far off no shape is found.
    dark = dark_of(frames, model, level=True)
    if len(frames) == 1:
        lit = of_one(frames, design, dark, effects, context)
    else:
        lit = State(tuple(frames), with_shape(frames, dark, context))
    lit, _ = quiet(lit, level=True)
    learned = lit.fitted
    plainly = learned.model._replace(baseline=model.baseline, present=model.present)
    declared = fit(frames, plainly, PENALTY, free_of(plainly, context), MOST_STEPS)
    plain = len(model.present)

    last: list[tuple[Fitted, float]] = []

    def beside(state: State) -> Fitted:
        own = state.fitted.model
        return learned if len(own.present) == plain else with_shape(state.frames, own, context)

    def more(state: State) -> float:
        if not last or last[0][0] is not state.fitted:
            last[:] = [(state.fitted, asked(state, design, (lambda own: learned, beside), context))]
        return last[0][1]

    grown = grow(State(tuple(frames), declared), design, effects, context, lambda own: PART * more(own), gain)
    if grown.finished and more(grown.state) <= 0:
        return Lit(grown, declared, learned=False)
    # Of one frame a shape can be nearly all that the declared light asked for.
    state = lit
    if len(frames) > 1:
        state = without_tied(State(grown.state.frames, beside(grown.state)), design, context)
    return Lit(grow(state, design, effects, context, gain=gain), learned, learned=True)


def of_one(frames: Sequence[Frame], design: Design, model: Model, effects: Sequence[Effect], context: Context) -> State:
    """One frame alone beside a shape that is learned, and stripes, where there are any: a shape that may be as fine as
    they are is fitted beside them."""
    coarse, _ = quiet(State(tuple(frames), with_shape(frames, model, step=COARSE)), level=True)
    sites, _ = gathered(coarse.frames, design, Ready(coarse.frames, coarse.fitted, []))
    found = striped(coarse.frames, design, coarse.fitted.model.numbers, sites, effects, context)
    best = best_of(coarse, list(found), context)
    now = best[0] if best else coarse
    # The coarse shape leaves much that passes for noise.
    begun = now.fitted.model._replace(sensor=model.sensor, sheet=model.sheet)
    return now._replace(fitted=with_shape(now.frames, begun, context))


def completed(
    frames: Sequence[Frame],
    design: Design,
    model: Model,
    lit: Lit,
    few: np.ndarray,
    effects: Sequence[Effect],
    context: Context,
) -> Lit:
    """The search on all frames, from what some of them told."""
    told = lit.grown.state.fitted.model
    began = numbers_from(model, told, few, design)
    start = fit(frames, told._replace(numbers=began), PENALTY, free_of(told, context), MOST_STEPS)
    state = State(tuple(frames), start)
    if not lit.learned:
        if asked(state, design, (lambda own: with_shape(own.frames, own.fitted.model, context),), context) <= 0:
            return Lit(grow(state, design, effects, context), start, learned=False)
        state = without_tied(State(state.frames, with_shape(frames, start.model, context)), design, context)
    return Lit(grow(state, design, effects, context), start, learned=True)


def numbers_from(model: Model, told: Model, few: np.ndarray, design: Design) -> Numbers:
    """Numbers of all frames to begin with, moved as those of some frames were, each as others of its condition."""
    moved = [after - before[few] for before, after in zip(model.numbers, told.numbers, strict=True)]
    out = [np.array(own) for own in model.numbers]
    for k in range(len(design.site)):
        like = design.condition[few] == design.condition[k]
        for own, change in zip(out, moved, strict=True):
            own[k] += float(np.median(change[like] if like.any() else change))
    for own, value in zip(out, told.numbers, strict=True):
        own[few] = value
    return Numbers(*out)


def some_sites(design: Design) -> np.ndarray:
    """Frames of some sites, in turn of each condition that sites begin with: as many as tell what is plain."""
    sites, first = np.unique(design.site, return_index=True)
    order = np.argsort(nth(design.condition[first]), kind="stable")
    size = np.cumsum([np.count_nonzero(design.site == site) for site in sites[order]])
    kept = sites[order][: int(np.searchsorted(size, FEW)) + 1]
    return np.flatnonzero(np.isin(design.site, kept))


def with_fields(
    frames: Sequence[Frame], design: Design, model: Model, effects: Sequence[Effect], context: Context
) -> Model:
    """A model with every field that each site has anew: as long as it is not tested it stands for whatever the model
    misses in proportion to the light. Without it one effect of a few per cent makes all others look surer than they
    are. At a single site a field is whatever the light's shape may be."""
    if len(np.unique(design.site)) < 2:
        return model
    for effect in effects:
        if scatters(effect, "field") and effect.scatter is not None and effect.scatter.shared == "site":
            rest = effect.starts(context)[0][1:]
            tried = [model.with_effect(Present(effect, effect.forms[0], (c, *rest))) for c in CONTRASTS]
            model = min(tried, key=lambda own: deviance(frames, own))
    return model


def without_tied(now: State, design: Design, context: Context) -> State:
    """A state beside a learned shape without the effects that such a shape can be: what else is as strong as a shape
    stays, until it is tested."""
    few, model = some_of(design), now.fitted.model
    if not model.present:
        return now
    small = at_frames(now.frames, now.fitted._replace(free=()), few)
    bare = small._replace(model=small.model._replace(present=()))
    tied = {own.effect.name for own in tied_of([now.frames[k] for k in few], bare, model.present)}
    kept = tuple(own for own in model.present if own.effect.name not in tied)
    if len(kept) == len(model.present):
        return now
    return now._replace(fitted=with_shape(now.frames, model._replace(present=kept), context))


def with_shape(
    frames: Sequence[Frame],
    model: Model,
    context: Context | None = None,
    *,
    step: float | None = None,
    steps: int = MOST_STEPS,
) -> Fitted:
    """A fit of a model beside a shape that is learned."""
    shape = light_shape.empty(step or (STEP if len(frames) > 1 else STEP_OF_ONE), REACH)
    model = model._replace(baseline=model.baseline._replace(learned=shape))
    if context is None:
        return fit(frames, model, PENALTY, steps=steps)
    if any(own.effect.scatter is None for own in model.present):
        # From an empty shape effects would take what is the shape's.
        model = fit(frames, model, PENALTY, steps=steps).model
    return fit(frames, model, PENALTY, free_of(model, context), steps=steps)


def asked(declared: State, design: Design, shapes: Sequence[Callable[[State], Fitted]], context: Context) -> float:
    """What −2 ln L gains by a learned shape beyond what it would by noise: less than 0 where none is asked for.
    `shapes`: fits with one, the next asked where the one before does not gain."""
    fields = [own for own in declared.fitted.model.present if scatters(own.effect, "field")]
    if len(np.unique(design.site)) > 1 and any(own.effect.excess(own.values[0], context) >= 1 for own in fields):
        # What pixels share is taken up by a shape as well: it must foretell other sites.
        return 2 * foretold(declared, design)
    more = 0.0
    for shape in shapes:
        learned = shape(declared)
        freedom = freedom_of(declared.frames, learned)
        more = float(declared.fitted.total - learned.total - freedom - criteria.SURE.value * np.sqrt(2 * freedom))
        if more > 0:
            break
    return more


def foretold(declared: State, design: Design) -> float:
    """What −2 ln L of every other site gains by a shape that is learned from the rest."""
    model = declared.fitted.model
    own = np.isin(design.site, np.unique(design.site)[::2])
    told, others = np.flatnonzero(own), np.flatnonzero(~own)
    some = with_shape([declared.frames[k] for k in told], model.take(told), steps=TOLD)
    frames, plain = [declared.frames[k] for k in others], model.take(others)
    shaped = plain._replace(baseline=model.baseline._replace(learned=some.model.baseline.learned))
    # The plain numbers are fitted as they are; those of the other half's shape may lie off by what all share.
    return deviance(frames, plain) - deviance(frames, fit_numbers(frames, shaped).model)


def deviance(frames: Sequence[Frame], model: Model) -> float:
    """−2 ln L of frames but for constants."""
    ready = Expectation(frames, model)
    return sum(deviance_of(frame, ready.of(frame, k)) for k, frame in enumerate(frames))


def freedom_of(frames: Sequence[Frame], fitted: Fitted) -> float:
    """Degrees of freedom of a learned shape: the trace of its projection."""
    ready = Ready(frames, fitted, [])

    def part(which: np.ndarray) -> list[np.ndarray]:
        total = 0.0
        for k in which:
            seen, tells = ready.of(frames[k], k)
            total += float(leverage(ready.variance, float(ready.peaks[k]), seen, tells).sum())
        return [np.array(total)]

    return float(shared(part, len(frames))[0])
