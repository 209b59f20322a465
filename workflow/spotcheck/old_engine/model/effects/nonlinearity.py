"""Non-linearity: the response bends below saturation."""

from spotcheck.old_engine.model import response
from spotcheck.old_engine.model.effect import Effect, Parameter, Place
from spotcheck.old_engine.model.sensor import SensorModel


def bend(mean, variance, full_scale, *, q):
    """Mean and variance [DN] of y − q y²/full scale, y without black level; q > 0 bends down."""
    return response.bent(mean, variance, q / full_scale)


def further(sensor: SensorModel, *, q):
    """The bend of the response by the data sheet, and what comes on top: to first order they add up."""
    return {"sensor.response_bend": sensor.response_bend + q}


EFFECT = Effect(
    number=2,
    name="nonlinearity",
    sentence="the sensor's response bends below saturation",
    noun="bend of the response",
    part=True,
    place=Place.RESPONSE,
    parameters=(Parameter("q", "1", -0.6, 0.45),),
    starts=lambda c: [(0.02,)],
    function=bend,
    negligible=0.005,
    # What bends skews the noise.
    marks=("skewness",),
    flats="",
    adopts=further,
)
