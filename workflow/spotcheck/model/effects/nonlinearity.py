"""Nonlinearity: the response of the sensor has a curvature below saturation."""

from spotcheck.model.effect import Effect, Only, Parameter, Stage, Step
from spotcheck.sensor.response import apply_curvature


def curve_response(signal_dn, *, q, full_scale_dn):
    """Return y − `q` y²/`full_scale_dn` [DN] for a signal y [DN] without black level.

    With `q` > 0 [1] the response bends down.
    """
    return apply_curvature(signal_dn, q / full_scale_dn)


EFFECT = Effect(
    number=2,
    name="nonlinearity",
    sentence="the sensor's response bends below saturation",
    noun="bend of the response",
    is_share=True,
    parameters=(Parameter("q", "1", -0.6, 0.45, negligible=0.005),),
    variants={Only.ONLY: (Step(Stage.RESPONSE, curve_response),)},
    starts=lambda scales: [(0.02,)],
    hidden_in_flats="",
    # To first order the curvature adds to that of the data sheet.
    instrument_keys=lambda sensor, variant, q: {"sensor.response_bend": sensor.response_bend + q},
)
