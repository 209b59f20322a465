"""Parameters of a model that a fit may change: those of effects, of the sensor, and how uneven a level is."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine.model.effect import Context, Place, Present
from spotcheck.old_engine.model.sensor import SensorModel
from spotcheck.old_engine.observe.pixels import Expectation, Expected, Frame, Model, scatters

# Part of a parameter's value, or of its start, by which slopes are taken; a direction has no size of its own [deg].
NUDGE, TURN = 1e-3, 20.0
# In place of an effect: the sensor, and which of its numbers may be free.
SENSOR, SENSOR_NUMBERS = -1, ("gain_dn_per_e", "read_noise_e", "black_level_dn")
# Lowest read noise [e-] whose step is a part of itself, and the step of a black level [DN].
LEAST_E, STEP_DN = 0.1, 0.01
# Least gain in parts of the stated one.
LEAST_GAIN = 0.1
# A fit may move a number by so many stated errors: beyond, the sheet is of another camera, or what is missing in the
# model passes for noise.
FARTHEST_SHEET = 10.0
# In place of an effect: by which part of itself the level at which a signal stops differs from pixel to pixel; and the
# least and the most that it may be: a thousandth is lost in read noise, more than a tenth is no level.
UNEVEN, LEAST_UNEVEN, MOST_UNEVEN = -2, 1e-3, 0.1
# The least contrast of a field: at 0 the variance, which goes with its square, would not lead away.
LEAST_FIELD = 2e-3


class Free(NamedTuple):
    """One free parameter: of which effect (or `SENSOR`), which one, its bounds, the step of its slope; and the centre
    and precision (one over the variance) of what is known of it beforehand."""

    effect: int
    parameter: int
    low: float
    high: float
    nudge: float
    centre: float = 0.0
    precision: float = 0.0


def free_of(model: Model, context: Context) -> tuple[Free, ...]:
    """The parameters of a model's effects that a fit may change: a shape is learned, and of what scatters, variance
    tells a field's strength alone."""
    out = []
    for e, own in enumerate(model.present):
        pattern = own.effect.scatter and not scatters(own.effect, "field")
        if own.effect.place is Place.SHAPE or pattern or of_dark(model, own):
            continue
        starts = np.abs(np.array([*own.effect.starts(context), own.values], float))
        bounds = own.effect.bounds(context)
        for p, parameter in enumerate(own.effect.parameters):
            # A strength that means do not tell, noise does where it is one of noise.
            told = own.effect.place is Place.NOISE or parameter.name not in own.effect.idle.get(own.form, ())
            if own.effect.scatter:
                told, bounds[0, 0] = p == 0, max(bounds[0, 0], LEAST_FIELD)
            if told:
                scale = max(abs(own.values[p]), float(np.median(starts[:, p])), 1e-12)
                scale = TURN if parameter.unit == "deg" else scale
                out.append(Free(e, p, float(bounds[p, 0]), float(bounds[p, 1]), NUDGE * scale))
    if any(own.effect.place is Place.WELL for own in model.present):
        out.append(Free(UNEVEN, 0, LEAST_UNEVEN, MOST_UNEVEN, NUDGE * model.uneven))
    return tuple(out)


def of_noise(model: Model, own: Free) -> bool:
    """Whether a parameter changes noise, and means next to nothing."""
    if own.effect < 0:
        return own.effect == UNEVEN or SENSOR_NUMBERS[own.parameter] == "read_noise_e"
    effect = model.present[own.effect].effect
    return effect.place is Place.NOISE or effect.scatter is not None


def lone(model: Model) -> bool:
    """Whether each frame has a learned light of its own."""
    return model.lights is not None and len(model.lights.coefficients) == len(model.numbers.x)


def of_dark(model: Model, own: Present) -> bool:
    """Whether dark pixels alone tell an effect: what moves the level, which the shape of a frame's own light would take
    for its own."""
    return lone(model) and own.effect.moves_level(own.form) and not model.stated.free[2]


def free_of_sheet(model: Model) -> tuple[Free, ...]:
    """The numbers of a sheet that have an error and that nothing else tells: they are free in every fit, about what is
    stated."""
    stated = model.stated
    values = values_of_sensor(stated.sensor)
    least = (LEAST_GAIN * values[0], 0.0, -np.inf)
    steps = (NUDGE * values[0], NUDGE * max(values[1], LEAST_E), STEP_DN)
    out = []
    for p, error in enumerate(stated.stderr):
        if error > 0 and stated.free[p]:
            far = FARTHEST_SHEET * error
            low, high = max(values[p] - far, least[p]), values[p] + far
            out.append(Free(SENSOR, p, low, high, steps[p], values[p], 1 / error**2))
    return tuple(out)


def values_of_sensor(sensor: SensorModel) -> list[float]:
    """Gain, read noise and black level."""
    return [float(getattr(sensor, name)) for name in SENSOR_NUMBERS]


def changed(model: Model, free: Sequence[Free], values: Sequence[float]) -> Model:
    """A model with other values of its free parameters, kept within their bounds."""
    every = [list(own.values) for own in model.present]
    sensor, uneven = model.sensor, model.uneven
    for own, value in zip(free, values, strict=True):
        value = float(np.clip(value, own.low, own.high))
        if own.effect == UNEVEN:
            uneven = value
        elif own.effect == SENSOR:
            if own.parameter == 0 and not model.stated.free[1]:
                # Dark pixels tell their noise in DN, whatever the gain.
                sensor = sensor._replace(read_noise_e=sensor.read_noise_e * sensor.gain_dn_per_e / value)
            sensor = sensor._replace(**{SENSOR_NUMBERS[own.parameter]: value})
        else:
            every[own.effect][own.parameter] = value
    present = tuple(own._replace(values=tuple(v)) for own, v in zip(model.present, every, strict=True))
    return model._replace(present=present, sensor=sensor, uneven=uneven)


def values_of(model: Model, free: Sequence[Free]) -> np.ndarray:
    """Values of the free parameters."""
    return np.array([_value(model, own) for own in free])


def _value(model: Model, own: Free) -> float:
    if own.effect == UNEVEN:
        return model.uneven
    if own.effect == SENSOR:
        return float(getattr(model.sensor, SENSOR_NUMBERS[own.parameter]))
    return model.present[own.effect].values[own.parameter]


def nudged(model: Model, own: Free) -> tuple[Model, float]:
    """The model with a free parameter a small step off, and that step: away from a bound, or nothing would change."""
    value = _value(model, own)
    step = -own.nudge if value + own.nudge > own.high else own.nudge
    return changed(model, [own], [value + step]), step


Nudged = list[tuple[Expectation, float]]


def nudged_of(frames: Sequence[Frame], ready: Expectation, free: Sequence[Free]) -> Nudged:
    """A model with each free parameter a small step off, and that step."""
    model = ready.model
    steps = (nudged(model, own) for own in free)
    return [(Expectation(frames, other, ready), step) for other, step in steps]


def changes_of(frame: Frame, k: int, seen: Expected, nudged: Nudged) -> list[tuple[np.ndarray, np.ndarray]]:
    """Slopes of mean and variance [row, column] by each free parameter."""
    then = [(other.of(frame, k, seen), step) for other, step in nudged]
    return [((o.mean - seen.mean) / step, (o.variance - seen.variance) / step) for o, step in then]
