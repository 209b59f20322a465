"""Distributions of readings for tests of the sensor: sensors by a few numbers, and functions at their stages."""

import numpy as np

from spotcheck.sensor import ReadingDistribution, SensorModel

# Shares of pixels whose charge stops at a level [DN].
LEVELS = ((0.3, 20.0), (0.45, 33.3), (0.25, 52.0))


def sensor(gain, noise_e, bits, black=0.0, well_e=np.inf, bend=0.0, dark_e=0.0, **stages) -> ReadingDistribution:
    """Return the distribution of a sensor whose exposure is 1 s."""
    return ReadingDistribution(
        SensorModel(gain, noise_e, dark_e, well_e, black, 2.0**bits - 1, 1.0, bend), exposure_s=1.0, **stages
    )


def upper_end(reading: ReadingDistribution) -> float:
    """Return the light [DN] at which the sensor is full or reads full scale, whichever is less."""
    model = reading.sensor
    return min(model.full_well_e * model.gain_dn_per_e, model.full_scale_dn - model.black_level_dn)


def dead_zone(x):
    """Return a signal [DN] that is 0 below 6.2 DN: a digital stage."""
    return np.where(x < 6.2, 0.0, x)


def subtraction(x):
    """Return a signal minus 2.7 DN, not below 0: a digital stage."""
    return np.maximum(x - 2.7, 0.0)
