"""Photon budget: the light grows with exposure by another law than the baseline's."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def grown(view, *, q):
    """Factor (t/t_max)^q on the light."""
    return np.exp(q * np.log(view.exposure_s / view.longest_s))


EFFECT = Effect(
    number=11,
    name="photon_budget",
    sentence="the light grows with exposure by another power than the model's",
    noun="excess power of the exposure in the light",
    place=Place.BRIGHTNESS,
    parameters=(Parameter("q", "1", -2.0, 2.0),),
    starts=lambda c: [(0.02,)],
    function=grown,
    negligible=0.01,
    needs=("exposure", "law"),
    flats="",
)
