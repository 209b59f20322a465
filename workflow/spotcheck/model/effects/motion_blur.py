"""Motion blur: the spot moves during the exposure."""

import numpy as np

from spotcheck.model.effect import DIRECTIONS, Effect, Only, Parameter, Stage, Step

# Gauss–Legendre points of a path: three, and one more for each 3 px of it, at most 12. The edge of a plateau needs more
# of them than a smooth spot.
MOST_POINTS, FEWEST_POINTS, PX_PER_POINT = 12, 3, 3.0


def move(frame, *, speed, direction):
    """Return displacements [px] along the path, centred on the spot, and weights; speed in px/s, direction in deg."""
    angle, half = np.deg2rad(direction), speed * np.asarray(frame.exposure_s) / 2
    count = int(min(FEWEST_POINTS + 2 * np.max(half) // PX_PER_POINT, MOST_POINTS))
    nodes, weights = (values.reshape(-1, *(1,) * half.ndim) for values in np.polynomial.legendre.leggauss(count))
    along = half * nodes
    return np.stack([along * np.cos(angle), along * np.sin(angle), np.broadcast_to(weights / 2, along.shape)])


def highest_speed(scales):
    """Return the highest speed [px/s]: 100 widths of the spot in the shortest exposure."""
    return 100 * scales.sigma_px / scales.shortest_s


def negligible_speed(scales):
    """Return the speed [px/s] that moves the spot by 0.15 of its width in the longest exposure."""
    return 0.15 * scales.sigma_px / scales.longest_s


EFFECT = Effect(
    number=14,
    name="motion_blur",
    sentence="the spot moves during the exposure and is smeared",
    noun="speed of the spot",
    parameters=(
        Parameter("speed", "px/s", 0.0, highest_speed, negligible=negligible_speed),
        Parameter("direction", "deg"),
    ),
    variants={Only.ONLY: (Step(Stage.BLUR, move),)},
    starts=lambda scales: [(0.1 * scales.sigma_px / scales.shortest_s, direction) for direction in DIRECTIONS],
)
