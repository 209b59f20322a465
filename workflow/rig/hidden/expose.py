"""One frame drawn from a world: the chain of the contract, light to digital numbers."""

from __future__ import annotations

import numpy as np

from rig.hidden.designs import FRAME_PX, Shot
from rig.hidden.world import World

_PIXELS = np.arange(FRAME_PX)


def expose(world: World, shot: Shot, rng: np.random.Generator) -> np.ndarray:
    """A frame [DN], uint16 [rows, columns]."""
    base = world.base
    view = world.view(shot, _PIXELS, _PIXELS)
    rate = world.light(view) / base.gain + base.dark_current * view.state.t
    drawn = (effect.detect(rate, rng) for effect in world.effects)
    electrons = next((found for found in drawn if found is not None), None)
    if electrons is None:
        electrons = rng.poisson(rate).astype(float)
    for effect in world.effects:
        electrons = effect.electrons(electrons, view)
    noise = base.read_noise * rng.standard_normal(electrons.shape, dtype=np.float32)
    for effect in world.effects:
        noise = effect.read_noise(noise, base, rng)
    electrons += noise
    for effect in world.effects:
        electrons = effect.read(electrons, base)
    reading = base.gain * electrons
    for effect in world.effects:
        reading = effect.signal(reading, base)
    reading += base.black_level
    for effect in world.effects:
        reading = effect.reading(reading, view, rng)
    subtracted, dead = world.zero()
    reading -= subtracted
    if dead > 0.0:
        reading[reading < dead] = 0.0
    np.rint(reading, out=reading)
    np.clip(reading, 0, base.full_scale, out=reading)
    return reading.astype(np.uint16)
