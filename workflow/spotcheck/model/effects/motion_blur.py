"""Motion blur: the spot moves during the exposure."""

import numpy as np

from spotcheck.model.effect import Effect, Only, Parameter, Stage, Step

# Gauss–Legendre points of a path: one for each 3 px of half the path, from 3 to 12. The edge of a plateau needs more
# of them than a smooth spot; of a path that is short beside a pixel three are enough.
MOST_POINTS, FEWEST_POINTS, PX_PER_POINT = 12, 3, 3.0


def move(frame, *, speed, direction):
    """Return displacements [px] along the path, centred on the spot, and weights; speed in px/s, direction in deg."""
    angle, half = np.deg2rad(direction), speed * frame.exposure_s / 2
    count = int(min(FEWEST_POINTS + 2 * half // PX_PER_POINT, MOST_POINTS))
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return np.stack([half * nodes * np.cos(angle), half * nodes * np.sin(angle), weights / 2])


EFFECT = Effect(
    number=14,
    name="motion_blur",
    sentence="the spot moves during the exposure and is smeared",
    noun="speed of the spot",
    parameters=(
        Parameter(
            "speed",
            "px/s",
            0.0,
            lambda scales: 100 * scales.sigma_px / scales.shortest_s,
            negligible=lambda scales: 0.15 * scales.sigma_px / scales.longest_s,
        ),
        Parameter("direction", "deg", -np.inf, np.inf),
    ),
    variants={Only.ONLY: (Step(Stage.BLUR, move),)},
    starts=lambda scales: [
        (0.1 * scales.sigma_px / scales.shortest_s, direction) for direction in (0.0, 45.0, 90.0, 135.0)
    ],
)
