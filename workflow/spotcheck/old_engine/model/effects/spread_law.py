"""Spread law: the width follows a power of the exposure."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def power_of(view, reference_px, ratio, *, exponent):
    """p_b [px]: its value at the reference exposure times (t/t_ref)^exponent.

    p1 goes: two numbers give the widths here as they do in the baseline.
    """
    return reference_px * np.exp(exponent * np.log(ratio))


EFFECT = Effect(
    number=13,
    name="spread_law",
    sentence="the width follows a power of the exposure instead of p1 ln t + p2",
    noun="power of the exposure in the width",
    place=Place.WIDTH,
    parameters=(Parameter("exponent", "1", -1.5, 1.5),),
    starts=lambda c: [(c.exponent,)],
    function=power_of,
    neutral=np.nan,
    negligible=0.01,
    replaces=("p1",),
    needs=("three exposures", "law"),
    always=True,
)
