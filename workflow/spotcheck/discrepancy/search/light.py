"""Which light: the declared shape, where a few effects beside it explain the frames, or else one that is learned.

Where the declared shape is right, effects of its own kind (an ellipse, a halo) and weak ones can be told; beside a
learned shape only what no static shape could be.
"""

from collections.abc import Sequence

import numpy as np

from spotcheck.discrepancy import criteria
from spotcheck.discrepancy.evidence.patterns import gathered
from spotcheck.discrepancy.evidence.pixels import Ready
from spotcheck.discrepancy.nuisance.fit import Fitted, fit, free_of, shared
from spotcheck.discrepancy.nuisance.numbers import expected_of
from spotcheck.discrepancy.nuisance.taken import leverage
from spotcheck.discrepancy.observe.design import Design
from spotcheck.discrepancy.observe.pixels import Frame, Model, deviance_of
from spotcheck.discrepancy.search.candidates import at_frames, some_of, striped, tied_of
from spotcheck.discrepancy.search.forward import MOST_STEPS, Outcome, State, best_of, dark_of, grow, outcome_of, quiet
from spotcheck.model import light_shape
from spotcheck.model.effect import Context, Effect, Place

# Distance of the nodes of a learned shape [σ]: twice as coarse, splines leave effects that are not there. Of one frame
# alone a shape so fine would be its stripes and grains; stripes are looked for beside one that is coarser still.
STEP, STEP_OF_ONE, COARSE = 0.12, 0.3, 0.6
# How far the nodes reach [σ], where a Gaussian has 2e-6 of its peak, and the price of second differences [1/peak²].
REACH, PENALTY = 5.1, 1.0
# An effect that is to stand in the place of a shape must gain this part of what the shape would.
PART = 0.5


def find(frames: Sequence[Frame], design: Design, model: Model, effects: Sequence[Effect], context: Context) -> Outcome:
    """The search under the light that is right, from a model that declares its shape."""
    # Under a level or a noise that is far off no shape is found.
    dark = dark_of(frames, model, level=True)
    lit = of_one(frames, design, dark, effects, context) if len(frames) == 1 else State(tuple(frames), with_shape(
        frames, dark))  # fmt: skip
    lit, _ = quiet(lit, level=True)
    learned = lit.fitted
    declared = fit(frames, learned.model._replace(baseline=model.baseline, present=()), PENALTY)

    def least(state: State) -> float:
        more = asked(state, design, learned)
        if more <= 0 and state.fitted.model.present:
            more = asked(state, design, with_shape(state.frames, state.fitted.model, context))
        return PART * more

    grown = grow(State(tuple(frames), declared), design, effects, context, least)
    state = grown.state
    beside = with_shape(state.frames, state.fitted.model, context)
    if grown.finished and asked(state, design, beside) <= 0:
        return outcome_of(grown, declared, design, effects, context)
    # Of one frame a shape can be nearly all that the declared light asked for.
    state = lit
    if len(frames) > 1:
        state = without_tied(State(grown.state.frames, beside), design, context)
    grown = grow(state, design, effects, context)
    return outcome_of(grown, learned, design, effects, context)


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
    frames: Sequence[Frame], model: Model, context: Context | None = None, step: float | None = None
) -> Fitted:
    """A fit of a model beside a shape that is learned."""
    shape = light_shape.empty(step or (STEP if len(frames) > 1 else STEP_OF_ONE), REACH)
    model = model._replace(baseline=model.baseline._replace(learned=shape))
    learned = fit(frames, model, PENALTY, steps=MOST_STEPS)
    if context is None or not model.present:
        return learned
    # From an empty shape effects would take what is the shape's.
    return fit(frames, learned.model, PENALTY, free_of(model, context), steps=MOST_STEPS)


def asked(declared: State, design: Design, learned: Fitted) -> float:
    """What −2 ln L gains by a learned shape beyond what it would by noise: less than 0 where none is asked for."""
    freedom = freedom_of(declared.frames, learned)
    gain = declared.fitted.total - learned.total - freedom - criteria.SURE.value * np.sqrt(2 * freedom)
    scatters = any(own.effect.place is Place.SCATTER for own in declared.fitted.model.present)
    if gain <= 0 or not scatters or len(np.unique(design.site)) < 2:
        return float(gain)
    # What pixels share is taken up by a shape as well: it must foretell other sites.
    return min(float(gain), foretold(declared, design))


def foretold(declared: State, design: Design) -> float:
    """What −2 ln L of every other site gains by a shape that is learned from the rest."""
    model = declared.fitted.model
    own = np.isin(design.site, np.unique(design.site)[::2])
    told, others = np.flatnonzero(own), np.flatnonzero(~own)
    learned = with_shape([declared.frames[k] for k in told], model.take(told)).model.baseline.learned
    frames, plain = [declared.frames[k] for k in others], model.take(others)
    shaped = plain._replace(baseline=model.baseline._replace(learned=learned))
    return deviance(frames, plain) - deviance(frames, shaped)


def deviance(frames: Sequence[Frame], model: Model) -> float:
    """−2 ln L of frames but for constants, each with its own numbers under a shape that stands."""
    return sum(deviance_of(frame, seen) for frame, seen in zip(frames, expected_of(frames, model), strict=True))


def freedom_of(frames: Sequence[Frame], fitted: Fitted) -> float:
    """Degrees of freedom of a learned shape: the trace of its projection."""
    ready = Ready(frames, fitted, [])

    def part(which: np.ndarray) -> list[np.ndarray]:
        total = 0.0
        for k in which:
            seen, tells = ready.of(frames[k], k)
            total += float(leverage(ready.variance, float(ready.peaks[k]), seen, tells).sum())
        return [np.array(total)]

    return float(shared(part, len(frames), 2)[0])
