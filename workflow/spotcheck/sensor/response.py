"""Response curvature: the response of a sensor to a signal x [DN] is x − c x², with the curvature c [1/DN].

The signal is what a linear sensor would read, the response is what this sensor reads; both are without black level. The
parabola has its extremum at x = 1/(2c). Beyond the extremum the response stays constant, so that it never decreases
with the signal.
"""

import numpy as np


def apply_curvature(signal, curvature: float):
    """Return the response of a sensor to a signal.

    Parameters
    ----------
    signal : float or ndarray
        Reading of a linear sensor above the black level [DN], of any shape.
    curvature : float
        Curvature c [1/DN], of either sign; 0 for a linear response.

    Returns
    -------
    float or ndarray
        Response above the black level [DN], of the shape of `signal`.
    """
    if curvature == 0:
        return signal
    extremum = 0.5 / curvature
    limited = np.minimum(signal, extremum) if curvature > 0 else np.maximum(signal, extremum)
    return limited - curvature * limited * limited


def remove_curvature(response, curvature: float):
    """Return the signal that causes a response: the inverse of `apply_curvature`.

    Parameters
    ----------
    response : float or ndarray
        Response above the black level [DN], of any shape.
    curvature : float
        Curvature c [1/DN], of either sign; 0 for a linear response.

    Returns
    -------
    float or ndarray
        Signal above the black level [DN], of the shape of `response`. If no signal causes a response, because it lies
        beyond the extremum of the parabola, the signal at the extremum is returned.
    """
    if curvature == 0:
        return response
    # Response relative to that at the extremum, 1/(4c). The solution of the quadratic equation is written so that no
    # digits cancel for a small curvature.
    ratio = np.minimum(4 * curvature * np.asarray(response, float), 1.0)
    return ratio / (2 * curvature * (1 + np.sqrt(1 - ratio)))
