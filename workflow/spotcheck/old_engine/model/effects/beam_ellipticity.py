"""Beam ellipticity: an ellipse fixed to the camera."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place
from spotcheck.old_engine.model.effects.fibre_anisotropy import squeeze


def stretch(view, dx, dy, *, ratio, direction):
    """Displacements that make the ellipse round again: long axis at `direction` [deg], `ratio` = long/short."""
    return squeeze(dx, dy, ratio, np.deg2rad(direction))


EFFECT = Effect(
    number=9,
    name="beam_ellipticity",
    sentence="the spot is an ellipse that keeps its direction on the camera",
    noun="ratio of axes that stay on the camera",
    place=Place.METRIC,
    parameters=(
        Parameter("ratio", "1", 1.0, 4.0),
        Parameter("direction", "deg", -np.inf, np.inf),
    ),
    starts=lambda c: [(1.02, direction) for direction in (0.0, 45.0, 90.0, 135.0)],
    function=stretch,
    neutral=1.0,
    negligible=0.005,
)
