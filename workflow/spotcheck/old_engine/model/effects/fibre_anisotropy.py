"""Fibre anisotropy: an ellipse whose long axis turns with the fibre angle."""

import numpy as np

from spotcheck.old_engine.model.effect import Effect, Parameter, Place


def stretch(view, dx, dy, *, ratio, zero, form):
    """Displacements that make the ellipse round again: long axis at ±angle + `zero` [deg], `ratio` = long/short."""
    axis = (view.angle if form == "same sense" else -view.angle) + np.deg2rad(zero)
    return squeeze(dx, dy, ratio, axis)


def squeeze(dx, dy, ratio, axis):
    """Displacements shortened along `axis` [rad] and lengthened across it, area unchanged."""
    root, cos, sin = np.sqrt(ratio), np.cos(axis), np.sin(axis)
    # Shortened along, lengthened across, and turned back into the camera's own axes, so that another ellipse finds its
    # direction: one symmetric matrix, of which dx and dy that lie along one axis each make a single sum.
    xx, yy, xy = cos * cos / root + sin * sin * root, sin * sin / root + cos * cos * root, cos * sin * (1 / root - root)
    return dx * xx + dy * xy, dx * xy + dy * yy


EFFECT = Effect(
    number=8,
    name="fibre_anisotropy",
    sentence="the spot is an ellipse whose long axis turns with the fibres",
    noun="ratio of axes that turn with the fibres",
    place=Place.METRIC,
    parameters=(
        Parameter("ratio", "1", 1.0, 4.0),
        Parameter("zero", "deg", -np.inf, np.inf, inner=True),
    ),
    starts=lambda c: [(1.02, zero) for zero in (0.0, 45.0, 90.0, 135.0)],
    function=stretch,
    forms=("same sense", "opposite sense"),
    neutral=1.0,
    negligible=0.005,
)
