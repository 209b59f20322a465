"""Interference fringes: parallel stripes that modulate the spot."""

from enum import Enum
from itertools import product

import numpy as np

from spotcheck.model.effect import DIRECTIONS, Effect, Parameter, RandomStep, Scope, Stage, Step

# Number of equidistant phases over which stripes of unknown phase are averaged: exact for fewer harmonics than this.
PHASE_COUNT = 16
# Starting values: phases [deg], periods in widths σ_g of the spot, and depth [1].
START_PHASES, START_PERIODS, START_DEPTH = (0.0, 90.0, 180.0, 270.0), (0.5, 1.0, 2.0), 0.02
# Shortest period that pixels resolve [px].
LEAST_PERIOD_PX = 2.0


class Variant(Enum):
    """Reference of the phase of the stripes: drawn for each site, fixed to the spot, or fixed to the sensor."""

    SITE = "site"
    SPOT = "spot"
    SENSOR = "sensor"


def fix_to_spot(frame, light_dn, *, d, period, direction, phase):
    """Return the light [DN] with stripes whose `phase` [deg] refers to the centre of the spot; see `stripes`."""
    return fix_to_site(frame, light_dn, np.deg2rad(phase), d=d, period=period, direction=direction)


def fix_to_sensor(frame, light_dn, *, d, period, direction, phase):
    """Return the light [DN] with stripes whose `phase` [deg] refers to pixel (0, 0) of the sensor; see `stripes`."""
    return light_dn * stripes(frame.pixels.x, frame.pixels.y, d, period, direction, np.deg2rad(phase))


def fix_to_site(frame, light_dn, phase_rad, *, d, period, direction):
    """Return the light [DN] with stripes whose phase [rad] at the spot's centre is drawn per site; see `stripes`."""
    return light_dn * stripes(frame.pixels.x - frame.x0, frame.pixels.y - frame.y0, d, period, direction, phase_rad)


def stripes(x, y, d, period, direction, phase_rad):
    """Return the factor 1 + `d` cos(2π u/`period` + `phase_rad`) [1], with the depth `d` [1] and the period [px].

    u [px] is the component of (x, y) [px] along `direction` [deg from +x towards +y], which is across the stripes.
    """
    angle_rad = np.deg2rad(direction)
    return 1 + d * np.cos(2 * np.pi * (x * np.cos(angle_rad) + y * np.sin(angle_rad)) / period + phase_rad)


def draw_phase(rng, shape):
    """Return a uniform random phase [rad], a number for any shape of the frame."""
    return rng.uniform(0, 2 * np.pi)


def average_phases():
    """Return equidistant phases [node] in rad and their weights [node], which average over a uniform phase."""
    return 2 * np.pi * np.arange(PHASE_COUNT) / PHASE_COUNT, np.full(PHASE_COUNT, 1 / PHASE_COUNT)


def list_starts(scales):
    """Return starts (d, period, direction, phase) at the stripes found in residuals.

    Without any found, they are at `START_PERIODS` and `DIRECTIONS`.
    """
    periods = (max(widths * scales.sigma_px, LEAST_PERIOD_PX) for widths in START_PERIODS)
    waves = scales.waves or tuple(product(periods, DIRECTIONS))
    return [(START_DEPTH, period, direction, phase) for period, direction in waves for phase in START_PHASES]


EFFECT = Effect(
    number=15,
    name="interference_fringes",
    sentence="parallel stripes modulate the spot",
    noun="depth of stripes",
    is_share=True,
    parameters=(
        Parameter("d", "1", 0.0, 1.0, negligible=0.003),
        Parameter("period", "px", LEAST_PERIOD_PX, lambda scales: 1.5 * scales.crop_px),
        Parameter("direction", "deg"),
        Parameter("phase", "deg", is_variant_specific=True),
    ),
    variants={
        Variant.SITE: (RandomStep(Stage.MODULATION, fix_to_site, Scope.SITE, draw_phase, average_phases),),
        Variant.SPOT: (Step(Stage.MODULATION, fix_to_spot),),
        Variant.SENSOR: (Step(Stage.MODULATION, fix_to_sensor),),
    },
    starts=list_starts,
)
