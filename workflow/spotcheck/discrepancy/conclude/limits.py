"""How large effects that were not found could still be."""

from collections.abc import Sequence

import numpy as np

from spotcheck.discrepancy.conclude.judgement import TIED_WITH_SHAPE, Limit
from spotcheck.discrepancy.evidence.laws import Laws
from spotcheck.discrepancy.observe.design import Design
from spotcheck.discrepancy.search.candidates import at_frames, scores, some_of, starts_of
from spotcheck.discrepancy.search.forward import Outcome
from spotcheck.model.effect import Context, Effect

# One-sided 95 % of a normal error.
ONE_SIDED = 1.645


def limits_of(
    outcome: Outcome, laws: Laws, design: Design, effects: Sequence[Effect], context: Context
) -> tuple[Limit, ...]:
    """Of every effect that was not found: the strength that frames leave room for (95 %), or that it is tied with the
    light's shape. Effects of pixels are told to first order, by some of the frames; of levels nothing is said."""
    found = {own.own.effect.name for own in outcome.found}
    tied = {own.effect.name for own in outcome.tied} - found
    out = {own.effect.name: _limit(own.effect, None) for own in outcome.tied if own.effect.name in tied}
    usable = [e for e in effects if np.isfinite(e.neutral) and e.name not in found | tied]
    far = _of_pixels(outcome, design, usable, context)
    out |= {effect.name: _limit(effect, far[effect.name]) for effect in usable if effect.name in far}
    for trial in laws.trials:
        effect = trial.present.effect
        if np.isfinite(effect.neutral):
            out[effect.name] = _limit(effect, abs(trial.value - effect.neutral) + ONE_SIDED * trial.error)
    return tuple(out.values())


def _limit(effect: Effect, distance: float | None) -> Limit:
    """A limit at so far from where an effect vanishes; None: tied with the light's shape."""
    own = effect.parameters[0]
    if distance is None:
        return Limit(effect.name, own.name, None, own.unit, TIED_WITH_SHAPE)
    return Limit(effect.name, own.name, float(effect.neutral + distance), own.unit, "not found")


def _of_pixels(outcome: Outcome, design: Design, effects: Sequence[Effect], context: Context) -> dict[str, float]:
    """How far from where it vanishes each effect may be, the farthest of its starts."""
    starts = starts_of(effects, context)
    if not starts:
        return {}
    few = some_of(design)
    small = at_frames(outcome.frames, outcome.after, few)
    # What all frames tell is known better than by the few, as their number says.
    more = np.sqrt(len(outcome.frames) / len(few))
    out: dict[str, float] = {}
    for own, score in zip(starts, scores([outcome.frames[k] for k in few], small, starts), strict=True):
        if score.information > 0:
            error = 1 / np.sqrt(score.information) / more
            size = max(score.size, 0.0) + ONE_SIDED * error
            distance = abs(own.values[0] - own.effect.neutral) * float(size)
            out[own.effect.name] = max(out.get(own.effect.name, 0.0), distance)
    return out
