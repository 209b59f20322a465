"""Motion blur: the spot moves during the exposure."""

import numpy as np

from spotcheck.model.effect import DIRECTIONS, Effect, Only, Parameter, Stage, Step

# Number of Gauss–Legendre points along the path: the fewest, one more for each 3 px of it, and the most. The edge of a
# plateau needs more points than a smooth spot.
FEWEST_POINTS, PX_PER_POINT, MOST_POINTS = 3, 3.0, 12


def move(frame, *, speed, direction):
    """Return displacements dx, dy [px] and weights [1] of points along the path of the spot: an array [3, point, ...].

    The path is centred on the place of the spot. `speed` is in px/s, `direction` in deg from +x towards +y.
    `frame.exposure_s` is the true exposure [s]: a number, or an array [...] for several frames.
    """
    # Half the length of the path.
    angle_rad, half_px = np.deg2rad(direction), speed * np.asarray(frame.exposure_s) / 2
    count = int(min(FEWEST_POINTS + 2 * np.max(half_px) // PX_PER_POINT, MOST_POINTS))
    # The nodes lie in −1 … 1 and the weights sum to 2. Their axis comes before those of the exposures.
    nodes, weights = (values.reshape(-1, *(1,) * half_px.ndim) for values in np.polynomial.legendre.leggauss(count))
    path_px = half_px * nodes
    weights = np.broadcast_to(weights / 2, path_px.shape)
    return np.stack([path_px * np.cos(angle_rad), path_px * np.sin(angle_rad), weights])


def highest_speed(scales):
    """Return the highest speed [px/s], which moves the spot by 100 σ_g in the shortest exposure."""
    return 100 * scales.sigma_px / scales.shortest_s


def negligible_speed(scales):
    """Return the speed [px/s] that moves the spot by 0.15 σ_g in the longest exposure."""
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
