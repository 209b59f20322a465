"""Interference fringes: parallel stripes that modulate the spot."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def stripes(view, *, d, period, direction, phase, form):
    """Factor 1 + d cos(2πu/period + phase), u [px] across the stripes, counted from the spot or from the sensor's
    corner; as `site` with the view's own amplitudes of cos and sin about the spot."""
    angle = np.deg2rad(direction)
    x, y = (view.x, view.y) if form == "sensor" else (view.x - view.x0, view.y - view.y0)
    turn = 2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period
    if form == "site":
        return 1 + view.wave_cos * np.cos(turn) + view.wave_sin * np.sin(turn)
    return 1 + d * np.cos(turn + np.deg2rad(phase))


EFFECT = Effect(
    number=15,
    name="interference_fringes",
    sentence="parallel stripes modulate the spot",
    noun="depth of stripes",
    part=True,
    place=Place.MODULATION,
    parameters=(
        Parameter("d", "1", 0.0, 1.0),
        Parameter("period", "px", 2.0, lambda c: 1.5 * c.crop_px),
        Parameter("direction", "deg", -np.inf, np.inf),
        Parameter("phase", "deg", -np.inf, np.inf, inner=True),
    ),
    starts=lambda c: [],
    function=stripes,
    forms=("site", "spot", "sensor"),
    negligible=0.003,
    idle={"site": ("d", "phase")},
    always=True,
    spectral=True,
)
