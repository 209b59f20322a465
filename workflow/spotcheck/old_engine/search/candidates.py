"""Everything that may be missing, ranked by what it promises to first order: effects of pixels, patterns, stripes."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine import criteria
from spotcheck.old_engine.evidence.patterns import gathered, patterns_of
from spotcheck.old_engine.evidence.pixels import Ready, Score, screen
from spotcheck.old_engine.evidence.stripes import phases, stripes_of, waved
from spotcheck.old_engine.evidence.windows import Site
from spotcheck.old_engine.model.effect import Context, Effect, Place, Present
from spotcheck.old_engine.nuisance.fit import Fitted, fit
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Frame, Numbers

# Places whose effects change single pixels' readings; others change frames' numbers, or scatter.
OF_PIXELS = frozenset(Place) - {Place.EXPOSURE, Place.WIDTH, Place.BRIGHTNESS, Place.NOISE, Place.SCATTER}
# Frames on which starts and forms are compared; how many effects are then looked at on all frames; and what these must
# promise there at least [−2 ln L], by what they promise on the few: of an effect at five errors, 7 % do not.
SOME, LOOKED_AT, LIKELY = 12, 8, 2.0


class Candidate(NamedTuple):
    """An effect at a start; what −2 ln L would gain with it, to first order; whether it changes means, so that its
    gain is told by a fit; and the frames with the waves of its stripes, where it is one that has them."""

    own: Present
    promise: float
    of_means: bool = True
    frames: tuple[Frame, ...] = ()


class Tied(NamedTuple):
    """An effect of which the light's shape takes all but a part of the information."""

    effect: Effect
    part: float


class Ranked(NamedTuple):
    """Candidates, the most promising first, and effects that are tied with the light's shape."""

    candidates: list[Candidate]
    tied: list[Tied]


def ranked(
    frames: Sequence[Frame], design: Design, fitted: Fitted, effects: Sequence[Effect], context: Context
) -> Ranked:
    """What may be missing in a fit."""
    taken = {own.effect.name for own in fitted.model.present}
    usable = [effect for effect in effects if effect.name not in taken]
    trials, tied = likeliest(frames, design, fitted, starts_of(usable, context), context)
    ready = Ready(frames, fitted, [])
    sites, rows = gathered(frames, design, ready)
    trials += [Candidate(own.own, own.told.gain, False) for own in patterns_of(sites, rows, usable, context)]
    trials += striped(frames, design, fitted.model.numbers, sites, usable, context)
    trials = [own for own in trials if own.promise >= criteria.GAIN.value]
    return Ranked(sorted(trials, key=lambda own: -own.promise), tied)


def striped(
    frames: Sequence[Frame],
    design: Design,
    numbers: Numbers,
    sites: Sequence[Site],
    effects: Sequence[Effect],
    context: Context,
) -> Iterator[Candidate]:
    """Stripes in the forms in which they may lie, each with its waves in the frames' views."""
    found = stripes_of(sites, context.sigma_px)
    if found is None or found.gain <= 0:
        return
    with_waves = waved(frames, design, numbers, sites, found.period, found.direction)
    centre = np.array(
        [[own[design.site == s].mean() for own in (numbers.x, numbers.y)] for s in np.unique(design.site)]
    )
    for effect in (own for own in effects if own.spectral):
        for own in phases(found, centre):
            if own.form in effect.forms:
                values = (own.depth, found.period, found.direction, own.phase)
                yield Candidate(Present(effect, own.form, values), found.gain * own.agrees**2, True, with_waves)


def starts_of(effects: Sequence[Effect], context: Context) -> list[Present]:
    """Every form and start of effects of pixels."""
    return [
        Present(effect, form, tuple(map(float, start)))
        for effect in effects
        if effect.place in OF_PIXELS and not effect.spectral
        for form in effect.forms
        for start in effect.starts(context)
    ]


def likeliest(
    frames: Sequence[Frame], design: Design, fitted: Fitted, starts: Sequence[Present], context: Context
) -> tuple[list[Candidate], list[Tied]]:
    """The best start of each effect of pixels, and those that are tied with the shape: starts and forms are compared on
    some frames, the likeliest effects on all."""
    if not starts:
        return [], []
    few = some_of(design)
    small, some = at_frames(frames, fitted, few), [frames[k] for k in few]
    best: dict[str, tuple[float, Present, Score]] = {}
    for own, score in zip(starts, scores(some, small, starts), strict=True):
        promise = promised(own, score)
        if promise > best.get(own.effect.name, (-1.0,))[0]:
            best[own.effect.name] = promise, own, score
    tied = tied_of(some, small, [own for _, own, _ in best.values()], [score for *_, score in best.values()])
    hidden = {own.effect.name for own in tied}
    least = LIKELY * len(few) / len(frames)
    likely = (one for name, one in best.items() if name not in hidden and one[0] >= least)
    order = sorted(likely, key=lambda one: -one[0])
    looked = [own for _, own, _ in order[:LOOKED_AT]]
    out, worth = [], criteria.FIRST_ORDER.value
    for own, score in zip(looked, scores(frames, fitted, looked), strict=True):
        asked = asked_for(own, score, context)
        if not np.isfinite(own.effect.neutral) or asked.effect.excess(asked.values[0], context) >= worth:
            out.append(Candidate(asked, promised(own, score)))
    return out, tied


def tied_of(frames: Sequence[Frame], fitted: Fitted, trials: Sequence[Present], beside: Sequence[Score]) -> list[Tied]:
    """Effects of which a free shape takes all but a small part of the information: under the declared shape, which
    splines follow exactly; a learned one has structure as fine as they are. `beside`: their scores under that."""
    lights = fitted.model.lights
    if lights is None:
        return []
    model = fitted.model._replace(lights=lights._replace(coefficients=0 * lights.coefficients))
    plain = fit(frames, model, fitted.penalty, fitted.free, steps=0)
    out = []
    for own, score, learned in zip(trials, scores(frames, plain, trials), beside, strict=True):
        # A level that the declared light does not reach is told by the learned one alone.
        told = learned if score.if_known < criteria.TIED.value * learned.if_known else score
        part = told.information / max(told.if_known, 1e-300)
        if part < criteria.TIED.value:
            out.append(Tied(own.effect, part))
    return out


def promised(own: Present, score: Score) -> float:
    """What −2 ln L would gain: of a level all or nothing, of all else as much as is best."""
    return score.promise if np.isfinite(own.effect.neutral) else max(score.drop, 0.0)


def asked_for(own: Present, score: Score, context: Context) -> Present:
    """An effect as strong as its score asks for, where readings follow a straight line."""
    neutral = own.effect.neutral
    if not np.isfinite(neutral) or not score.straight:
        return own
    low, high = own.effect.bounds(context)[0]
    strength = float(np.clip(neutral + score.size * (own.values[0] - neutral), low, high))
    return own._replace(values=(strength, *own.values[1:]))


def some_of(design: Design) -> np.ndarray:
    """A few frames: of each condition one, in turn of each site."""
    order = np.lexsort((np.arange(len(design.site)), nth(design.condition)))
    return np.sort(order[:SOME])


def nth(labels: np.ndarray) -> np.ndarray:
    """How many have the same label before each."""
    out, seen = np.zeros(len(labels), int), dict[int, int]()
    for k, own in enumerate(labels.tolist()):
        out[k] = seen[own] = seen.get(own, -1) + 1
    return out


def at_frames(frames: Sequence[Frame], fitted: Fitted, which: np.ndarray) -> Fitted:
    """A fit as it stands, on some of its frames alone."""
    return fit([frames[k] for k in which], fitted.model.take(which), fitted.penalty, fitted.free, steps=0)


def scores(frames: Sequence[Frame], fitted: Fitted, trials: Sequence[Present]) -> list[Score]:
    """Scores of effects added to a model."""
    return screen(frames, fitted, [fitted.model.with_effect(own) for own in trials]) if trials else []
