"""Which light: the declared shape, where a few effects beside it explain the frames, or else one that is learned.

Where the declared shape is right, effects of its own kind (an ellipse, a halo) and weak ones can be told; beside a
learned shape only what no static shape could be.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck import progress
from spotcheck.old_engine import criteria
from spotcheck.old_engine.evidence.patterns import gathered
from spotcheck.old_engine.evidence.pixels import Ready
from spotcheck.old_engine.evidence.stripes import with_waves
from spotcheck.old_engine.model import light_shape
from spotcheck.old_engine.model.effect import Context, Effect, Present
from spotcheck.old_engine.nuisance.fit import Fitted, fit
from spotcheck.old_engine.nuisance.numbers import fit_numbers
from spotcheck.old_engine.nuisance.parameters import free_of
from spotcheck.old_engine.nuisance.taken import leverage
from spotcheck.old_engine.nuisance.threads import shared
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Expectation, Frame, Lights, Model, Numbers, deviance_of, scatters
from spotcheck.old_engine.search.candidates import at_frames, nth, scores, some_of, striped, tied_of
from spotcheck.old_engine.search.forward import (
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
    """What was found under the light that is right, the same without what was found, and which frames share a learned
    light [frame] (None: the declared one stands)."""

    grown: Grown
    before: Fitted
    share: np.ndarray | None


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


def shares_of(design: Design) -> list[np.ndarray]:
    """Which frames may share a light that is learned [frame], the simplest first: all of them, or those of one pose."""
    pose = np.unique(design.pose, return_inverse=True)[1]
    return [np.zeros(len(pose), int), *([pose] if pose.any() else [])]


def searched(
    frames: Sequence[Frame],
    design: Design,
    model: Model,
    effects: Sequence[Effect],
    context: Context,
    gain: float = 0.0,
) -> Lit:
    """The search under the declared light and, where effects that gain so much do not explain the frames, beside a
    shape that is learned: one for all frames, or where that is not enough one for each pose."""
    # Under a level or a noise that is far off no shape is found.
    dark, shares = dark_of(frames, model, level=True), shares_of(design)
    first = begun(frames, design, dark, shares[0], effects, context)
    plainly = first.fitted.model._replace(lights=None, present=model.present)
    state = State(tuple(frames), fit(frames, plainly, PENALTY, free_of(plainly, context), MOST_STEPS))
    share: np.ndarray | None = None
    for later in (shares, shares[1:], []):
        before, more = state.fitted, _More(later, design, context, first if share is None else None)
        grown = grow(state, design, effects, context, more.part, gain)
        if not later or (grown.finished and more(grown.state) <= 0):
            break
        share, now = later[0], grown.state
        if share is shares[0] and (lonely(share) or len(now.fitted.model.present) == len(model.present)):
            state = first
        elif lonely(share):
            # Of one frame a shape can be nearly all that another light asked for.
            state = begun(frames, design, dark, share, effects, context)
        else:
            state = State(now.frames, with_shape(now.frames, now.fitted.model, context, share=share))
        state = state if lonely(share) else without_tied(state, design, context)
    return Lit(grown, before, share)


class _More:
    """What −2 ln L of a state gains by a light that is learned and shared as `shares` say, the first that gains; kept
    from call to call for the state that was asked last. `first`: the fit of a light common to all where there is no
    effect more than it has."""

    def __init__(self, shares: Sequence[np.ndarray], design: Design, context: Context, first: State | None):
        self.shares, self.design, self.context, self.first = shares, design, context, first
        self.known: list[float] = []
        self.last: Fitted | None = None

    def _of(self, now: State, ways: int) -> float:
        """The first gain of so many ways to share."""
        if self.last is not now.fitted:
            self.last, self.known = now.fitted, []
        for k, share in enumerate(self.shares[:ways]):
            if k == len(self.known):
                self.known.append(asked(now, self.design, share, self.context, self.first))
            if self.known[k] > 0:
                return self.known[k]
        return self.known[-1] if self.known else 0.0

    def __call__(self, now: State) -> float:
        return self._of(now, len(self.shares))

    def part(self, now: State) -> float:
        """What an effect must gain that is to stand in the place of the simplest such light."""
        return PART * self._of(now, 1)


def lonely(share: np.ndarray) -> bool:
    """Whether each frame would have a light of its own."""
    return len(np.unique(share)) == len(share)


def begun(
    frames: Sequence[Frame],
    design: Design,
    model: Model,
    share: np.ndarray,
    effects: Sequence[Effect],
    context: Context,
) -> State:
    """A state beside a light that is learned, under the noise and the level of its dark pixels. Where each frame has a
    light of its own, stripes come first: a shape that may be as fine as they are is fitted beside them."""
    progress.nearer("shape of the light")
    if not lonely(share):
        return quiet(State(tuple(frames), with_shape(frames, model, context, share=share)), level=True)[0]
    coarse, _ = quiet(State(tuple(frames), with_shape(frames, model, step=COARSE, share=share)), level=True)
    sites, _ = gathered(coarse.frames, design, Ready(coarse.frames, coarse.fitted, []))
    found = striped(coarse.frames, design, coarse.fitted.model.numbers, sites, effects, context)
    best = best_of(coarse, list(found), context)
    now = best[0] if best else coarse
    # The coarse shape leaves much that passes for noise.
    fresh = now.fitted.model._replace(sensor=model.sensor, sheet=model.sheet)
    return quiet(now._replace(fitted=with_shape(now.frames, fresh, context, share=share)), level=True)[0]


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
    told, shares = lit.grown.state.fitted.model, shares_of(design)
    lights = None if lit.share is None or told.lights is None else spread_over(told.lights, few, design)
    began = told._replace(numbers=numbers_from(model, told, few, design), lights=lights)
    # Phases of stripes are no part of the model.
    frames = with_waves(frames, design, began)
    start = fit(frames, began, PENALTY, free_of(began, context), MOST_STEPS)
    state, share = State(tuple(frames), start), None if lights is None else lights.which
    # Whether poses differ some sites tell; a shape for all may be too faint for these.
    if lights is None and asked(state, design, shares[0], context) > 0:
        share = shares[0]
        state = State(state.frames, with_shape(frames, start.model, context, share=share))
        state = without_tied(state, design, context)
    return Lit(grow(state, design, effects, context), start, share)


def spread_over(told: Lights, few: np.ndarray, design: Design) -> Lights:
    """Lights of some frames for all of them; a pose of which there was none begins as all others on average."""
    if not told.which.any():
        return told._replace(which=np.zeros(len(design.pose), int))
    poses, which = np.unique(design.pose, return_inverse=True)
    known = {str(design.pose[k]): int(light) for k, light in zip(few, told.which, strict=True)}
    shapes, levels = (
        np.array([own[known[str(pose)]] if str(pose) in known else own.mean(axis=0) for pose in poses])
        for own in (told.coefficients, told.level)
    )
    return told._replace(coefficients=shapes, which=which, level=levels)


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
    are. Where each pose has a single site a field is whatever the light's shape may be."""
    if len(np.unique(design.site)) == len(np.unique(design.pose)):
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
    some = [now.frames[k] for k in few]
    tied = {own.effect.name for own in tied_of(some, bare, model.present, scores(some, bare, model.present))}
    kept = tuple(own for own in model.present if own.effect.name not in tied)
    if len(kept) == len(model.present):
        return now
    return now._replace(fitted=with_shape(now.frames, model._replace(present=kept), context))


def with_shape(
    frames: Sequence[Frame],
    model: Model,
    context: Context | None = None,
    *,
    share: np.ndarray | None = None,
    step: float | None = None,
    steps: int = MOST_STEPS,
) -> Fitted:
    """A fit of a model beside a shape that is learned, for all frames or as they `share` it [frame]; from a shape of
    its own, where it has one that is as fine."""
    share = np.zeros(len(frames), int) if share is None else share
    own = step or (STEP_OF_ONE if lonely(share) else STEP)
    lights, count = model.lights, int(share.max()) + 1
    if lights is not None and lights.step == own and len(lights.coefficients) == 1:
        level = np.repeat(lights.level, count)
        model = model._replace(lights=Lights(own, np.repeat(lights.coefficients, count, axis=0), share, level))
    else:
        empty = light_shape.empty(own, REACH).coefficients
        level = np.zeros(count) if lights is None or len(lights.level) != count else lights.level
        model = model._replace(lights=Lights(own, np.zeros((count, *empty.shape)), share, level))
        if context is not None and any(own.effect.scatter is None for own in model.present):
            # From an empty shape effects would take what is the shape's.
            model = fit(frames, model, PENALTY, steps=steps).model
    free = () if context is None else free_of(model, context)
    return fit(frames, model, PENALTY, free, steps=steps)


def asked(now: State, design: Design, share: np.ndarray, context: Context, first: State | None = None) -> float:
    """What −2 ln L gains by a learned light beyond what it would by noise; less than 0 where it is not asked for.
    `first`: a state with a light for all, where it has the effects of this one."""
    fields = [own for own in now.fitted.model.present if scatters(own.effect, "field")]
    # What pixels share is taken up by a shape as well: it must foretell other sites.
    strong = any(own.effect.excess(own.values[0], context) >= 1 for own in fields)
    if (strong and len(np.unique(design.site)) > 1) or (share.any() and not lonely(share)):
        return 2 * foretold(now, design, share)
    same = first is not None and len(first.fitted.model.present) == len(now.fitted.model.present)
    known = first.fitted if first is not None and same and not share.any() else None
    learned = known or with_shape(now.frames, now.fitted.model, context, share=share)
    freedom = freedom_of(now.frames, learned) - freedom_of(now.frames, now.fitted)
    return float(now.fitted.total - learned.total - freedom - criteria.SURE.value * np.sqrt(2 * max(freedom, 1)))


def foretold(now: State, design: Design, share: np.ndarray) -> float:
    """What −2 ln L of every other site gains by a light that is learned from the rest; less than 0 where one light has
    a single site."""
    model, own = now.fitted.model, np.zeros(len(share), bool)
    for light in np.unique(share):
        sites = np.unique(design.site[share == light])
        if len(sites) < 2:
            return -np.inf
        own |= (share == light) & np.isin(design.site, sites[::2])
    told, others = np.flatnonzero(own), np.flatnonzero(~own)
    some = with_shape([now.frames[k] for k in told], model.take(told), share=share[told], steps=TOLD).model.lights
    assert some is not None
    frames, plain = [now.frames[k] for k in others], model.take(others)
    shaped = plain._replace(lights=some._replace(which=share[others]))
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
            total += float(leverage(ready.variances[k], float(ready.peaks[k]), seen, tells).sum())
        return [np.array(total)]

    return float(shared(part, len(frames))[0])
