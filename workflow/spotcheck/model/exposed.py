"""Random frames of the extended model: the chain of `model.chain` drawn instead of averaged, in the same order.

Effects that have a mean act through the same functions as there, on what was drawn and with a variance of 0; those that
only scatter draw here. Every random number belongs to a frame, a site or the sensor, and to one effect: so a frame is
the same whatever the order or number of cores, and an effect more leaves the draws of all others as they were.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Free, Law, View, light, true_exposure
from spotcheck.model.effect import Effect, Place, Present
from spotcheck.model.response import bent
from spotcheck.model.sensor import SensorModel

# More electrons than any converter reads; beyond, Poisson draws overflow.
MOST_ELECTRONS = 1e12


class Chance(NamedTuple):
    """What a frame's random numbers come from: the seed, the frame's number and that of its site."""

    seed: int
    frame: int
    site: int

    def readings(self) -> np.random.Generator:
        """For the frame's own noise: that of `simulate.frame_generators`."""
        return _generator(self.seed, self.frame)

    def of(self, effect: Effect, shared: str) -> np.random.Generator:
        """For an effect whose draws a `frame`, a `site` or the `sensor` shares."""
        return _generator(self.seed, effect.number, self.key(shared))

    def key(self, shared: str) -> int:
        """Number of the frame or site; there is one sensor."""
        return {"frame": self.frame, "site": self.site, "sensor": 0}[shared]


def expose(
    view: View,
    baseline: Baseline,
    base: Law | Free,
    present: Sequence[Present],
    sensor: SensorModel,
    chance: Chance,
) -> np.ndarray:
    """One random frame [row, column] in DN (uint16). `view` holds a single frame, one point a pixel."""
    shape = (view.y.size, view.x.size)
    view = view._replace(**_scattered_view(view, present, chance))
    gain = float(np.prod([own.apply(rng) for own, rng in _scatters(present, "gain", chance)]))
    own, beside = (np.broadcast_to(part, (1, *shape))[0] for part in light(view, baseline, base, present, gain))
    # What belongs to a site acts on its light; what belongs to the sensor on all that falls there.
    total = own * _fields(present, ("site", "frame"), shape, chance) + beside
    total = total * _fields(present, ("sensor",), shape, chance)
    dark_e = float(np.squeeze(sensor.dark_current_e_per_s * true_exposure(view, present)))
    mean_e = np.clip(total / sensor.gain_dn_per_e + dark_e, 0.0, MOST_ELECTRONS)
    rows = sum(own.apply(shape[0], rng) for own, rng in _scatters(present, "row", chance))
    return _read(mean_e, view, present, sensor, np.reshape(rows, (-1, 1)), chance.readings())


def _read(
    mean_e: np.ndarray,
    view: View,
    present: Sequence[Present],
    sensor: SensorModel,
    rows_dn: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """The sensor's part of the chain: readings [row, column] from mean electrons, and an offset [DN] of each row."""

    def at(place: Place) -> list[Present]:
        return [own for own in present if own.effect.place is place]

    gain = sensor.gain_dn_per_e
    electrons = rng.poisson(mean_e).astype(float)
    for own in at(Place.CHARGE):
        electrons = own.apply(view, electrons)
    signal = gain * np.minimum(electrons, sensor.full_well_e)
    read_variance = sensor.read_noise_e**2
    for own in at(Place.NOISE):
        read_variance = own.apply(read_variance)
    noise = gain * np.sqrt(read_variance) * rng.standard_normal(signal.shape)
    # A well clips charge, a converter the signal with its read noise.
    for own in at(Place.WELL):
        if not own.form.endswith("with noise"):
            signal = own.apply(signal, 0.0, 0.0)[0]
    signal = signal + noise
    for own in at(Place.WELL):
        if own.form.endswith("with noise"):
            signal = own.apply(signal, 0.0, 0.0)[0]
    if sensor.curvature:
        signal = bent(signal, 0.0, sensor.curvature)[0]
    for own in at(Place.RESPONSE):
        signal = own.apply(signal, 0.0, sensor.full_scale_dn)[0]
    signal = signal + sensor.black_level_dn + rows_dn
    for own in at(Place.PEDESTAL):
        if own.form == "electronic":
            signal = signal + np.squeeze(own.apply(view), axis=0)
    for own in at(Place.DIGITAL):
        lowest = own.apply()
        signal = signal - lowest if own.form == "subtracted" else np.where(signal < lowest, 0.0, signal)
    return np.clip(np.rint(signal), 0, min(sensor.full_scale_dn, 65535)).astype(np.uint16)


def _scattered_view(view: View, present: Sequence[Present], chance: Chance) -> dict[str, Any]:
    """What a frame's view has of its own: a centre that scatters, fringes of any phase."""
    shift = sum((own.apply(rng) for own, rng in _scatters(present, "centre", chance)), np.zeros(2))
    changed = {"x0": view.x0 + shift[0], "y0": view.y0 + shift[1]}
    for own in present:
        if own.effect.spectral and own.form == "site":
            phase = chance.of(own.effect, "site").uniform(0, 2 * np.pi)
            waves = own.values[0] * np.cos(phase), own.values[0] * np.sin(phase)
            changed |= {"wave_cos": view.wave_cos + waves[0], "wave_sin": view.wave_sin + waves[1]}
    return changed


def _scatters(present: Sequence[Present], of: str, chance: Chance) -> Iterator[tuple[Present, np.random.Generator]]:
    """Effects that scatter a certain thing, each with its generator."""
    for own in present:
        scatter = own.effect.scatter
        if scatter is not None and scatter.of == of:
            yield own, chance.of(own.effect, scatter.shared)


def _fields(present: Sequence[Present], shared: Sequence[str], shape: tuple[int, int], chance: Chance):
    """Product of random fields [row, column]; 1 where there is none."""
    product: float | np.ndarray = 1.0
    for own in present:
        scatter = own.effect.scatter
        if scatter is not None and scatter.of == "field" and scatter.shared in shared:
            values, key = tuple(own.named().items()), chance.key(scatter.shared)
            product = product * _field(own.effect.function, values, shape, chance.seed, own.effect.number, key)
    return product


@lru_cache(maxsize=2)
def _field(
    function: Callable[..., np.ndarray],
    values: tuple[tuple[str, float], ...],
    shape: tuple[int, int],
    seed: int,
    number: int,
    key: int,
) -> np.ndarray:
    """A field, kept for the next frame: those of a site follow each other, and the sensor has one for all."""
    return function(shape, _generator(seed, number, key), **dict(values))


def _generator(seed: int, *key: int) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)))
