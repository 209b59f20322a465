"""Black clipping: the converter's zero lies above true black, or a dead zone reads 0."""

from enum import Enum

import numpy as np

from spotcheck.model.effect import Effect, Parameter, Stage, Step


class Variant(Enum):
    """How the faint end is lost."""

    SUBTRACTED = "subtracted"
    DEAD_ZONE = "dead zone"


def subtract(signal_dn, *, threshold):
    """Return the signal [DN] less the threshold; what falls below 0 reads 0."""
    return signal_dn - threshold


def cut_dead_zone(signal_dn, *, threshold):
    """Return the signal [DN], 0 below the threshold."""
    return np.where(signal_dn < threshold, 0.0, signal_dn)


def lower_black_level(sensor, variant, *, threshold):
    """Return the black level that is left, if it is not below 0; no key describes a dead zone."""
    left = sensor.black_level_dn - threshold
    return {"sensor.black_level_dn": left} if variant is Variant.SUBTRACTED and left >= 0 else {}


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
    instrument_keys=lower_black_level,
)
