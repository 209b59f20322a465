"""Super-Gaussian: steeper or flatter flanks."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def flanks(view, half, *, n):
    """Exponent (ρ²/2)^n of the shape, from ρ²/2."""
    return np.exp(n * np.log(np.maximum(half, 1e-12)))


EFFECT = Effect(
    number=6,
    name="super_gaussian",
    sentence="the spot's flanks are steeper (n > 1) or flatter (n < 1) than a Gaussian's",
    noun="exponent of the flanks",
    place=Place.PROFILE,
    parameters=(Parameter("n", "1", 0.3, 5.0),),
    starts=lambda c: [(1.02,)],
    function=flanks,
    neutral=1.0,
    negligible=0.01,
)
