"""Dark offset: a uniform pedestal of ambient light, or a higher black level."""

from spotcheck.model.effect import Effect, Parameter, Pedestal, Stage, Step


def add_level(frame, pedestal_dn, *, level):
    """Return the pedestals so far [DN] plus `level` [DN]."""
    return pedestal_dn + level


def find_instrument_keys(sensor, variant, *, level):
    """Return the key of instrument.yaml, with its value, that does the same: a black level higher by `level` [DN].

    {} for a pedestal of light, which no key describes. `sensor` is a `SensorModel`.
    """
    return {"sensor.black_level_dn": sensor.black_level_dn + level} if variant is Pedestal.ELECTRONIC else {}


EFFECT = Effect(
    number=4,
    name="dark_offset",
    sentence="a uniform pedestal lies under the frame: ambient light, or a higher black level",
    noun="uniform pedestal",
    parameters=(Parameter("level", "DN", 0.0, lambda scales: 0.5 * scales.full_scale_dn, negligible=0.1),),
    variants={
        Pedestal.LIGHT: (Step(Stage.PEDESTAL, add_level),),
        Pedestal.ELECTRONIC: (Step(Stage.BLACK_LEVEL, add_level),),
    },
    starts=lambda scales: [(1.0,)],
    hidden_in_flats="",
    instrument_keys=find_instrument_keys,
)
