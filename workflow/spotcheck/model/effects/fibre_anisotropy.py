"""Fibre anisotropy: the spot is an ellipse whose long axis turns with the fibre angle."""

from enum import Enum

import numpy as np

from spotcheck.model.effect import DIRECTIONS, Effect, Need, Parameter, Stage, Step
from spotcheck.model.ellipse import make_round


class Variant(Enum):
    """Sense in which the long axis turns in the image if the fibre angle increases, which is not recorded."""

    SAME_SENSE = "same sense"
    OPPOSITE_SENSE = "opposite sense"


def stretch_along(frame, dx, dy, *, ratio, zero):
    """Return the displacements [px] on a round spot that correspond to dx, dy on the ellipse.

    `ratio` is the long over the short axis [1]. The direction of the long axis is the fibre angle, `frame.angle` [rad],
    plus `zero` [deg from +x towards +y].
    """
    return make_round(dx, dy, ratio, frame.angle + np.deg2rad(zero))


def stretch_against(frame, dx, dy, *, ratio, zero):
    """Return displacements [px] as `stretch_along` does, for a long axis at `zero` [deg] minus the fibre angle."""
    return make_round(dx, dy, ratio, np.deg2rad(zero) - frame.angle)


EFFECT = Effect(
    number=8,
    name="fibre_anisotropy",
    sentence="the spot is an ellipse whose long axis turns with the fibres",
    noun="ratio of axes that turn with the fibres",
    parameters=(
        Parameter("ratio", "1", 1.0, 4.0, negligible=0.005),
        Parameter("zero", "deg", is_variant_specific=True),
    ),
    variants={
        Variant.SAME_SENSE: (Step(Stage.COORDINATES, stretch_along),),
        Variant.OPPOSITE_SENSE: (Step(Stage.COORDINATES, stretch_against),),
    },
    starts=lambda scales: [(1.02, zero) for zero in DIRECTIONS],
    vanishes_at=1.0,
    needs=(Need.ANGLES,),
)
