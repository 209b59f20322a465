"""Spread law: the beam propagation p_b, the width of the spot without the laser's own, is a power of the exposure."""

from dataclasses import replace

from spotcheck.model.effect import Effect, Need, Only, Parameter, Stage, Step


def follow_power(frame, width, *, exponent):
    """Return the law of the width with p_b(t) = p_b(t_ref) (t/t_ref)^`exponent` [px].

    Two numbers give all widths, as in the baseline: p_b at the reference exposure t_ref, which remains
    p1 ln t_ref + p2, and `exponent` [1] in place of p1.
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
