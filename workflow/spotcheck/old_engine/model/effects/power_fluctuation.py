"""Power fluctuation: brightness scatters from frame to frame without order."""

from spotcheck.old_engine.model.effect import Effect, Parameter, Place, Scatter


def factor(rng, *, rms):
    """Factor on one frame's light: normal around 1, never below 0."""
    return max(1 + rms * rng.standard_normal(), 0.0)


EFFECT = Effect(
    number=19,
    name="power_fluctuation",
    sentence="the brightness scatters from frame to frame without order",
    noun="scatter of brightness",
    part=True,
    place=Place.SCATTER,
    parameters=(Parameter("rms", "1", 0.0, 2.0),),
    starts=lambda c: [(0.02,)],
    function=factor,
    negligible=0.003,
    needs=("frames", "law"),
    scatter=Scatter("gain", "frame", "gain"),
    # A brightness of each frame's own fits any law of the brightness.
    contains=(Place.EXPOSURE, Place.BRIGHTNESS),
    flats="the drift between frames of a level is part of the errors",
)
