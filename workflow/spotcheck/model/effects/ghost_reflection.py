"""Ghost reflection: a faint displaced copy of the spot."""

import numpy as np

from spotcheck.model.effect import Effect, Only, Parameter, Stage, Step


def copy(frame, *, fraction, dx, dy):
    """Return the spot itself, and a copy `fraction` as bright that is displaced by dx, dy [px]."""
    return np.array([[0.0, dx], [0.0, dy], [1.0, fraction]])


def list_starts(scales):
    """Return starting values at the copies in residuals, or without any at some distances and directions."""
    angles = np.arange(8) * np.pi / 4
    rings = [
        (share * scales.sigma_px * np.cos(angles), share * scales.sigma_px * np.sin(angles))
        for share in (1.2, 2.2, 3.4)
    ]
    return [(0.01, dx, dy) for dx, dy in scales.copies or np.concatenate(rings, axis=1).T.tolist()]


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
    variants={Only.ONLY: (Step(Stage.BLUR, copy),)},
    starts=list_starts,
    is_static_shape=True,
)
