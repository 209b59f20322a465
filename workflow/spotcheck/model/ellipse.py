"""Coordinates of an elliptical spot."""

import numpy as np


def make_round(dx, dy, ratio, axis_rad):
    """Map displacements from the centre of an elliptical spot to those of a round spot of equal area.

    The round spot has the same light at the returned displacements as the ellipse at the given ones.

    Parameters
    ----------
    dx, dy : arrays that broadcast, such as [1, column] and [row, 1]
        Displacements to the right and down [px].
    ratio : float
        Long axis divided by short axis [1]. Lengths along the long axis are divided by √`ratio`, those across it are
        multiplied by √`ratio`.
    axis_rad : float or array that broadcasts
        Direction of the long axis [rad], from +x towards +y.

    Returns
    -------
    dx, dy : arrays of the common shape
        Displacements on the round spot [px].
    """
    # The matrix is symmetric, so it stretches without a rotation, and a second ellipse may follow with its own
    # direction.
    root, cos, sin = np.sqrt(ratio), np.cos(axis_rad), np.sin(axis_rad)
    xx = cos * cos / root + sin * sin * root
    yy = sin * sin / root + cos * cos * root
    xy = cos * sin * (1 / root - root)
    return dx * xx + dy * xy, dx * xy + dy * yy
