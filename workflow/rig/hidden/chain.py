"""The chain of the sensor, light to digital numbers: drawn, and in mean and variance."""

from __future__ import annotations

import numpy as np

from rig.hidden.clipping import clip_above, digitised
from rig.hidden.designs import FRAME_PX, Shot
from rig.hidden.effect import Moments
from rig.hidden.world import View, World

_PIXELS = np.arange(FRAME_PX)


def expose(world: World, shot: Shot, rng: np.random.Generator) -> np.ndarray:
    """Draw a frame [DN], uint16 [rows, columns]."""
    base, effect = world.base, world.effect
    view = world.view(shot, _PIXELS, _PIXELS)
    rate = world.light(view) / base.gain + base.dark_current * view.state.t
    electrons = effect.electrons(rng.poisson(rate).astype(float), view)
    noise = base.read_noise * rng.standard_normal(electrons.shape, dtype=np.float32)
    electrons += effect.read_noise(noise)
    reading = effect.signal(base.gain * effect.read(electrons), base)
    reading += base.black_level
    reading = effect.reading(reading, view, rng)
    subtracted, dead = effect.zero()
    reading -= subtracted
    if dead > 0.0:
        reading[reading < dead] = 0.0
    np.rint(reading, out=reading)
    np.clip(reading, 0, base.full_scale, out=reading)
    return reading.astype(np.uint16)


def moments(world: World, view: View) -> Moments:
    """Mean [DN] and variance [DN^2] of each pixel's reading; an effect that scatters belongs in neither."""
    base, effect = world.base, world.effect
    rate = world.light(view) / base.gain + base.dark_current * view.state.t
    mean, variance = effect.electron_moments(rate, rate, view)
    mean, variance = effect.read_moments(mean, variance + base.read_noise**2, base)
    mean, variance = effect.signal_moments(base.gain * mean, base.gain**2 * variance, base)
    mean, variance = effect.reading_moments(mean + base.black_level, variance, view)
    subtracted, dead = effect.zero()
    mean, variance = digitised(mean - subtracted, variance, dead)
    return clip_above(mean, variance, base.full_scale)
