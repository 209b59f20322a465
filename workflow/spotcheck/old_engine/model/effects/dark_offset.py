"""Dark offset: a uniform pedestal, of ambient light or of the black level."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def pedestal(view, *, level, form):
    """Pedestal [DN]; as `light` it brings shot noise, as `electronic` it does not (the chain sees to that)."""
    return np.broadcast_to(np.asarray(level, float), view.x0.shape)


def raised(sensor, *, level, form):
    """The black level that an electronic pedestal makes; light is no number of the sensor."""
    return {"sensor.black_level_dn": sensor.black_level_dn + level} if form == "electronic" else {}


EFFECT = Effect(
    number=4,
    name="dark_offset",
    sentence="a uniform pedestal lies under the frame: ambient light, or a higher black level",
    noun="uniform pedestal",
    place=Place.PEDESTAL,
    parameters=(Parameter("level", "DN", 0.0, lambda c: 0.5 * c.full_scale_dn),),
    starts=lambda c: [(1.0,)],
    function=pedestal,
    forms=("light", "electronic"),
    negligible=0.1,
    uniform=True,
    flats="",
    adopts=raised,
)
