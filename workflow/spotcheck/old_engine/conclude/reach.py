"""How far effects of pixels may be from where they vanish: the strength of which all is just excluded.

Of a strength that is tried, its score says what part of it there is, s, with the standard error e. All of it is
excluded where s + k e is below 1, k being the normal quantile of the confidence. So no straight line is drawn from 0,
which a clip or a blur does not follow. Where there is less than none of an effect, s counts as 0. Errors are wider
where fields make neighbouring pixels alike, and where cells of the spot disagree by more than chance, by √(χ² per
degree of freedom) (the scale factor of the Particle Data Group, Review of Particle Physics, Introduction 5.2.2).
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine.evidence.pixels import Score, by_cell
from spotcheck.old_engine.model.effect import Context, Effect, Present
from spotcheck.old_engine.nuisance.fit import Fitted
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Frame
from spotcheck.old_engine.search.candidates import at_frames, nth, scores, some_of, starts_of
from spotcheck.old_engine.search.holds import agreement_of, fields_of

# Normal quantiles of 95 %, of one end and of both.
ONE_SIDED, TWO_SIDED = 1.645, 1.960
# How often strengths are tried on a few frames, then on all; the farthest step.
ROUNDS, LAST, STEP = 8, 3, 8.0
# Powers of the distance that a change may follow, told between two distances so far apart; from which one on it is that
# of a code, nothing here and everything a little further on, unless light stops there.
POWERS, APART, STEEP = (0.25, 400.0), 1.02, 16.0
# Information that grows by less than this power of the number of frames hangs on what they share.
SHARED = 0.5
# So many errors of an effect that was not named are no chance, and more frames will not take it away.
THERE = 3.0


class Reach(NamedTuple):
    """The least and the greatest strength that are left (NaN: an end that is not told); how many times as many frames
    leave half (infinite: no number of them; NaN: there is no half); and whether something is there."""

    low: float
    high: float
    times: float
    there: bool = False


class _Trial(NamedTuple):
    """An effect as it starts on one side of where it vanishes, the quantile of its limit, and its distance from there
    (one over its strength where it vanishes at infinity). `inside` and `outside` are the farthest distance that is not
    excluded and the nearest that is; a change grows by a `power` of the distance; its errors are `wider` than pixels
    alone say. `turned` are the starts in other directions."""

    start: Present
    sign: int
    quantile: float
    distance: float
    turned: tuple[Present, ...] = ()
    inside: float = 0.0
    outside: float = np.inf
    power: float = 1.0
    wider: float = 1.0

    def at(self, distance: float) -> Present:
        """The effect at a distance. What else is a signal goes with a strength that is one."""
        effect, values = self.start.effect, self.start.values
        if np.isinf(effect.neutral):
            return self.start._replace(values=(1 / distance, *values[1:]))
        part = distance / abs(values[0] - effect.neutral)
        signal = effect.parameters[0].unit.startswith("DN")
        others = (
            part * own if signal and p.unit == "DN" else own
            for p, own in zip(effect.parameters[1:], values[1:], strict=True)
        )
        return self.start._replace(values=(effect.neutral + self.sign * distance, *others))

    def left(self, score: Score, part: float = 1.0) -> float:
        """What is left of all of the change by its error alone, of which a part counts."""
        return self.quantile * part * self.wider / np.sqrt(score.information) if score.information > 0 else np.inf

    def then(self, left: float) -> "_Trial":
        """The trial at the distance where 1 should be left, between those of which more and less is."""
        inside = max(self.inside, self.distance) if left > 1 else self.inside
        outside = min(self.outside, self.distance) if left <= 1 else self.outside
        factor = left ** (1 / self.power) if np.isfinite(left) else STEP
        there = self.distance * float(np.clip(factor, 1 / STEP, STEP))
        if 0 < inside < outside < np.inf and not inside < there < outside:
            there = float(np.sqrt(inside * outside))
        return self._replace(inside=inside, outside=outside, distance=there)


def reach_of_pixels(
    frames: Sequence[Frame], fitted: Fitted, design: Design, effects: Sequence[Effect], context: Context
) -> dict[str, Reach]:
    """How far each effect may reach, from the start and in the form in which it reaches farthest; one that vanishes at
    infinity in its first form. Not of effects of which frames tell nothing."""
    trials = _where_all_are_sure(frames, fitted, design, effects, context)
    for turn in range(LAST):
        looked, (told, sizes) = trials, _told(frames, fitted, trials)
        looked = looked if turn else _widened(frames, fitted, design, looked, told)
        trials = [own.then(own.left(one) + size) for own, one, size in zip(looked, told, sizes, strict=True)]
    grows = _growth(frames, fitted, design, looked, told)
    out: dict[str, Reach] = {}
    for own, score, size, by in zip(trials, told, sizes, grows, strict=True):
        before = out.get(own.start.effect.name, Reach(np.nan, np.nan, np.nan))
        if score.information > 0:
            there = max(size, abs(score.size)) * np.sqrt(score.information) > THERE * own.wider
            before = _with(before, own, bool(there), by, context)
        out[own.start.effect.name] = before
    return {name: own for name, own in out.items() if np.isfinite([own.low, own.high]).any()}


def _where_all_are_sure(
    frames: Sequence[Frame], fitted: Fitted, design: Design, effects: Sequence[Effect], context: Context
) -> list[_Trial]:
    """Of every effect on each side its farthest start, where the limit would be if the frames said that there is
    nothing: a few of them tell how sure all are."""
    few = some_of(design)
    some, small, part = [frames[k] for k in few], at_frames(frames, fitted, few), float(np.sqrt(len(few) / len(frames)))

    def left_of(trials: Sequence[_Trial], away: float = 1.0) -> list[float]:
        told = scores(some, small, [own.at(away * own.distance) for own in trials])
        return [own.left(score, part) for own, score in zip(trials, told, strict=True)]

    trials = _sides(effects, context)
    trials = _farthest(own.then(left) for own, left in zip(trials, left_of(trials), strict=True))
    for _ in range(ROUNDS):
        trials = [own.then(left) for own, left in zip(trials, left_of(trials), strict=True)]
    ends = zip(trials, left_of(trials), left_of(trials, 1 / APART), strict=True)
    return [
        own._replace(
            inside=0.0,
            outside=np.inf,
            power=float(np.clip(np.log(near / far) / np.log(APART), *POWERS))
            if 0 < far <= near < np.inf
            else own.power,
        )
        for own, far, near in ends
    ]


def _told(frames: Sequence[Frame], fitted: Fitted, trials: Sequence[_Trial]) -> tuple[list[Score], list[float]]:
    """The score of each trial, and how much of its change there is, in whatever direction."""
    each = [[own.start, *own.turned] for own in trials]
    every = [own._replace(start=one).at(own.distance) for own, some in zip(trials, each, strict=True) for one in some]
    told = iter(scores(frames, fitted, every))
    first, sizes = [], []
    for some in each:
        score, *others = [next(told) for _ in some]
        first.append(score)
        # What turns with a direction is a sine of it: of evenly spaced ones the mean square is half the amplitude's.
        around = np.sqrt(2 * np.mean([own.size**2 for own in (score, *others)])) if others else 0.0
        sizes.append(float(max(score.size, around)))
    return first, [max(own, 0.0) for own in sizes]


def _widened(
    frames: Sequence[Frame], fitted: Fitted, design: Design, trials: Sequence[_Trial], told: Sequence[Score]
) -> list[_Trial]:
    """Trials with their errors as wide as fields and what cells disagree by make them."""
    others = [fitted.model.with_effect(own.at(own.distance)) for own in trials]
    cells = by_cell(frames, fitted, others, told, fields_of(fitted.model, frames[0].step))
    out = []
    for own, one in zip(trials, cells, strict=True):
        if not one.information.any():
            out.append(own)
            continue
        agrees = agreement_of(one, design)
        scale = np.sqrt(max(agrees.q / max(agrees.cells - 1, 1), 1.0))
        out.append(own._replace(wider=float(agrees.wider * scale)))
    return out


def _sides(effects: Sequence[Effect], context: Context) -> list[_Trial]:
    """Every start of effects, on every side of where they vanish."""
    out = []
    for own in starts_of(effects, context):
        effect, signs = own.effect, own.effect.signs(context)
        if np.isfinite(effect.neutral):
            away, quantile = abs(own.values[0] - effect.neutral), TWO_SIDED if len(signs) > 1 else ONE_SIDED
            out += [_Trial(own, sign, quantile, away, turned=_turned(own, context)) for sign in signs]
        elif signs and own.form == effect.forms[0] and own.values[0] == effect.starts(context)[0][0]:
            out.append(_Trial(own, signs[0], ONE_SIDED, 1 / own.values[0]))
    return out


def _turned(own: Present, context: Context) -> tuple[Present, ...]:
    """The other starts of an effect that differ from one in direction alone; none where these do not go all round."""
    turning = np.array([p.unit == "deg" for p in own.effect.parameters])
    values = [tuple(map(float, start)) for start in own.effect.starts(context)]
    same = [v for v in values if np.array_equal(np.array(v)[~turning], np.array(own.values)[~turning])]
    return tuple(own._replace(values=v) for v in same if v != own.values) if len(same) > 2 else ()


def _farthest(trials: Iterable[_Trial]) -> list[_Trial]:
    """Of every effect on each side the trial that reaches farthest."""
    out: dict[tuple[str, int], _Trial] = {}
    for own in trials:
        key = own.start.effect.name, own.sign
        if key not in out or own.distance > out[key].distance:
            out[key] = own
    return list(out.values())


def _growth(
    frames: Sequence[Frame], fitted: Fitted, design: Design, trials: Sequence[_Trial], told: Sequence[Score]
) -> list[float]:
    """By which power of the number of frames the information on each trial grows, by every second of a condition; 1
    where none has a second."""
    half = np.flatnonzero(nth(design.condition) % 2 == 0)
    if len(half) == len(frames):
        return [1.0] * len(trials)
    few = scores(
        [frames[int(k)] for k in half], at_frames(frames, fitted, half), [own.at(own.distance) for own in trials]
    )
    pairs = [(one.information, max(other.information, 0.0)) for one, other in zip(told, few, strict=True)]
    more = np.log(len(frames) / len(half))
    return [float(np.log(one / other) / more) if min(one, other) > 0 else 0.0 for one, other in pairs]


def _with(before: Reach, own: _Trial, there: bool, grows: float, context: Context) -> Reach:
    """What is left of an effect, with one side more."""
    effect, strength = own.start.effect, own.at(own.distance).values[0]
    low, high = effect.bounds(context)[0]
    steep = np.isfinite(effect.neutral) and own.power > STEEP
    if not low <= strength <= high or steep:
        return before
    # A strength that vanishes at infinity has no half.
    times = np.nan if np.isinf(effect.neutral) else 4 ** (own.power / max(grows, SHARED))
    times = np.inf if grows < SHARED or there else times
    low, high = (strength, before.high) if own.sign < 0 else (before.low, strength)
    return Reach(low, high, float(np.fmax(before.times, times)), before.there or there)
