"""Smear: light of each column spread evenly over its rows."""

import numpy as np

from spotcheck.model.effect import Effect, Only, Parameter, Stage, Step


def spread_columns(frame, mean_e, *, fraction):
    """Return `fraction` of the electrons of each column, spread over all rows of the sensor [e-]."""
    # ASSUME: the charge comes on top (it is not taken from the column), as frame-transfer read-out leaves it. Its own
    # noise, that of a sum over a column, is small beside that of a pixel.
    column_sum = np.sum(mean_e * frame.pixels.row_share, axis=-2, keepdims=True)
    return fraction * column_sum / frame.pixels.sensor_rows


EFFECT = Effect(
    number=24,
    name="smear",
    sentence="light of each column is spread over its rows",
    noun="light smeared along columns",
    is_share=True,
    parameters=(Parameter("fraction", "1", 0.0, 5.0, negligible=0.002),),
    variants={Only.ONLY: (Step(Stage.SMEAR, spread_columns),)},
    starts=lambda scales: [(0.005,)],
    hidden_in_flats="the light is the same all over",
)
