"""Pointing jitter: the centre scatters between the exposures of a site."""

from spotcheck.old_engine.model.effect import Effect, Parameter, Place, Scatter


def shift(rng, *, rms):
    """Displacement (dx, dy) [px] of one frame, normal with `rms` along each axis."""
    return rms * rng.standard_normal(2)


EFFECT = Effect(
    number=21,
    name="pointing_jitter",
    sentence="the spot's centre scatters between the exposures of a site",
    noun="scatter of the centre",
    place=Place.SCATTER,
    parameters=(Parameter("rms", "px", 0.0, lambda c: c.crop_px / 4),),
    starts=lambda c: [(0.2,)],
    function=shift,
    negligible=0.1,
    needs=("exposure",),
    scatter=Scatter("centre", "frame", "centre"),
)
