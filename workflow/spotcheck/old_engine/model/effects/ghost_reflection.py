"""Ghost reflection: a faint displaced copy of the spot."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def ghost(view, spot, amplitude, sigma, *, fraction, dx, dy):
    """Light [DN] of a copy, `fraction` as bright, displaced by (dx, dy) [px]."""
    return fraction * spot(dx, dy)


EFFECT = Effect(
    number=16,
    name="ghost_reflection",
    sentence="a faint displaced copy of the spot lies beside it",
    noun="brightness of a ghost",
    part=True,
    place=Place.ADDED,
    parameters=(
        Parameter("fraction", "1", 0.0, 0.9),
        Parameter("dx", "px", lambda c: -1.5 * c.crop_px, lambda c: 1.5 * c.crop_px),
        Parameter("dy", "px", lambda c: -1.5 * c.crop_px, lambda c: 1.5 * c.crop_px),
    ),
    starts=lambda c: [
        (0.01, r * c.sigma_px * np.cos(a), r * c.sigma_px * np.sin(a))
        for r in (1.2, 2.2, 3.4)
        for a in np.arange(8) * np.pi / 4
    ],
    function=ghost,
    negligible=0.002,
    always=True,
)
