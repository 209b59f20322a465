"""Beam ellipticity: the spot is an ellipse whose direction is fixed to the camera."""

import numpy as np

from spotcheck.model.effect import DIRECTIONS, Effect, Only, Parameter, Stage, Step
from spotcheck.model.ellipse import make_round


def stretch(frame, dx, dy, *, ratio, direction):
    """Return the displacements [px] on a round spot that correspond to dx, dy on the ellipse.

    `ratio` is the long over the short axis [1], `direction` that of the long axis [deg from +x towards +y].
    """
    return make_round(dx, dy, ratio, np.deg2rad(direction))


EFFECT = Effect(
    number=9,
    name="beam_ellipticity",
    sentence="the spot is an ellipse that keeps its direction on the camera",
    noun="ratio of axes that stay on the camera",
    parameters=(Parameter("ratio", "1", 1.0, 4.0, negligible=0.005), Parameter("direction", "deg")),
    variants={Only.ONLY: (Step(Stage.COORDINATES, stretch),)},
    starts=lambda scales: [(1.02, direction) for direction in DIRECTIONS],
    vanishes_at=1.0,
    is_static_shape=True,
)
