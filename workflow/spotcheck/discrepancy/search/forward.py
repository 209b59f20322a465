"""The search: effects are added one by one, the likeliest refitted, until none gains more."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy import criteria
from spotcheck.discrepancy.evidence.noise import Noisy, noises_of
from spotcheck.discrepancy.nuisance.darkness import darkness
from spotcheck.discrepancy.nuisance.fit import Fitted, fit, free_of
from spotcheck.discrepancy.observe.design import Design
from spotcheck.discrepancy.observe.pixels import Frame
from spotcheck.discrepancy.search.candidates import Candidate, Tied, ranked, with_effect
from spotcheck.discrepancy.search.holds import Holding, holding_of, pattern_of
from spotcheck.model.effect import Context, Effect, Place, Present


# Steps of the fit of what was chosen: far from the truth brightness, width and shape are slow to part.
MOST_STEPS = 24


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
    least: Callable[[State], float] = lambda state: 0.0,
) -> Grown:
    """Add effects of pixels one by one; given up where none gains as much as is the `least` for a state.

    Noise comes first: with too little of it in the model, every pedestal and every halo looks like more.
    """
    now, rivals, tied = start._replace(fitted=quiet(start.frames, start.fitted)[0]), dict[str, dict[str, float]](), None
    while len(now.fitted.model.present) < criteria.MOST.value:
        wanted = least(now)
        found = ranked(now.frames, design, now.fitted, effects, context)
        tied = found.tied if tied is None else tied
        best = _best(now, [own for own in found.candidates if own.promise >= wanted], context)
        if best is None:
            return Grown(now, rivals, tied, wanted <= criteria.GAIN.value)
        now, near = best
        rivals[now.fitted.model.present[-1].effect.name] = near
        now = now._replace(fitted=quiet(now.frames, now.fitted, anew=True)[0])
    return Grown(now, rivals, tied or [], finished=True)


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
    model = with_effect(now.fitted.model, own.own)
    return State(frames, fit(frames, model, now.fitted.penalty, free_of(model, context), near=now.fitted))


def without(now: State, k: int, context: Context) -> State:
    """A state without the effect of a number, fitted again."""
    present = now.fitted.model.present
    model = now.fitted.model._replace(present=present[:k] + present[k + 1 :])
    return now._replace(fitted=fit(now.frames, model, now.fitted.penalty, free_of(model, context)))


def quiet(frames: Sequence[Frame], fitted: Fitted, *, anew: bool = False) -> tuple[Fitted, bool]:
    """A fit under the read noise of its dark pixels, and whether these tell it; `anew`: fitted again in any case."""
    dark = darkness(frames, fitted.model)
    told = dark is not None and bool(np.isfinite(dark.read_noise_stderr))
    sensor = fitted.model.sensor
    if told and abs(dark.read_noise_e - sensor.read_noise_e) >= dark.read_noise_stderr:
        sensor, anew = sensor._replace(read_noise_e=dark.read_noise_e), True
    model = fitted.model._replace(sensor=sensor)
    return (fit(frames, model, fitted.penalty, fitted.free, steps=MOST_STEPS) if anew else fitted), told


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
            rest = without(now, k, context)
            if own.effect.place is Place.SCATTER:
                gain, holding = pattern_of(now.frames, design, rest.fitted, own, context)
            else:
                gain = rest.fitted.total - now.fitted.total
                holding = holding_of(now.frames, groups_of(design), now.fitted, k, gain)
            near = {name: d for name, d in rivals.get(own.effect.name, {}).items() if d < criteria.RIVAL.value}
            found.append(Found(own, gain, holding, near))
        bad = [k for k, one in enumerate(found) if not one.holding.holds or one.gain < criteria.GAIN.value]
        if not bad:
            return now, found
        now = without(now, max(bad, key=lambda k: found[k].holding.excess), context)
