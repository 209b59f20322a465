"""What dark pixels say of noise and level: effects that add white noise, or the same to every reading, are told by
their histogram alone."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import optimize

from spotcheck.old_engine.model.chain import View
from spotcheck.old_engine.model.effect import Context, Effect, Place, Present
from spotcheck.old_engine.nuisance.darkness import darkness
from spotcheck.old_engine.observe.pixels import Frame, Model


def strength_of(effect: Effect, stated_e: float, read_noise_e: float, context: Context) -> float:
    """The strength of an effect at `Place.NOISE` that makes a stated read noise [e-] another one; at the end of its
    bounds where none does."""
    low, high = effect.bounds(context)[0]

    def beyond(strength: float) -> float:
        own = Present(effect, effect.forms[0], (strength,))
        return float(own.apply(stated_e**2)) - read_noise_e**2

    if beyond(low) * beyond(high) > 0:
        return float(low if abs(beyond(low)) < abs(beyond(high)) else high)
    return float(optimize.brentq(beyond, low, high))


class Noisy(NamedTuple):
    """An effect that adds noise or moves the level, as dark pixels tell it; its strength's standard error; what −2 ln L
    gains: the square of the distance from what the sheet states, in errors of both; and how groups of frames agree
    about it: Q, which is χ² of one less than groups, and their number."""

    own: Present
    error: float
    gain: float
    q: float
    groups: int


def noises_of(
    frames: Sequence[Frame], groups: np.ndarray, model: Model, effects: Sequence[Effect], context: Context
) -> list[Noisy]:
    """What dark pixels say of every effect at `Place.NOISE`; `groups` [frame] parts frames that must agree."""
    whole, stated = darkness(frames, model), model.stated
    if whole is None or not np.isfinite(whole.read_noise_stderr):
        return []
    stated_e, error = stated.sensor.read_noise_e, float(np.hypot(whole.read_noise_stderr, stated.stderr[1]))
    q, told = agreement(frames, groups, model)
    out = []
    for effect in effects:
        if effect.place is Place.NOISE:
            own = Present(effect, effect.forms[0], (strength_of(effect, stated_e, whole.read_noise_e, context),))
            # Where darks show less noise than the effect can make, its error is that at the end of what it can.
            made_e = float(np.sqrt(own.apply(stated_e**2)))
            more = strength_of(effect, stated_e, made_e + error, context)
            gain = ((whole.read_noise_e - stated_e) / error) ** 2
            out.append(Noisy(own, abs(more - own.values[0]), gain, q, told))
    return out


def agreement(frames: Sequence[Frame], groups: np.ndarray, model: Model) -> tuple[float, int]:
    """Q of what the dark pixels of each group of frames say of the read noise, and how many groups do."""
    told: list[tuple[float, float]] = []
    for group in np.unique(groups):
        which = np.flatnonzero(groups == group)
        part = darkness([frames[int(k)] for k in which], model.take(which))
        if part is not None and np.isfinite(part.read_noise_stderr):
            told.append((part.read_noise_e, part.read_noise_stderr**-2))
    value, weight = np.array(told).reshape(-1, 2).T
    return float(weight @ (value - weight @ value / max(weight.sum(), 1e-300)) ** 2), len(told)


def level_of(frames: Sequence[Frame], model: Model, k: int) -> Noisy | None:
    """What dark pixels say of the effect of a number, which moves the level; None where they do not tell it."""
    own, stated = model.present[k], model.stated
    dark = darkness(frames, model.without(k))
    if dark is None or not np.isfinite(dark.black_level_stderr):
        return None
    shift = dark.black_level_dn - stated.sensor.black_level_dn
    error = float(np.hypot(dark.black_level_stderr, stated.stderr[2]))
    if model.lights is not None and len(model.lights.level) > 1:
        # Lights that have levels of their own tell what these have in common as well as they agree.
        error = float(np.hypot(error, np.std(model.lights.level, ddof=1) / np.sqrt(len(model.lights.level))))
    return Noisy(own, abs(own.values[0] / shift) * error if shift else np.inf, (shift / error) ** 2, 0.0, 1)


def levels_of(effects: Sequence[Effect], shift_dn: float, view: View, context: Context) -> list[Present]:
    """Effects that add the same to every reading, or take it off, as strong as a shift of the black level by so many DN
    needs."""
    out = []
    for effect in effects:
        for form in effect.forms:
            one = Present(effect, form, (1.0, *effect.starts(context)[0][1:])) if effect.moves_level(form) else None
            if one is None:
                continue
            by_one = float(np.mean(one.apply(view))) if effect.place is Place.PEDESTAL else -float(one.apply())
            low, high = effect.bounds(context)[0]
            if low <= shift_dn / by_one <= high:
                out.append(one._replace(values=(shift_dn / by_one, *one.values[1:])))
    return out
