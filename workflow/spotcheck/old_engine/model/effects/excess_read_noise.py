"""Excess read noise: more signal-independent white noise than stated."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def noise(read_variance, *, total):
    """Read variance [e-²] of `total` [e- rms], which takes the place of the stated one."""
    return total * total + 0 * read_variance


def stated(sensor, *, total):
    """The read noise."""
    return {"sensor.read_noise_e": total}


EFFECT = Effect(
    number=18,
    name="excess_read_noise",
    sentence="the sensor's signal-independent noise is larger than stated",
    noun="read noise",
    place=Place.NOISE,
    parameters=(Parameter("total", "e-", lambda c: c.read_noise_e, lambda c: 1000 * (c.read_noise_e + 1)),),
    starts=lambda c: [(1.05 * c.read_noise_e + 0.1,)],
    function=noise,
    neutral=np.nan,
    negligible=lambda c: 0.03 * c.read_noise_e,
    # The scatter of pixels tells it, not the means: the joint fit of the means leaves it as it is.
    idle={"": ("total",)},
    always=True,
    flats="the noise of the darks is the measured one",
    adopts=stated,
)
