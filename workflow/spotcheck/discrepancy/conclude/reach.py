"""How far effects of pixels may be from where they vanish: the strength of which all is just excluded.

Of a strength that is tried, its score says what part of it there is, s, with the standard error e. All of it is excluded
where s + k e is below 1, k being the normal quantile of the confidence. So no straight line is drawn from 0, which a
clip or a blur does not follow. Where there is less than none of an effect, s counts as 0.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.nuisance.fit import Fitted
from spotcheck.discrepancy.observe.design import Design
from spotcheck.discrepancy.observe.pixels import Frame
from spotcheck.discrepancy.search.candidates import at_frames, nth, scores, some_of, starts_of
from spotcheck.model.effect import Context, Effect, Present

# Normal quantiles of 95 %, of one end and of both.
ONE_SIDED, TWO_SIDED = 1.645, 1.960
# How often strengths are tried on a few frames, then on all; the farthest step of one; powers that a change may follow.
ON_FEW, ON_ALL, STEP, POWERS = 6, 2, 8.0, (0.25, 16.0)
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
    (one over its strength where it vanishes at infinity); distances that were tried, with what is left of each; and the
    last score's z and information."""

    start: Present
    sign: int
    quantile: float
    distance: float
    tried: tuple[tuple[float, float], ...] = ()
    z: float = 0.0
    information: float = 0.0

    def present(self) -> Present:
        """The effect at its distance. What else is a signal goes with a strength that is one."""
        effect, values = self.start.effect, self.start.values
        if np.isinf(effect.neutral):
            return self.start._replace(values=(1 / self.distance, *values[1:]))
        part = self.distance / abs(values[0] - effect.neutral)
        signal = effect.parameters[0].unit.startswith("DN")
        others = (
            part * own if signal and p.unit == "DN" else own
            for p, own in zip(effect.parameters[1:], values[1:], strict=True)
        )
        return self.start._replace(values=(effect.neutral + self.sign * self.distance, *others))

    def power(self) -> float:
        """By which power of the distance the change grows where it is nearest to the limit."""
        near = sorted((own for own in self.tried if 0 < own[1] < np.inf), key=lambda own: abs(np.log(own[1])))[:2]
        if len(near) < 2 or abs(np.log(near[0][0] / near[1][0])) < 1e-6:
            return 1.0
        return float(np.clip(-np.log(near[0][1] / near[1][1]) / np.log(near[0][0] / near[1][0]), *POWERS))

    def then(self, left: float, z: float, information: float) -> "_Trial":
        """Tried, at the distance where nothing more should be left."""
        own = self._replace(tried=(*self.tried, (self.distance, left)), z=z, information=information)
        inside = max((d for d, part in own.tried if part > 1), default=0.0)
        outside = min((d for d, part in own.tried if part <= 1 and d > inside), default=np.inf)
        factor = left ** (1 / own.power()) if np.isfinite(left) else STEP
        there = self.distance * float(np.clip(factor, 1 / STEP, STEP))
        if 0 < inside < outside < np.inf and not inside < there < outside:
            there = float(np.sqrt(inside * outside))
        return own._replace(distance=there)


def reach_of_pixels(
    frames: Sequence[Frame], fitted: Fitted, design: Design, effects: Sequence[Effect], context: Context
) -> dict[str, Reach]:
    """How far each effect may reach, from the start and in the form in which it reaches farthest; one that vanishes at
    infinity in its first form. Not of effects of which frames tell nothing."""
    few = some_of(design)
    some, small = [frames[k] for k in few], at_frames(frames, fitted, few)
    trials = _farthest(_tried(some, small, _sides(effects, context), 1.0, told=False))
    # Few frames tell how sure all are of a strength. What is there is asked of all.
    part = float(np.sqrt(len(few) / len(frames)))
    for _ in range(ON_FEW):
        trials = _tried(some, small, trials, part, told=False)
    trials = [own._replace(tried=own.tried[-2:]) for own in trials]
    for _ in range(ON_ALL):
        trials = _tried(frames, fitted, trials, 1.0, told=True)
    out: dict[str, Reach] = {}
    for own, grows in zip(trials, _growth(frames, fitted, design, trials), strict=True):
        name = own.start.effect.name
        out[name] = _with(out.get(name, Reach(np.nan, np.nan, np.nan)), own, grows, context)
    return {name: own for name, own in out.items() if np.isfinite([own.low, own.high]).any()}


def _sides(effects: Sequence[Effect], context: Context) -> list[_Trial]:
    """Every start of effects, on every side of where they vanish."""
    out = []
    for own in starts_of(effects, context):
        effect, signs = own.effect, own.effect.signs(context)
        if np.isfinite(effect.neutral):
            away, quantile = abs(own.values[0] - effect.neutral), TWO_SIDED if len(signs) > 1 else ONE_SIDED
            out += [_Trial(own, sign, quantile, away) for sign in signs]
        elif signs and own.form == effect.forms[0] and own.values[0] == effect.starts(context)[0][0]:
            out.append(_Trial(own, signs[0], ONE_SIDED, 1 / own.values[0]))
    return out


def _tried(
    frames: Sequence[Frame], fitted: Fitted, trials: Sequence[_Trial], part: float, *, told: bool
) -> list[_Trial]:
    """Trials after a look at frames, of which so great a part of the errors counts; `told`: and what they say."""
    out = []
    for own, score in zip(trials, scores(frames, fitted, [one.present() for one in trials]), strict=True):
        if score.information > 0:
            left = own.quantile * part / np.sqrt(score.information) + told * max(score.size, 0.0)
            out.append(own.then(float(left), score.z, score.information))
        else:
            out.append(own.then(np.inf, 0.0, 0.0))
    return out


def _farthest(trials: Iterable[_Trial]) -> list[_Trial]:
    """Of every effect on each side the trial that reaches farthest."""
    out: dict[tuple[str, int], _Trial] = {}
    for own in trials:
        key = own.start.effect.name, own.sign
        if key not in out or own.distance > out[key].distance:
            out[key] = own
    return list(out.values())


def _growth(frames: Sequence[Frame], fitted: Fitted, design: Design, trials: Sequence[_Trial]) -> list[float]:
    """By which power of the number of frames the information on each trial grows, by every second of a condition; 1
    where none has a second."""
    half = np.flatnonzero(nth(design.condition) % 2 == 0)
    if len(half) == len(frames):
        return [1.0] * len(trials)
    fewer = at_frames(frames, fitted, half)
    looked = [own._replace(distance=own.tried[-1][0]).present() for own in trials]
    every = zip(trials, scores([frames[k] for k in half], fewer, looked), strict=True)
    more = np.log(len(frames) / len(half))
    return [
        float(np.log(own.information / score.information) / more)
        if min(own.information, score.information) > 0
        else 0.0
        for own, score in every
    ]


def _with(before: Reach, own: _Trial, grows: float, context: Context) -> Reach:
    """What is left of an effect, with one side more."""
    effect, strength = own.start.effect, own.present().values[0]
    low, high = effect.bounds(context)[0]
    if not low <= strength <= high or not own.information:
        return before
    # A strength that vanishes at infinity has no half.
    times = np.nan if np.isinf(effect.neutral) else 4 ** (own.power() / max(grows, SHARED))
    there = before.there or abs(own.z) > THERE
    times = np.inf if grows < SHARED or there else times
    low, high = (strength, before.high) if own.sign < 0 else (before.low, strength)
    return Reach(low, high, float(np.fmax(before.times, times)), there)
