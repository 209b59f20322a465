"""The search: effects are added one by one, the likeliest refitted, until none gains more."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from spotcheck import progress
from spotcheck.old_engine import criteria
from spotcheck.old_engine.evidence.codes import gathers
from spotcheck.old_engine.evidence.noise import Noisy, level_of, levels_of, noises_of
from spotcheck.old_engine.model.effect import Context, Effect, Place, Present
from spotcheck.old_engine.model.sensor import ROUNDING_VARIANCE
from spotcheck.old_engine.nuisance.darkness import darkness, offset_of, with_levels
from spotcheck.old_engine.nuisance.fit import Fitted, fit
from spotcheck.old_engine.nuisance.parameters import free_of, of_dark
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.frames import TOP
from spotcheck.old_engine.observe.pixels import Frame, Model
from spotcheck.old_engine.search.candidates import Candidate, Tied, ranked
from spotcheck.old_engine.search.holds import Holding, groups_of, holding_of, pattern_of

# Steps of the fit of what was chosen: far from the truth brightness, width and shape are slow to part.
MOST_STEPS = 24
# A search is given up after so many effects in a row that do not hold.
ASTRAY = 2
# What a search is about: frames with a fit, or levels.
S = TypeVar("S")

# From so many squared standard errors on, what a strength gains is no longer looked at by a fit without it.
CERTAIN = 2500.0


class State(NamedTuple):
    """Frames, with the waves of stripes that were found, and a fit."""

    frames: tuple[Frame, ...]
    fitted: Fitted


class Found(NamedTuple):
    """An effect that was found, with what it gains, how it holds everywhere, and the effects that do nearly as well in
    its place: by name, what they fall behind by, and as they were fitted there, the nearest first."""

    own: Present
    gain: float
    holding: Holding
    rivals: dict[str, float]
    instead: tuple[Present, ...] = ()


class Outcome(NamedTuple):
    """Frames, the fit without and with what was found, what was found, and what is tied with the light's shape."""

    frames: tuple[Frame, ...]
    before: Fitted
    after: Fitted
    found: tuple[Found, ...]
    tied: tuple[Tied, ...]


class Rival(NamedTuple):
    """An effect as it was fitted in another's place, and what it falls behind by in −2 ln L."""

    behind: float
    own: Present


class Grown(NamedTuple):
    """A state to which effects were added; by name of each, what others fell behind by; what is tied with the light's
    shape; and whether nothing more is to be found, or the search was given up."""

    state: State
    rivals: dict[str, dict[str, Rival]]
    tied: list[Tied]
    finished: bool


def grow(
    start: State,
    design: Design,
    effects: Sequence[Effect],
    context: Context,
    least: Callable[[State], float] = lambda state: 0.0,
    gain: float = 0.0,
) -> Grown:
    """Add effects of pixels one by one that promise a `gain`; given up where none gains as much as is the `least` for a
    state, and where one after the other does not speak alike everywhere: then something else is the matter.

    Noise and level of dark pixels come first: with too little noise in the model, every pedestal and every halo looks
    like more, and beside a wrong level nothing else can be told. What moves the level is asked last.
    """
    rivals, tied = dict[str, dict[str, Rival]](), list[Tied]()
    now, told = quiet(start, level=True)
    # The brightest light lies above the level that is there, not above the stated one.
    model = now.fitted.model
    level = model.sensor.black_level_dn + offset_of(now.frames[0].view, model.present)
    shift = level - model.stated.sensor.black_level_dn
    context = context._replace(peak_dn=max(context.peak_dn - shift / TOP, 1.0))
    usable = [e for e in effects if not (told and any(e.moves_level(form) for form in e.forms))]
    sound, doubtful = now, 0
    for step in range(int(criteria.MOST.value)):
        progress.nearer(f"{len(now.fitted.model.present)} so far")
        found = ranked(now.frames, design, now.fitted, usable, context)
        wanted = least(now) if found.candidates else 0.0
        tied = tied if step else found.tied
        best = best_of(now, [own for own in found.candidates if own.promise >= max(wanted, gain)], context)
        if best is None:
            return Grown(levelled(now, effects, context), rivals, tied, wanted <= criteria.GAIN.value)
        now, near = best
        rivals[now.fitted.model.present[-1].effect.name] = near
        now, _ = quiet(now, level=told, anew=True)
        # One may wait for what is missing beside it.
        doubtful = 0 if _speaks_alike(now, design) else doubtful + 1
        sound = sound if doubtful else now
        if doubtful == ASTRAY:
            return Grown(levelled(sound, effects, context), rivals, tied, finished=False)
    return Grown(levelled(now, effects, context), rivals, tied, finished=True)


def _speaks_alike(now: State, design: Design) -> bool:
    """Whether the effect that was added last does so, as far as means tell."""
    last = len(now.fitted.model.present) - 1
    own = now.fitted.model.present[last]
    if own.effect.place is Place.SCATTER or own.form in own.effect.rounded or of_dark(now.fitted.model, own):
        return True
    return holding_of(now.frames, design, now.fitted, last).holds


def levelled(now: State, effects: Sequence[Effect], context: Context) -> State:
    """A state in which the black level is the stated one again where dark pixels tell another, and what moves it an
    effect; within the sheet's error it stays as it is."""
    model, stated = now.fitted.model, now.fitted.model.stated
    shift = model.sensor.black_level_dn - stated.sensor.black_level_dn
    dark = darkness(now.frames, model) if shift else None
    if dark is None:
        return now
    strong = (shift / np.hypot(dark.black_level_stderr, stated.stderr[2])) ** 2 >= criteria.GAIN.value
    if not strong and stated.stderr[2]:
        return now
    model = model._replace(sensor=model.sensor._replace(black_level_dn=stated.sensor.black_level_dn))
    taken = {own.effect.name for own in model.present}
    usable = [effect for effect in effects if effect.name not in taken]
    others = [model.with_effect(own) for own in levels_of(usable, shift, now.frames[0].view, context)
              if own.effect.excess(own.values[0], context) >= 1] if strong else []  # fmt: skip
    tried = [_fitted(now, own, context) for own in others or [model]]
    return min((quiet(own, level=False)[0] for own in tried), key=lambda own: own.fitted.total)


def _fitted(now: State, model: Model, context: Context) -> State:
    """A state with another model, fitted."""
    free = free_of(model, context)
    return now._replace(fitted=fit(now.frames, model, now.fitted.penalty, free, steps=MOST_STEPS))


def outcome_of(grown: Grown, before: Fitted, design: Design, effects: Sequence[Effect], context: Context) -> Outcome:
    """What holds everywhere of what was added, and effects that add noise beside what the sheet states."""
    now, kept = _tested(grown.state, design, grown.rivals, context)
    noisy = noises_of(now.frames, groups_of(design), now.fitted.model, effects, context)
    kept += [one for one in (_named(own, context) for own in noisy) if one is not None]
    return Outcome(now.frames, before, now.fitted, tuple(kept), tuple(grown.tied))


def best_of(now: State, candidates: Sequence[Candidate], context: Context) -> tuple[State, dict[str, Rival]] | None:
    """The state with the candidate that gains most when fitted, of so many that gain and matter; and by what others
    fall behind."""
    tried: list[tuple[float, str, State]] = []
    for own in candidates:
        if tried and own.promise < criteria.HOPELESS.value * max(gain for gain, _, _ in tried):
            break
        state = added(now, own, context)
        gain = now.fitted.total - state.fitted.total if own.of_means else own.promise
        present = state.fitted.model.present[-1]
        if gain >= criteria.GAIN.value and present.effect.excess(present.values[0], context) >= 1:
            tried.append((gain, present.effect.name, state))
        if len(tried) >= criteria.REFITTED.value:
            break
    if not tried:
        return None
    tried.sort(key=lambda one: -one[0])
    first = tried[0]
    near: dict[str, Rival] = {}
    for gain, name, state in tried[1:]:
        if name != first[1]:
            near.setdefault(name, Rival(first[0] - gain, state.fitted.model.present[-1]))
    return first[2], near


def added(now: State, own: Candidate, context: Context) -> State:
    """A state with an effect more, fitted from where its score points."""
    frames = own.frames or now.frames
    model = now.fitted.model.with_effect(own.own)
    return State(frames, fit(frames, model, now.fitted.penalty, free_of(model, context), near=now.fitted))


def without(now: State, k: int, context: Context) -> State:
    """A state without the effect of a number, fitted again."""
    model = now.fitted.model.without(k)
    return now._replace(fitted=fit(now.frames, model, now.fitted.penalty, free_of(model, context)))


def quiet(now: State, *, level: bool, anew: bool = False) -> tuple[State, bool]:
    """A state under the read noise of its dark pixels, and with `level` their black level, and whether these tell it;
    `anew`: fitted again in any case."""
    model, free = now.fitted.model, now.fitted.free
    found = dark_of(now.frames, model, level=level)
    moved = found.lights is not model.lights
    if anew or moved or (found.sensor, found.stated) != (model.sensor, model.stated):
        now = now._replace(fitted=fit(now.frames, found, now.fitted.penalty, free, steps=MOST_STEPS))
    return now, not found.stated.free[2]


def dark_of(frames: Sequence[Frame], model: Model, *, level: bool) -> Model:
    """A model with the read noise of dark pixels, and with `level` their black level, where they lie off by more than
    their errors. They overrule the sheet; what they do not tell is as free as the sheet's errors leave it."""
    model = with_levels(frames, model) if level else model
    dark, sensor, sheet = darkness(frames, model), model.sensor, model.stated
    if dark is None:
        return model
    # An error that is infinite is of what is not told.
    if abs(dark.read_noise_e - sensor.read_noise_e) >= dark.read_noise_stderr:
        sensor = sensor._replace(read_noise_e=dark.read_noise_e)
    if level and abs(dark.black_level_dn - sensor.black_level_dn) >= dark.black_level_stderr:
        sensor = sensor._replace(black_level_dn=dark.black_level_dn)
    free = (sheet.free[0], bool(np.isinf(dark.read_noise_stderr)), bool(np.isinf(dark.black_level_stderr)))
    return model._replace(sensor=sensor, sheet=sheet._replace(free=free))


def _named(one: Noisy, context: Context) -> Found | None:
    """An effect that dark pixels tell, where it is more than nothing and groups of frames agree about it."""
    found = _of_dark(one)
    matters = one.gain >= criteria.GAIN.value and one.own.effect.excess(one.own.values[0], context) >= 1
    return found if matters and found.holding.holds else None


def _of_dark(one: Noisy) -> Found:
    return Found(one.own, one.gain, Holding(one.q, max(one.groups, 1), one.gain, one.error), {})


def _tested(now: State, design: Design, rivals: dict[str, dict[str, Rival]], context: Context):
    """A state without the effects that do not hold everywhere, and those that do."""

    def found_of(now: State) -> list[Found]:
        return [_held(now, k, design, rivals, context) for k in range(len(now.fitted.model.present))]

    # Fields that are not there say nothing of the others, which are tested once without them.
    for k in reversed(range(len(now.fitted.model.present))):
        model = now.fitted.model
        if model.present[k].effect.place is not Place.SCATTER:
            continue
        found = _held(now, k, design, rivals, context)
        if found.gain < criteria.GAIN.value:
            now = without(now, k, context)
        else:
            # Of a field fits tell the contrast; its grain is what products say.
            own = found.own._replace(values=(model.present[k].values[0], *found.own.values[1:]))
            present = (*model.present[:k], own, *model.present[k + 1 :])
            now = now._replace(fitted=now.fitted._replace(model=model._replace(present=present)))
    return held(now, found_of, lambda now, k: without(now, k, context))


def held(now: S, found_of: Callable[[S], list[Found]], without: Callable[[S, int], S]) -> tuple[S, list[Found]]:
    """A state without the effects that do not hold everywhere, dropped the worst first; and those that do."""
    while True:
        found = found_of(now)
        bad = [k for k, one in enumerate(found)
               if not one.holding.holds or min(one.gain, one.holding.z2) < criteria.GAIN.value]  # fmt: skip
        if not bad:
            return now, found
        now = without(now, max(bad, key=lambda k: found[k].holding.excess))


def _held(now: State, k: int, design: Design, rivals: dict[str, dict[str, Rival]], context: Context) -> Found:
    """The effect of a number, with what it gains and how it holds."""
    model, own = now.fitted.model, now.fitted.model.present[k]
    dark = level_of(now.frames, model, k) if of_dark(model, own) else None
    if dark is not None:
        return _of_dark(dark)
    if own.effect.place is Place.SCATTER:
        own, gain, holding = pattern_of(now.frames, design, now.fitted, own, context)
    else:
        holding = holding_of(now.frames, design, now.fitted, k)
        gain = holding.z2
        if not CERTAIN <= gain < np.inf:
            gain = (without(now, k, context).fitted.total - now.fitted.total) / holding.wider**2
            holding = holding._replace(z2=min(gain, holding.z2))
        if own.form in own.effect.rounded and gathers(now.frames, model, k):
            # A code speaks for itself: cells ask whether light has the right shape about it.
            holding = holding._replace(q=0.0, cells=1, z2=gain, error=min(holding.error, ROUNDING_VARIANCE**0.5))
    near = [one for one in rivals.get(own.effect.name, {}).values() if one.behind < criteria.RIVAL.value]
    behind = {one.own.effect.name: one.behind for one in near}
    return Found(own, gain, holding, behind, tuple(one.own for one in near))
