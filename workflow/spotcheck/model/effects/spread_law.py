"""Spread law: the width follows a power of the exposure."""

from dataclasses import replace

from spotcheck.model.effect import Effect, Need, Only, Parameter, Stage, Step


def follow_power(frame, width, *, exponent):
    """Return the law p_b(t) = p_b(t_ref) (t/t_ref)^exponent in px.

    p1 loses its meaning: two numbers give the widths here as they do in the baseline.
    """
    at_reference = width.propagation_px(frame.reference_s)
    return replace(width, propagation_px=lambda exposure_s: at_reference * (exposure_s / frame.reference_s) ** exponent)


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
