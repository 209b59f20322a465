"""Non-linearity: the response bends below saturation."""

from spotcheck.model.effect import Effect, Parameter, Place


def bend(mean, variance, full_scale, *, q):
    """Mean and variance [DN] of y − q y²/full scale, y without black level; q > 0 bends down."""
    slope = 1 - 2 * q * mean / full_scale
    return mean - q * (mean * mean + variance) / full_scale, slope * slope * variance


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
)
