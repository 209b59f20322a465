"""Black clipping: the zero of the converter lies above true black, or all signals below a threshold read 0."""

from enum import Enum

import numpy as np

from spotcheck.model.effect import Effect, Parameter, Stage, Step


class Variant(Enum):
    """The way in which faint signals are lost."""

    SUBTRACTED = "subtracted"
    DEAD_ZONE = "dead zone"


def subtract(signal_dn, *, threshold):
    """Return the signal [DN] minus `threshold` [DN]; readings are later limited to 0."""
    return signal_dn - threshold


def cut_dead_zone(signal_dn, *, threshold):
    """Return the signal [DN], replaced by 0 where it is below `threshold` [DN]."""
    return np.where(signal_dn < threshold, 0.0, signal_dn)


def find_instrument_keys(sensor, variant, *, threshold):
    """Return the key of instrument.yaml, with its value, that does the same: a black level lower by `threshold` [DN].

    {} for a dead zone, which no key describes, and for a black level below 0. `sensor` is a `SensorModel`.
    """
    level_dn = sensor.black_level_dn - threshold
    return {"sensor.black_level_dn": level_dn} if variant is Variant.SUBTRACTED and level_dn >= 0 else {}


EFFECT = Effect(
    number=3,
    name="black_clipping",
    sentence="the converter's zero lies above true black: the faint border of the spot is lost",
    noun="signal lost at black",
    parameters=(Parameter("threshold", "DN", 0.0, lambda scales: 0.5 * scales.peak_dn + 40.0, negligible=0.1),),
    variants={
        Variant.SUBTRACTED: (Step(Stage.DIGITAL, subtract),),
        Variant.DEAD_ZONE: (Step(Stage.DIGITAL, cut_dead_zone),),
    },
    starts=lambda scales: [(1.0,), (4.0,), (0.6,), (0.03 * scales.peak_dn,)],
    hidden_in_flats="",
    instrument_keys=find_instrument_keys,
)
