"""Smear: a share of the light of each column is added evenly to all its rows."""

import numpy as np

from spotcheck.model.effect import Effect, Only, Parameter, Stage, Step


def spread_columns(frame, mean_e, *, fraction):
    """Return the electrons that each pixel of a column gains [..., 1, column] in e-.

    They are `fraction` [1] of the sum of `mean_e`, the mean electrons [..., row, column], over the column, divided by
    the number of rows of the sensor. `frame.pixels.row_share` is the number of rows of the sensor for which a row of
    the grid stands in this sum.
    """
    # ASSUME: the charge is added and not taken from the column, as in frame-transfer read-out. The shot noise of the
    # added charge is neglected: it is small compared with that of a pixel.
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
