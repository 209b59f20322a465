"""Coordinates of an elliptical spot."""

import numpy as np


def make_round(dx, dy, ratio, axis):
    """Return displacements [px] shortened along `axis` [rad] and lengthened across it: those of a round spot.

    The area stays the same: the axes have the ratio long/short = `ratio`. The matrix is symmetric, so that two
    ellipses one behind the other keep their directions, and dx and dy that each vary along one axis make single sums.
    """
    root, cos, sin = np.sqrt(ratio), np.cos(axis), np.sin(axis)
    xx = cos * cos / root + sin * sin * root
    yy = sin * sin / root + cos * cos * root
    xy = cos * sin * (1 / root - root)
    return dx * xx + dy * xy, dx * xy + dy * yy
