"""Excess read noise: more signal-independent white noise than stated."""

import numpy as np

from spotcheck.model.effect import Effect, Only, Parameter, Stage, Step


def replace_noise(variance_e2, *, total):
    """Return the variance [e-²] of `total` [e- rms], which replaces the stated noise."""
    return total * total


def state_noise(sensor, variant, *, total):
    """Return the read noise."""
    return {"sensor.read_noise_e": total}


EFFECT = Effect(
    number=18,
    name="excess_read_noise",
    sentence="the sensor's signal-independent noise is larger than stated",
    noun="read noise",
    parameters=(
        Parameter(
            "total",
            "e-",
            lambda scales: scales.read_noise_e,
            lambda scales: 1000 * (scales.read_noise_e + 1),
            negligible=lambda scales: 0.03 * scales.read_noise_e,
        ),
    ),
    variants={Only.ONLY: (Step(Stage.READ_NOISE, replace_noise),)},
    starts=lambda scales: [(1.05 * scales.read_noise_e + 0.1,)],
    vanishes_at=np.nan,
    acts_on_noise=True,
    hidden_in_flats="the noise of the darks is the measured one",
    instrument_keys=state_noise,
)
