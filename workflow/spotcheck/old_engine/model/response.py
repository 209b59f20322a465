"""A response that bends: a signal y [DN above black] is read as y − c y², for a curvature c [1/DN]; beyond its top at
y = 1/(2c) it stays there."""

import numpy as np


def bent(mean, variance, curvature):
    """Mean [DN] and variance [DN²] of y − c y² for a nearly normal signal y of this mean and variance."""
    mean = np.minimum(mean, top_of(curvature))
    slope = 1 - 2 * curvature * mean
    return mean - curvature * (mean * mean + variance), slope * slope * variance


def top_of(curvature):
    """The signal [DN] at which a response is highest; infinite where it bends up."""
    return 0.5 / curvature if curvature > 0 else np.inf


def straightened(signal, curvature):
    """The signal y [DN] that is read as y − c y²; one below black stays as it is, for there is nothing to bend."""
    root = np.sqrt(np.maximum(1 - 4 * curvature * np.maximum(signal, 0.0), 0.0))
    return np.where(signal > 0, 2 * signal / (1 + root), signal)
