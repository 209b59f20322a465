"""Ghost reflection: a faint displaced copy of the spot."""

import numpy as np

from spotcheck.model.effect import Effect, Only, Parameter, Stage, Step

# Starting values: number of directions, distances in widths σ_g of the spot, and brightness over that of the spot.
START_DIRECTIONS, START_RADII, START_FRACTION = 8, (1.2, 2.2, 3.4), 0.01


def add_copy(frame, *, fraction, dx, dy):
    """Return displacements dx, dy [px] and weights [1] of the spot itself and of a copy: an array [3, copy].

    The copy is displaced by `dx`, `dy` [px] and has `fraction` [1] times the brightness of the spot.
    """
    return np.array([[0.0, dx], [0.0, dy], [1.0, fraction]])


def list_starts(scales):
    """Return a list of starts (fraction [1], dx [px], dy [px]).

    They are at `scales.copies`, the places (dx, dy) of copies that residuals show. If there are none, they are on rings
    around the spot.
    """
    angles_rad = np.arange(START_DIRECTIONS) * 2 * np.pi / START_DIRECTIONS
    # dx and dy [px] of the starts on each ring.
    rings = [radius * scales.sigma_px * np.array([np.cos(angles_rad), np.sin(angles_rad)]) for radius in START_RADII]
    return [(START_FRACTION, dx, dy) for dx, dy in scales.copies or np.concatenate(rings, axis=1).T.tolist()]


EFFECT = Effect(
    number=16,
    name="ghost_reflection",
    sentence="a faint displaced copy of the spot lies beside it",
    noun="brightness of a ghost",
    is_share=True,
    parameters=(
        Parameter("fraction", "1", 0.0, 0.9, negligible=0.002),
        Parameter("dx", "px", lambda scales: -1.5 * scales.crop_px, lambda scales: 1.5 * scales.crop_px),
        Parameter("dy", "px", lambda scales: -1.5 * scales.crop_px, lambda scales: 1.5 * scales.crop_px),
    ),
    variants={Only.ONLY: (Step(Stage.BLUR, add_copy),)},
    starts=list_starts,
    is_static_shape=True,
)
