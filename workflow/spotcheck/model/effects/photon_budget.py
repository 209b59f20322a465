"""Photon budget: the peak depends on the exposure by another law than the baseline's."""

import numpy as np

from spotcheck.model.effect import Effect, Need, Only, Parameter, Stage, Step


def multiply_by_power(frame, peak_dn, *, q):
    """Return the peak [DN] times (t/t_max)^`q`, for the nominal exposure t and the longest one t_max."""
    return peak_dn * np.exp(q * np.log(frame.exposure_s / frame.longest_s))


EFFECT = Effect(
    number=11,
    name="photon_budget",
    sentence="the light grows with exposure by another power than the model's",
    noun="excess power of the exposure in the light",
    parameters=(Parameter("q", "1", -2.0, 2.0, negligible=0.01),),
    variants={Only.ONLY: (Step(Stage.BRIGHTNESS, multiply_by_power),)},
    starts=lambda scales: [(0.02,)],
    law_of="brightness",
    needs=(Need.EXPOSURES, Need.LAW),
    hidden_in_flats="",
)
