"""Background gradient: a pedestal that rises across the frame."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def slope_across(view, *, level, slope, direction, form):
    """Pedestal [DN]: `level` at the frame's centre, `slope` [DN per 100 px] uphill towards `direction` [deg from +x
    towards +y]; never below 0."""
    angle = np.deg2rad(direction)
    along = (view.x - view.frame_x) * np.cos(angle) + (view.y - view.frame_y) * np.sin(angle)
    return np.maximum(level + slope * along / 100, 0.0)


EFFECT = Effect(
    number=5,
    name="background_gradient",
    sentence="a pedestal of light rises across the frame",
    noun="slope of a pedestal",
    place=Place.PEDESTAL,
    parameters=(
        Parameter("slope", "DN per 100 px", 0.0, lambda c: 0.3 * c.full_scale_dn),
        Parameter("level", "DN", 0.0, lambda c: 0.5 * c.full_scale_dn),
        Parameter("direction", "deg", -np.inf, np.inf),
    ),
    starts=lambda c: [(0.5, 1.0, direction) for direction in (0.0, 90.0, 180.0, 270.0)],
    function=slope_across,
    forms=("light", "electronic"),
    negligible=0.1,
    contains=("dark_offset",),
    flats="levels are means over the frame",
)
