"""Spread law: the beam propagation p_b, the width of the spot without the laser's own, is a power of the exposure.

In the baseline p_b is p1 ln(t/1 s) + p2 at an exposure t.
"""

from dataclasses import replace

from spotcheck.model.effect import Effect, Need, Only, Parameter, Stage, Step


def follow_power(frame, width, *, exponent):
    """Return `width`, a `WidthLaw`, with p_b(t) = p_b(t_ref) (t/t_ref)^`exponent` [px].

    p_b at the reference exposure t_ref, `frame.reference_s` [s], is that of `width`. `exponent` [1] takes the place of
    p1, so that two numbers give all widths, as in the baseline.
    """
    reference_px = width.propagation_px(frame.reference_s)
    return replace(width, propagation_px=lambda exposure_s: reference_px * (exposure_s / frame.reference_s) ** exponent)


EFFECT = Effect(
    number=13,
    name="spread_law",
    sentence="the width follows a power of the exposure instead of p1 ln t + p2",
    noun="power of the exposure in the width",
    parameters=(Parameter("exponent", "1", -1.5, 1.5, negligible=0.01),),
    variants={Only.ONLY: (Step(Stage.WIDTH, follow_power),)},
    starts=lambda scales: [(scales.width_exponent,)],
    vanishes_at=float("nan"),
    law_of="width",
    replaces=("p1",),
    needs=(Need.THREE_EXPOSURES, Need.LAW),
)
