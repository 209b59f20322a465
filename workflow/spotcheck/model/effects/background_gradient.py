"""Background gradient: a pedestal that rises across the frame."""

import numpy as np

from spotcheck.model.effect import Effect, Parameter, Pedestal, Stage, Step


def add_slope(frame, pedestal_dn, *, slope, level, direction):
    """Return the pedestals so far [DN] plus one that rises linearly across the frame.

    It is `level` [DN] at the centre of the sensor and rises by `slope` [DN per 100 px] towards `direction` [deg from +x
    towards +y]. Where it would be negative it is 0. `frame.pixels` has x, y of the pixels and of the centre [px].
    """
    angle_rad, pixels = np.deg2rad(direction), frame.pixels
    # Distance from the centre of the sensor along the direction.
    distance_px = (pixels.x - pixels.centre_x) * np.cos(angle_rad) + (pixels.y - pixels.centre_y) * np.sin(angle_rad)
    return pedestal_dn + np.maximum(level + slope * distance_px / 100, 0.0)


EFFECT = Effect(
    number=5,
    name="background_gradient",
    sentence="a pedestal of light rises across the frame",
    noun="slope of a pedestal",
    parameters=(
        Parameter("slope", "DN per 100 px", 0.0, lambda scales: 0.3 * scales.full_scale_dn, negligible=0.1),
        Parameter("level", "DN", 0.0, lambda scales: 0.5 * scales.full_scale_dn),
        Parameter("direction", "deg"),
    ),
    variants={
        Pedestal.LIGHT: (Step(Stage.PEDESTAL, add_slope),),
        Pedestal.ELECTRONIC: (Step(Stage.BLACK_LEVEL, add_slope),),
    },
    starts=lambda scales: [(0.5, 1.0, direction) for direction in (0.0, 90.0, 180.0, 270.0)],
    special_cases=("dark_offset",),
    hidden_in_flats="levels are means over the frame",
)
