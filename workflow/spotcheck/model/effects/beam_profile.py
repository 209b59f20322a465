"""Beam profile: the light does not have the declared shape; another one is learned from the frames (`light_shape`)."""

from spotcheck.model.effect import Effect, Only, Parameter

EFFECT = Effect(
    number=25,
    name="beam_profile",
    sentence="the light is not the declared shape: another static one, the same in every frame up to place, width and"
    " brightness",
    noun="light elsewhere than declared",
    is_share=True,
    # Share of the light that lies elsewhere than declared, and the azimuthal order (periods per turn around the centre)
    # that has most of it.
    parameters=(Parameter("power", "1", 0.0, 1.0, negligible=0.005), Parameter("order", "1", 0.0, 8.0)),
    # No step: the learned shape is part of the baseline.
    variants={Only.ONLY: ()},
    # A learned shape has no starting values.
    starts=lambda scales: [],
    is_static_shape=True,
)
