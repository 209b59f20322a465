"""Beam profile: the light has a shape of its own, which is learned from frames (`model/light_shape.py`)."""

from spotcheck.old_engine.model.effect import Effect, Parameter, Place

EFFECT = Effect(
    number=25,
    name="beam_profile",
    sentence="the light is not the declared shape: another static one, the same in every frame up to place, width and"
    " brightness",
    noun="light elsewhere than declared",
    part=True,
    place=Place.SHAPE,
    parameters=(
        # The part of the light that lies elsewhere than declared, and the azimuthal order that has most of it.
        Parameter("power", "1", 0.0, 1.0),
        Parameter("order", "1", 0.0, 8.0),
    ),
    starts=lambda c: [],
    negligible=0.005,
)
