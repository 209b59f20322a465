"""Super-Gaussian: steeper or flatter flanks."""

import numpy as np

from spotcheck.model.effect import Effect, Only, Parameter, Stage, Step


def change_flanks(frame, half_square, *, n):
    """Return the exponent (ρ²/2)^n of the profile, from ρ²/2."""
    return np.exp(n * np.log(np.maximum(half_square, 1e-12)))


EFFECT = Effect(
    number=6,
    name="super_gaussian",
    sentence="the spot's flanks are steeper (n > 1) or flatter (n < 1) than a Gaussian's",
    noun="exponent of the flanks",
    parameters=(Parameter("n", "1", 0.3, 5.0, negligible=0.01),),
    variants={Only.ONLY: (Step(Stage.PROFILE, change_flanks),)},
    starts=lambda scales: [(1.02,)],
    vanishes_at=1.0,
    is_static_shape=True,
)
