"""Interference fringes: parallel stripes that modulate the spot."""

from enum import Enum
from itertools import product

import numpy as np

from spotcheck.model.effect import DIRECTIONS, Effect, Parameter, RandomStep, Scope, Stage, Step

# Phases that average the stripes of a site whose phase is unknown; exact for a sum of as many harmonics.
PHASES = 16
# Phases [deg] from which stripes start.
PHASES_DEG = (0.0, 90.0, 180.0, 270.0)


class Variant(Enum):
    """To what the stripes are fixed."""

    SITE = "site"
    SPOT = "spot"
    SENSOR = "sensor"


def fix_to_spot(frame, light_dn, *, d, period, direction, phase):
    """Return the light [DN] with stripes that are counted from the spot's centre; phase in deg."""
    return fix_to_site(frame, light_dn, np.deg2rad(phase), d=d, period=period, direction=direction)


def fix_to_sensor(frame, light_dn, *, d, period, direction, phase):
    """Return the light [DN] with stripes that are counted from the corner of the sensor; phase in deg."""
    return light_dn * stripes(frame.pixels.x, frame.pixels.y, d, period, direction, np.deg2rad(phase))


def fix_to_site(frame, light_dn, phase_rad, *, d, period, direction):
    """Return the light [DN] with stripes around the spot's centre whose phase [rad] is drawn for each site."""
    return light_dn * stripes(frame.pixels.x - frame.x0, frame.pixels.y - frame.y0, d, period, direction, phase_rad)


def stripes(x, y, d, period, direction, phase_rad):
    """Return the factor 1 + d cos(2πu/period + phase) with u [px] across the stripes, at `direction` [deg]."""
    angle = np.deg2rad(direction)
    return 1 + d * np.cos(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period + phase_rad)


def draw_phase(rng, shape):
    """Return a phase [rad]."""
    return rng.uniform(0, 2 * np.pi)


def average_phases():
    """Return phases [rad] and their weights."""
    return 2 * np.pi * np.arange(PHASES) / PHASES, np.full(PHASES, 1 / PHASES)


def list_starts(scales):
    """Return starting values at the stripes of residuals, or without any at some periods and directions."""
    periods = (max(share * scales.sigma_px, 2.0) for share in (0.5, 1.0, 2.0))
    waves = scales.waves or tuple(product(periods, DIRECTIONS))
    return [(0.02, period, direction, phase) for period, direction in waves for phase in PHASES_DEG]


EFFECT = Effect(
    number=15,
    name="interference_fringes",
    sentence="parallel stripes modulate the spot",
    noun="depth of stripes",
    is_share=True,
    parameters=(
        Parameter("d", "1", 0.0, 1.0, negligible=0.003),
        Parameter("period", "px", 2.0, lambda scales: 1.5 * scales.crop_px),
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
