"""Shutter offset: the true exposure is the nominal one plus a constant."""

from spotcheck.model.effect import Effect, Need, Only, Parameter, Stage, Step


def add_offset(frame, exposure_s, *, offset):
    """Return the true exposure [s]: the nominal one `exposure_s` plus `offset` [s]."""
    return exposure_s + offset


def times_shortest(factor):
    """Return a function from the scales of a dataset to `factor` [1] times its shortest exposure [s]."""
    return lambda scales: factor * scales.shortest_s


EFFECT = Effect(
    number=12,
    name="shutter_offset",
    sentence="the true exposure is the nominal one plus a constant",
    noun="offset of the exposure",
    parameters=(Parameter("offset", "s", times_shortest(-0.5), times_shortest(0.5), negligible=times_shortest(0.005)),),
    variants={Only.ONLY: (Step(Stage.EXPOSURE, add_offset),)},
    starts=lambda scales: [(0.02 * scales.shortest_s,)],
    law_of="brightness",
    needs=(Need.EXPOSURES, Need.LAW),
    hidden_in_flats="",
)
