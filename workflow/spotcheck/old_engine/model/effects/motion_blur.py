"""Motion blur: a uniform smear of a length that grows with exposure."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place

# Gauss–Legendre nodes over the path: the most, the fewest, and the stretch [px] of a path that brings one more. A
# plateau's edge needs more of them than a smooth spot; of a path that is short beside a pixel three tell all.
NODES, FEWEST, EACH_PX = 12, 3, 3.0


def path(view, *, speed, direction):
    """Shifts [px] along the path, centred on the spot, and their weights; `speed` [px/s], `direction` [deg]."""
    angle, half = np.deg2rad(direction), speed * view.exposure_s / 2
    count = int(min(FEWEST + 2 * np.max(half) // EACH_PX, NODES))
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return [
        (half * node * np.cos(angle), half * node * np.sin(angle), w / 2)
        for node, w in zip(nodes, weights, strict=True)
    ]


EFFECT = Effect(
    number=14,
    name="motion_blur",
    sentence="the spot moves during the exposure and is smeared",
    noun="speed of the spot",
    place=Place.BLUR,
    parameters=(
        Parameter("speed", "px/s", 0.0, lambda c: 100 * c.sigma_px / c.shortest_s),
        Parameter("direction", "deg", -np.inf, np.inf),
    ),
    starts=lambda c: [(0.1 * c.sigma_px / c.shortest_s, direction) for direction in (0.0, 45.0, 90.0, 135.0)],
    function=path,
    negligible=lambda c: 0.15 * c.sigma_px / c.longest_s,
)
