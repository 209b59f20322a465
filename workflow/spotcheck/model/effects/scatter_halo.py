"""Scatter halo: a broad faint second component around the spot.

`frame.pixels` has x, y of the pixels, and `frame` the centre x0, y0 of the spot [px]. `spot.peak_dn` is the peak of the
spot's Gaussian before the top hat [DN].
"""

from enum import Enum

import numpy as np

from spotcheck.model.effect import Effect, Parameter, Stage, Step


class Variant(Enum):
    """Profile of the halo over the distance r from the centre of the spot."""

    EXPONENTIAL = "exponential"
    GAUSSIAN = "gaussian"
    POWER = "power"


def add_exponential(frame, light_dn, spot, *, fraction, radius):
    """Return the light [DN] plus a halo `fraction` · `spot.peak_dn` · exp(−r/`radius`), with the radius in px.

    r is the distance of a pixel from the centre of the spot, and `fraction` has no unit.
    """
    return light_dn + fraction * spot.peak_dn * np.exp(-np.sqrt(squared_distance(frame, radius)))


def add_gaussian(frame, light_dn, spot, *, fraction, radius):
    """Return the light [DN] plus a halo `fraction` · `spot.peak_dn` · exp(−r²/(2 `radius`²)); see `add_exponential`."""
    return light_dn + fraction * spot.peak_dn * np.exp(-squared_distance(frame, radius) / 2)


def add_power(frame, light_dn, spot, *, fraction, radius, tail):
    """Return the light [DN] plus a halo `fraction` · `spot.peak_dn` · (1 + r²/`radius`²)^(−`tail`)."""
    return light_dn + fraction * spot.peak_dn * np.exp(-tail * np.log1p(squared_distance(frame, radius)))


def squared_distance(frame, radius):
    """Return r²/`radius`² [1] at each pixel, where r [px] is the distance from the centre of the spot."""
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
