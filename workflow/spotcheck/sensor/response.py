"""Response curvature: a signal x [DN above black] is read as x − c x², with the curvature c [1/DN].

Beyond its extremum at 1/(2c) the response stays constant, so that it never decreases.
"""

import numpy as np


def apply_curvature(signal, curvature: float):
    """Return the response [DN] to a signal [DN] of any shape, both without black level.

    `curvature` is c [1/DN], of either sign; 0 for a linear response.
    """
    if curvature == 0:
        return signal
    extremum = 0.5 / curvature
    limited = np.minimum(signal, extremum) if curvature > 0 else np.maximum(signal, extremum)
    return limited - curvature * limited * limited


def remove_curvature(response, curvature: float):
    """Return the signal [DN] that has a response [DN]: the inverse of `apply_curvature`.

    A response that no signal reaches gives the signal at the extremum. Arguments are as for `apply_curvature`.
    """
    if curvature == 0:
        return response
    # Response relative to that at the extremum, 1/(4c). The solution of the quadratic equation is written so that no
    # digits cancel for a small curvature.
    ratio = np.minimum(4 * curvature * np.asarray(response, float), 1.0)
    return ratio / (2 * curvature * (1 + np.sqrt(1 - ratio)))
