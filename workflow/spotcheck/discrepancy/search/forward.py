"""The search: effects are added one by one, the likeliest refitted, until none gains more."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy import criteria
from spotcheck.discrepancy.evidence.noise import Noisy, noises_of
from spotcheck.discrepancy.evidence.pixels import Score, screen
from spotcheck.discrepancy.nuisance.darkness import darkness
from spotcheck.discrepancy.nuisance.fit import Fitted, fit, free_of
from spotcheck.discrepancy.nuisance.sheet import tilt_of
from spotcheck.discrepancy.observe.pixels import Frame, Model
from spotcheck.discrepancy.search.holds import Holding, holding_of
from spotcheck.model.effect import Context, Effect, Place, Present

# Places whose effects change single pixels' readings; others change frames' numbers, or scatter.
OF_PIXELS = frozenset(Place) - {Place.EXPOSURE, Place.WIDTH, Place.BRIGHTNESS, Place.SCATTER}


class Trial(NamedTuple):
    """An effect at a start, and its score there."""

    own: Present
    score: Score

    @property
    def promise(self) -> float:
        """What −2 ln L would gain, to first order; 0 for an effect that would have to be negative."""
        # Of a level there is all or nothing: where frames fit worse with it than without, it lies elsewhere.
        elsewhere = np.isinf(self.own.effect.neutral) and self.score.drop < 0
        return 0.0 if elsewhere or self.score.size < 0 else self.score.z**2


class Found(NamedTuple):
    """An effect that was found, with what it gains, how it holds everywhere, and the effects that do nearly as well in
    its place: by name, what they fall behind by."""

    own: Present
    gain: float
    holding: Holding
    rivals: dict[str, float]


class Outcome(NamedTuple):
    """The fit without and with what was found, and what was found."""

    before: Fitted
    after: Fitted
    found: tuple[Found, ...]


def trials_of(effects: Sequence[Effect], context: Context, model: Model) -> Iterator[Present]:
    """Every form and start of the effects that a model does not have."""
    taken = {own.effect.name for own in model.present}
    for effect in effects:
        if effect.place in OF_PIXELS and not effect.spectral and effect.name not in taken:
            for form in effect.forms:
                for start in effect.starts(context):
                    yield Present(effect, form, tuple(map(float, start)))


def likeliest(frames: Sequence[Frame], fitted: Fitted, trials: Sequence[Present]) -> list[Trial]:
    """The best trial of each effect that is not tied with the shape, the most promising first."""
    others = [with_effect(fitted.model, own) for own in trials]
    best: dict[str, Trial] = {}
    for own, score in zip(trials, screen(frames, fitted, others), strict=True):
        trial = Trial(own, score)
        tied = score.information < criteria.TIED.value * score.if_known
        if not tied and trial.promise > best.get(own.effect.name, trial).promise * (own.effect.name in best):
            best[own.effect.name] = trial
    return sorted(best.values(), key=lambda trial: -trial.promise)


def with_effect(model: Model, own: Present) -> Model:
    """A model with an effect more."""
    return model._replace(present=(*model.present, own))


def search(
    frames: Sequence[Frame], groups: np.ndarray, start: Fitted, effects: Sequence[Effect], context: Context
) -> Outcome:
    """Find effects of pixels from a fit without any; `groups` [frame] parts frames for the consistency test.

    Noise comes first: with too little of it in the model, every pedestal and every halo looks like more.
    """
    stated = start.model.sensor.read_noise_e
    now, told = _quiet(frames, start)
    rivals: dict[str, dict[str, float]] = {}
    usable = [effect for effect in effects if not (told and effect.place is Place.NOISE)]
    while len(now.model.present) < criteria.MOST.value:
        ranked = likeliest(frames, now, list(trials_of(usable, context, now.model)))
        ranked = [trial for trial in ranked if trial.promise >= criteria.GAIN.value][: int(criteria.REFITTED.value)]
        tried = [_refitted(frames, now, trial, context) for trial in ranked]
        tried = [one for one in tried if now.total - one.total >= criteria.GAIN.value and _matters(one, context)]
        if not tried:
            break
        tried.sort(key=lambda one: one.total)
        name = tried[0].model.present[-1].effect.name
        rivals[name] = {one.model.present[-1].effect.name: one.total - tried[0].total for one in tried[1:]}
        now, _ = _quiet(frames, tried[0])
    outcome = _tested(frames, groups, start, now, rivals, context)
    if not told:
        return outcome
    noisy = noises_of(frames, groups, outcome.after.model, stated, effects, context)
    named = [_named(one, context) for one in noisy if one.gain >= criteria.GAIN.value]
    return outcome._replace(found=outcome.found + tuple(one for one in named if one is not None))


def _quiet(frames: Sequence[Frame], fitted: Fitted) -> tuple[Fitted, bool]:
    """A fit under the read noise of its dark pixels, and whether these tell it."""
    dark = darkness(frames, fitted.model)
    if dark is None or not np.isfinite(dark.read_noise_stderr):
        return fitted, False
    if abs(dark.read_noise_e - fitted.model.sensor.read_noise_e) < dark.read_noise_stderr:
        return fitted, True
    sensor = fitted.model.sensor._replace(read_noise_e=dark.read_noise_e)
    return fit(frames, fitted.model._replace(sensor=sensor), fitted.penalty, fitted.free), True


def _named(one: Noisy, context: Context) -> Found | None:
    """An effect that adds noise, where it is more than nothing and groups of frames agree about it."""
    holding = Holding(one.q, max(one.groups, 1), one.gain, one.error)
    matters = one.own.effect.excess(one.own.values[0], context) >= 1
    return Found(one.own, one.gain, holding, {}) if matters and holding.holds else None


def _tested(
    frames, groups, start: Fitted, now: Fitted, rivals: dict[str, dict[str, float]], context: Context
) -> Outcome:
    """What is left of a search's effects when those that do not hold everywhere are dropped, the worst first."""
    while True:
        found = []
        for k, own in enumerate(now.model.present):
            fewer = now.model._replace(present=now.model.present[:k] + now.model.present[k + 1 :])
            rest = fit(frames, fewer, now.penalty, free_of(fewer, context))
            gain = rest.total - now.total
            near = {name: d for name, d in rivals.get(own.effect.name, {}).items() if d < criteria.RIVAL.value}
            found.append(Found(own, gain, holding_of(frames, groups, now, k, gain), near))
        bad = [k for k, one in enumerate(found) if not one.holding.holds or one.gain < criteria.GAIN.value]
        if not bad:
            return Outcome(start, now, tuple(found))
        worst = max(bad, key=lambda k: found[k].holding.excess)
        fewer = now.model._replace(present=now.model.present[:worst] + now.model.present[worst + 1 :])
        now = fit(frames, fewer, now.penalty, free_of(fewer, context))


def _refitted(frames: Sequence[Frame], now: Fitted, trial: Trial, context: Context) -> Fitted:
    """A fit with an effect more, from where its score points."""
    model = with_effect(now.model, trial.own)
    free = free_of(model, context)
    tilt = tilt_of(frames, now._replace(model=model, free=free))
    return fit(frames, model, now.penalty, free, tilt=tilt)


def _matters(one: Fitted, context: Context) -> bool:
    """Whether the effect that was added last is more than what a user would call nothing."""
    own = one.model.present[-1]
    return own.effect.excess(own.values[0], context) >= 1
