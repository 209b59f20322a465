"""Dark offset: a uniform pedestal, of ambient light or of the black level."""

from spotcheck.model.effect import Effect, Parameter, Pedestal, Stage, Step


def add_level(frame, pedestal_dn, *, level):
    """Return what is there plus `level` [DN]."""
    return pedestal_dn + level


def raise_black_level(sensor, variant, *, level):
    """Return the black level that an electronic pedestal makes; light is no number of the sensor."""
    return {"sensor.black_level_dn": sensor.black_level_dn + level} if variant is Pedestal.ELECTRONIC else {}


EFFECT = Effect(
    number=4,
    name="dark_offset",
    sentence="a uniform pedestal lies under the frame: ambient light, or a higher black level",
    noun="uniform pedestal",
    parameters=(Parameter("level", "DN", 0.0, lambda scales: 0.5 * scales.full_scale_dn, negligible=0.1),),
    variants={
        Pedestal.LIGHT: (Step(Stage.PEDESTAL, add_level, {"level": lambda frame, pedestal_dn: 1.0}),),
        Pedestal.ELECTRONIC: (Step(Stage.BLACK_LEVEL, add_level),),
    },
    starts=lambda scales: [(1.0,)],
    hidden_in_flats="",
    instrument_keys=raise_black_level,
)
