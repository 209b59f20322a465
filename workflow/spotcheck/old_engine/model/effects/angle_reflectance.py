"""Angle reflectance: the brightness follows the fibre angle."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def reflected(view, *, d, gamma0):
    """Factor 1 + d cos 2(γ − γ0); γ0 [deg]."""
    return 1 + d * np.cos(2 * (view.angle - np.deg2rad(gamma0)))


EFFECT = Effect(
    number=10,
    name="angle_reflectance",
    sentence="the spot's brightness, not its shape, follows the fibre angle",
    noun="change of brightness with the fibre angle",
    part=True,
    place=Place.BRIGHTNESS,
    parameters=(
        Parameter("d", "1", 0.0, 0.95),
        Parameter("gamma0", "deg", -np.inf, np.inf),
    ),
    starts=lambda c: [(0.02, gamma0) for gamma0 in (0.0, 45.0, 90.0, 135.0)],
    function=reflected,
    negligible=0.005,
    needs=("angle", "law"),
)
