"""Shutter offset: the true exposure is the nominal one plus a constant."""

from spotcheck.model.effect import Effect, Need, Only, Parameter, Stage, Step


def add_offset(frame, exposure_s, *, offset):
    """Return the exposure [s] plus `offset` [s]."""
    return exposure_s + offset


EFFECT = Effect(
    number=12,
    name="shutter_offset",
    sentence="the true exposure is the nominal one plus a constant",
    noun="offset of the exposure",
    parameters=(
        Parameter(
            "offset",
            "s",
            lambda scales: -0.5 * scales.shortest_s,
            lambda scales: 0.5 * scales.shortest_s,
            negligible=lambda scales: 0.005 * scales.shortest_s,
        ),
    ),
    variants={Only.ONLY: (Step(Stage.EXPOSURE, add_offset),)},
    starts=lambda scales: [(0.02 * scales.shortest_s,)],
    law_of="brightness",
    needs=(Need.EXPOSURES, Need.LAW),
    hidden_in_flats="",
)
