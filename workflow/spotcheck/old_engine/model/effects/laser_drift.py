"""Laser drift: brightness runs steadily with the order of acquisition."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place

FORMS = ("linear", "settling")
# A rate nearer to 0 than this is that of a straight line.
STRAIGHT = 1e-6


def drift(view, *, total, rate, form):
    """Factor 1 + total × course, mean over a view's frames. The course runs from 0 to 1 with the place in the order of
    acquisition: as it, or as a laser that warms up, by 1 − exp(−rate × place); below 0 it grows by equal factors."""
    rate = rate if abs(rate) > STRAIGHT else STRAIGHT
    course = np.expm1(-rate * view.order) / np.expm1(-rate) if form == "settling" else view.order
    return 1 + total * np.nanmean(course, axis=2, keepdims=True)


EFFECT = Effect(
    number=20,
    name="laser_drift",
    sentence="the brightness runs steadily with the order of acquisition",
    noun="drift of brightness",
    part=True,
    place=Place.BRIGHTNESS,
    parameters=(Parameter("total", "1", -0.95, 5.0), Parameter("rate", "1", -5.0, 20.0, inner=True)),
    starts=lambda c: [(0.02, 2.0)],
    function=drift,
    forms=FORMS,
    negligible=0.005,
    idle={"linear": ("rate",)},
    needs=("order", "law"),
    flats="levels are compared, not the order of frames",
)
