"""Laser drift: the brightness changes steadily with the order of acquisition."""

from enum import Enum

import numpy as np

from spotcheck.model.effect import Effect, Need, Parameter, Stage, Step

# Rates nearer to 0 are replaced by this one: the drift is then linear, and 0/0 is avoided.
LEAST_RATE = 1e-6


class Variant(Enum):
    """Course of the drift over the order of acquisition."""

    LINEAR = "linear"
    SETTLING = "settling"


def drift_linearly(frame, peak_dn, *, total):
    """Return the peak [DN] times 1 + `total` · `frame.order`, the place in the order of acquisition from 0 to 1."""
    return peak_dn * (1 + total * frame.order)


def settle(frame, peak_dn, *, total, rate):
    """Return the peak [DN] times 1 + `total` · (1 − exp(−`rate` · place))/(1 − exp(−`rate`)).

    The place in the order of acquisition, `frame.order`, runs from 0 to 1; `total` and `rate` have no unit. With `rate`
    > 0 the brightness settles; with `rate` < 0 the drift accelerates exponentially.
    """
    rate = rate if abs(rate) > LEAST_RATE else LEAST_RATE
    return peak_dn * (1 + total * np.expm1(-rate * frame.order) / np.expm1(-rate))


EFFECT = Effect(
    number=20,
    name="laser_drift",
    sentence="the brightness runs steadily with the order of acquisition",
    noun="drift of brightness",
    is_share=True,
    parameters=(
        Parameter("total", "1", -0.95, 5.0, negligible=0.005),
        Parameter("rate", "1", -5.0, 20.0, is_variant_specific=True),
    ),
    variants={
        Variant.LINEAR: (Step(Stage.BRIGHTNESS, drift_linearly),),
        Variant.SETTLING: (Step(Stage.BRIGHTNESS, settle),),
    },
    starts=lambda scales: [(0.02, 2.0)],
    law_of="brightness",
    needs=(Need.ORDER, Need.LAW),
    hidden_in_flats="levels are compared, not the order of frames",
)
