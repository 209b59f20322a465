"""Laser drift: brightness runs steadily with the order of acquisition."""

from spotcheck.model.effect import Effect, Parameter, Place


def drift(view, *, total):
    """Factor 1 + total × (place in the order of acquisition, 0 to 1)."""
    return 1 + total * view.order


EFFECT = Effect(
    number=20,
    name="laser_drift",
    sentence="the brightness runs steadily with the order of acquisition",
    place=Place.BRIGHTNESS,
    parameters=(Parameter("total", "1", -0.95, 5.0),),
    starts=lambda c: [(0.02,)],
    function=drift,
    needs=("order", "law"),
)
