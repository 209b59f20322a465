"""Super-Gaussian: the flanks of the spot are steeper or flatter than a Gaussian's."""

import numpy as np

from spotcheck.model.effect import Effect, Only, Parameter, Stage, Step

# Least ρ²/2 [1] of which the logarithm is taken.
LEAST_HALF_SQUARE = 1e-12


def change_flanks(frame, half_square, *, n):
    """Return the exponent E [1] of the profile exp(−E): (ρ²/2)^`n` in place of the Gaussian's ρ²/2, `half_square`.

    ρ is the distance from the centre of the spot, in widths σ_g.
    """
    # The floor avoids ln 0 at the centre.
    return np.exp(n * np.log(np.maximum(half_square, LEAST_HALF_SQUARE)))


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
