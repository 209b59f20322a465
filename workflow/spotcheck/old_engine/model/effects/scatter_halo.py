"""Scatter halo: a broad faint second component around the spot."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def halo(view, spot, amplitude, sigma, *, fraction, radius, tail, form):
    """Light [DN] of a halo of peak `fraction` times the spot's: exp(−r/a), exp(−r²/2a²) or (1 + r²/a²)^(−tail)."""
    r2 = ((view.x - view.x0) ** 2 + (view.y - view.y0) ** 2) / radius**2
    if form == "exponential":
        profile = np.exp(-np.sqrt(r2))
    elif form == "gaussian":
        profile = np.exp(-r2 / 2)
    else:
        profile = np.exp(-tail * np.log1p(r2))
    return fraction * amplitude * profile


EFFECT = Effect(
    number=7,
    name="scatter_halo",
    sentence="a broad faint halo of scattered light surrounds the spot",
    noun="light in a halo",
    part=True,
    place=Place.ADDED,
    parameters=(
        Parameter("fraction", "1", 0.0, 0.6),
        Parameter("radius", "px", lambda c: 0.3 * c.sigma_px, lambda c: 4 * c.crop_px),
        Parameter("tail", "1", 0.5, 8.0, inner=True),
    ),
    starts=lambda c: [(0.01, f * c.sigma_px, 1.5) for f in (1.5, 3.0)],
    function=halo,
    forms=("exponential", "gaussian", "power"),
    negligible=0.002,
    idle={"exponential": ("tail",), "gaussian": ("tail",)},
)
