"""Excess read noise: the white noise that does not depend on the signal is larger than stated."""

from spotcheck.model.effect import Effect, Only, Parameter, Stage, Step


def replace_noise(variance_e2, *, total):
    """Return the variance [e-²] of a read noise `total` [e- rms], which replaces the stated one."""
    return total * total


def lowest_noise(scales):
    """Return the stated read noise [e- rms]."""
    return scales.read_noise_e


def highest_noise(scales):
    """Return the highest read noise [e- rms], which is above 0 even if the stated one is 0."""
    return 1000 * (scales.read_noise_e + 1)


def negligible_excess(scales):
    """Return the excess over the stated read noise [e- rms] that a user would call zero."""
    return 0.03 * scales.read_noise_e


EFFECT = Effect(
    number=18,
    name="excess_read_noise",
    sentence="the sensor's signal-independent noise is larger than stated",
    noun="read noise",
    parameters=(Parameter("total", "e-", lowest_noise, highest_noise, negligible=negligible_excess),),
    variants={Only.ONLY: (Step(Stage.READ_NOISE, replace_noise),)},
    starts=lambda scales: [(1.05 * scales.read_noise_e + 0.1,)],
    # It vanishes at the stated read noise, which depends on the dataset.
    vanishes_at=float("nan"),
    acts_on_noise=True,
    hidden_in_flats="the noise of the darks is the measured one",
    instrument_keys=lambda sensor, variant, total: {"sensor.read_noise_e": total},
)
