"""Expected mean and variance of every pixel's reading: the chain once more, in moments."""

from __future__ import annotations

from rig.hidden.clipping import clip_above, digitised
from rig.hidden.effect import Moments
from rig.hidden.world import View, World


def moments(world: World, view: View) -> Moments:
    """Mean [DN] and variance [DN^2] of the reading; effects that scatter belong in neither (see `World.steady`)."""
    base = world.base
    mean = world.light(view) / base.gain + base.dark_current * view.state.t
    variance = mean
    for effect in world.effects:
        mean, variance = effect.electron_moments(mean, variance, view)
    variance = variance + base.read_noise**2
    for effect in world.effects:
        mean, variance = effect.read_moments(mean, variance, base)
    mean, variance = base.gain * mean, base.gain**2 * variance
    for effect in world.effects:
        mean, variance = effect.signal_moments(mean, variance, base)
    mean = mean + base.black_level
    for effect in world.effects:
        mean, variance = effect.reading_moments(mean, variance, view)
    subtracted, dead = world.zero()
    mean, variance = digitised(mean - subtracted, variance, dead)
    return clip_above(mean, variance, base.full_scale)
