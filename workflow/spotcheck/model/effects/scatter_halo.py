"""Scatter halo: a broad faint second component around the spot."""

from enum import Enum

import numpy as np

from spotcheck.model.effect import Effect, Parameter, Stage, Step


class Variant(Enum):
    """Profile of the halo."""

    EXPONENTIAL = "exponential"
    GAUSSIAN = "gaussian"
    POWER = "power"


def add_exponential(frame, light_dn, spot, *, fraction, radius):
    """Return the light [DN] plus a halo exp(−r/radius) whose peak is `fraction` of the Gaussian's; radius in px."""
    return light_dn + fraction * spot.peak_dn * np.exp(-np.sqrt(squared_radius(frame, radius)))


def add_gaussian(frame, light_dn, spot, *, fraction, radius):
    """Return the light [DN] plus a halo exp(−r²/(2 radius²)); see `add_exponential`."""
    return light_dn + fraction * spot.peak_dn * np.exp(-squared_radius(frame, radius) / 2)


def add_power(frame, light_dn, spot, *, fraction, radius, tail):
    """Return the light [DN] plus a halo (1 + r²/radius²)^(−tail); see `add_exponential`."""
    return light_dn + fraction * spot.peak_dn * np.exp(-tail * np.log1p(squared_radius(frame, radius)))


def squared_radius(frame, radius):
    """Return r²/radius² [1] from the spot's centre."""
    return ((frame.pixels.x - frame.x0) ** 2 + (frame.pixels.y - frame.y0) ** 2) / radius**2


EFFECT = Effect(
    number=7,
    name="scatter_halo",
    sentence="a broad faint halo of scattered light surrounds the spot",
    noun="light in a halo",
    is_share=True,
    parameters=(
        Parameter("fraction", "1", 0.0, 0.6, negligible=0.002),
        Parameter("radius", "px", lambda scales: 0.3 * scales.sigma_px, lambda scales: 4 * scales.crop_px),
        Parameter("tail", "1", 0.5, 8.0, is_variant_specific=True),
    ),
    variants={
        Variant.EXPONENTIAL: (Step(Stage.ADDED_LIGHT, add_exponential),),
        Variant.GAUSSIAN: (Step(Stage.ADDED_LIGHT, add_gaussian),),
        Variant.POWER: (Step(Stage.ADDED_LIGHT, add_power),),
    },
    starts=lambda scales: [(0.01, ratio * scales.sigma_px, 1.5) for ratio in (1.5, 3.0)],
    is_static_shape=True,
)
