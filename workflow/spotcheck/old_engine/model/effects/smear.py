"""Smear: light of each column spread evenly over its rows."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def smeared(view, electrons, *, fraction):
    """Electrons [e-] with `fraction` of each column's total spread over all rows of the frame.

    # ASSUME: the charge comes on top (it is not taken from the column), as frame-transfer read-out leaves it.
    """
    total = np.sum(electrons * view.rows_each, axis=-2, keepdims=True)
    return electrons + fraction * total / view.frame_rows


EFFECT = Effect(
    number=24,
    name="smear",
    sentence="light of each column is spread over its rows",
    noun="light smeared along columns",
    part=True,
    place=Place.CHARGE,
    parameters=(Parameter("fraction", "1", 0.0, 5.0),),
    starts=lambda c: [(0.005,)],
    function=smeared,
    negligible=0.002,
    # What smears along a column carries the column's noise.
    marks=("columns of a frame",),
    flats="the light is the same all over",
)
