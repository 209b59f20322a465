"""Shutter offset: the true exposure is the nominal one plus a constant."""

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def true_exposure(view, exposure_s, *, offset):
    """Exposure [s] with `offset` [s]."""
    return exposure_s + offset


EFFECT = Effect(
    number=12,
    name="shutter_offset",
    sentence="the true exposure is the nominal one plus a constant",
    noun="offset of the exposure",
    place=Place.EXPOSURE,
    parameters=(Parameter("offset", "s", lambda c: -0.5 * c.shortest_s, lambda c: 0.5 * c.shortest_s),),
    starts=lambda c: [(0.02 * c.shortest_s,)],
    function=true_exposure,
    negligible=lambda c: 0.005 * c.shortest_s,
    needs=("exposure", "law"),
    flats="",
)
