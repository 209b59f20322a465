"""The search: effects are added one by one, the likeliest refitted, until none gains more."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy import criteria
from spotcheck.discrepancy.evidence.noise import Noisy, levels_of, moves_level, noises_of
from spotcheck.discrepancy.nuisance.darkness import darkness
from spotcheck.discrepancy.nuisance.fit import Fitted, fit, free_of
from spotcheck.discrepancy.observe.design import Design
from spotcheck.discrepancy.observe.pixels import Frame
from spotcheck.discrepancy.search.candidates import Candidate, Tied, ranked
from spotcheck.discrepancy.search.holds import Holding, holding_of, pattern_of
from spotcheck.model.effect import Context, Effect, Place, Present

# Steps of the fit of what was chosen: far from the truth brightness, width and shape are slow to part.
MOST_STEPS = 24

# From so many squared standard errors on, what a strength gains is no longer looked at by a fit without it.
SURE = 2500.0


class State(NamedTuple):
    """Frames, with the waves of stripes that were found, and a fit."""

    frames: tuple[Frame, ...]
    fitted: Fitted


class Found(NamedTuple):
    """An effect that was found, with what it gains, how it holds everywhere, and the effects that do nearly as well in
    its place: by name, what they fall behind by."""

    own: Present
    gain: float
    holding: Holding
    rivals: dict[str, float]


class Outcome(NamedTuple):
    """Frames, the fit without and with what was found, what was found, and what is tied with the light's shape."""

    frames: tuple[Frame, ...]
    before: Fitted
    after: Fitted
    found: tuple[Found, ...]
    tied: tuple[Tied, ...]


class Grown(NamedTuple):
    """A state to which effects were added; by name of each, what others fell behind by; what is tied with the light's
    shape; and whether nothing more is to be found, or the search was given up."""

    state: State
    rivals: dict[str, dict[str, float]]
    tied: list[Tied]
    finished: bool


def grow(
    start: State,
    design: Design,
    effects: Sequence[Effect],
    context: Context,
    black_dn: float,
    least: Callable[[State], float] = lambda state: 0.0,
    gain: float = 0.0,
) -> Grown:
    """Add effects of pixels one by one, where the sheet states a black level of so many DN, that promise a `gain`;
    given up where none gains as much as is the `least` for a state.

    Noise and level of dark pixels come first: with too little noise in the model, every pedestal and every halo looks
    like more, and beside a wrong level nothing else can be told. What moves the level is asked last.
    """
    rivals, tied = dict[str, dict[str, float]](), list[Tied]()
    now, told = quiet(start, level=True)
    usable = [e for e in effects if not (told and any(moves_level(e, form) for form in e.forms))]
    for step in range(int(criteria.MOST.value)):
        found = ranked(now.frames, design, now.fitted, usable, context)
        wanted = least(now) if found.candidates else 0.0
        tied = tied if step else found.tied
        best = _best(now, [own for own in found.candidates if own.promise >= max(wanted, gain)], context)
        if best is None:
            return Grown(levelled(now, black_dn, effects, context), rivals, tied, wanted <= criteria.GAIN.value)
        now, near = best
        rivals[now.fitted.model.present[-1].effect.name] = near
        now, _ = quiet(now, level=told, anew=True)
    return Grown(levelled(now, black_dn, effects, context), rivals, tied, finished=True)


def levelled(now: State, stated_dn: float, effects: Sequence[Effect], context: Context) -> State:
    """A state in which the black level is the stated one again, and what moves it an effect, where it is more than
    nothing."""
    sensor = now.fitted.model.sensor
    shift = sensor.black_level_dn - stated_dn
    dark = darkness(now.frames, now.fitted.model) if shift else None
    if dark is None:
        return now
    model = now.fitted.model._replace(sensor=sensor._replace(black_level_dn=stated_dn))
    tried = [now._replace(fitted=fit(now.frames, model, now.fitted.penalty, now.fitted.free))]
    taken = {own.effect.name for own in model.present}
    usable = [effect for effect in effects if effect.name not in taken]
    if (shift / dark.black_level_stderr) ** 2 >= criteria.GAIN.value:
        for own in levels_of(usable, shift, now.frames[0].view, context):
            if own.effect.excess(own.values[0], context) >= 1:
                other = model.with_effect(own)
                fitted = fit(now.frames, other, now.fitted.penalty, free_of(other, context), steps=MOST_STEPS)
                tried.append(quiet(now._replace(fitted=fitted), level=False)[0])
    return min(tried, key=lambda own: own.fitted.total)


def outcome_of(
    grown: Grown, before: Fitted, design: Design, effects: Sequence[Effect], context: Context, stated_e: float
) -> Outcome:
    """What holds everywhere of what was added, and effects that add noise, where the sheet states a read noise of so
    many e-."""
    now, kept = _tested(grown.state, design, grown.rivals, context)
    noisy = noises_of(now.frames, groups_of(design), now.fitted.model, stated_e, effects, context)
    kept += [one for one in (_named(own, context) for own in noisy) if one is not None]
    return Outcome(now.frames, before, now.fitted, tuple(kept), tuple(grown.tied))


def groups_of(design: Design) -> np.ndarray:
    """What parts frames that must agree about an effect: their exposure, or where all have one their angle."""
    return design.exposure_s if design.exposures.size > 1 else design.angle_deg


def _best(now: State, candidates: Sequence[Candidate], context: Context) -> tuple[State, dict[str, float]] | None:
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
    near: dict[str, float] = {}
    for gain, name, _ in tried[1:]:
        if name != first[1]:
            near[name] = min(near.get(name, np.inf), first[0] - gain)
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
    """A state under the read noise of its dark pixels, and with `level` their black level, and whether these are told;
    `anew`: fitted again in any case."""
    dark, model = darkness(now.frames, now.fitted.model), now.fitted.model
    sensor, told = model.sensor, dark is not None and bool(np.isfinite(dark.black_level_stderr))
    if dark is not None:
        # An error that is infinite is of what is not told.
        if abs(dark.read_noise_e - sensor.read_noise_e) >= dark.read_noise_stderr:
            sensor, anew = sensor._replace(read_noise_e=dark.read_noise_e), True
        if level and abs(dark.black_level_dn - sensor.black_level_dn) >= dark.black_level_stderr:
            sensor, anew = sensor._replace(black_level_dn=dark.black_level_dn), True
    if not anew:
        return now, told
    model = model._replace(sensor=sensor)
    return now._replace(fitted=fit(now.frames, model, now.fitted.penalty, now.fitted.free, steps=MOST_STEPS)), told


def _named(one: Noisy, context: Context) -> Found | None:
    """An effect that adds noise, where it is more than nothing and groups of frames agree about it."""
    holding = Holding(one.q, max(one.groups, 1), one.gain, one.error)
    matters = one.gain >= criteria.GAIN.value and one.own.effect.excess(one.own.values[0], context) >= 1
    return Found(one.own, one.gain, holding, {}) if matters and holding.holds else None


def _tested(now: State, design: Design, rivals: dict[str, dict[str, float]], context: Context):
    """A state without the effects that do not hold everywhere, dropped the worst first; and those that do."""
    while True:
        found = []
        for k, own in enumerate(now.fitted.model.present):
            if own.effect.place is Place.SCATTER:
                own, gain, holding = pattern_of(now.frames, design, now.fitted, own, context)
            else:
                holding = holding_of(now.frames, groups_of(design), now.fitted, k)
                gain = holding.z2
                if not SURE <= gain < np.inf:
                    gain = without(now, k, context).fitted.total - now.fitted.total
                    holding = holding._replace(z2=min(gain, holding.z2))
            near = {name: d for name, d in rivals.get(own.effect.name, {}).items() if d < criteria.RIVAL.value}
            found.append(Found(own, gain, holding, near))
        bad = [k for k, one in enumerate(found) if not one.holding.holds or one.holding.z2 < criteria.GAIN.value]
        if not bad:
            return now, found
        now = without(now, max(bad, key=lambda k: found[k].holding.excess), context)
