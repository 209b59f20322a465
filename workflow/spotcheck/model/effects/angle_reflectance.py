"""Angle reflectance: the brightness of the spot depends on the fibre angle γ."""

import numpy as np

from spotcheck.model.effect import DIRECTIONS, Effect, Need, Only, Parameter, Stage, Step


def modulate_by_angle(frame, peak_dn, *, d, gamma0):
    """Return the peak [DN] times 1 + d cos 2(γ − γ0) at the fibre angle γ (`frame.angle` [rad]).

    `d` is the depth [1], `gamma0` the angle of the maximum [deg].
    """
    return peak_dn * (1 + d * np.cos(2 * (frame.angle - np.deg2rad(gamma0))))


EFFECT = Effect(
    number=10,
    name="angle_reflectance",
    sentence="the spot's brightness, not its shape, follows the fibre angle",
    noun="change of brightness with the fibre angle",
    is_share=True,
    parameters=(Parameter("d", "1", 0.0, 0.95, negligible=0.005), Parameter("gamma0", "deg")),
    variants={Only.ONLY: (Step(Stage.BRIGHTNESS, modulate_by_angle),)},
    starts=lambda scales: [(0.02, gamma0) for gamma0 in DIRECTIONS],
    law_of="brightness",
    needs=(Need.ANGLES, Need.LAW),
)
