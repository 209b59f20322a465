"""Cubic B-splines by scipy, which the library's own are held against."""

import numpy as np
from scipy.interpolate import BSpline

from spotcheck.model.light_shape import LightShape


def along(t: np.ndarray, step: float, side: int) -> np.ndarray:
    """Values [point, node] of all splines of one axis at t [σ]."""
    one = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
    nodes = step * (np.arange(side) - (side - 1) / 2)
    return np.nan_to_num(one((np.asarray(t, float)[:, None] - nodes) / step))


def matrix(u: np.ndarray, v: np.ndarray, step: float, side: int) -> np.ndarray:
    """Values [point, coefficient] of a surface's splines at points u, v [σ]."""
    return np.einsum("pi,pj->pij", along(v, step, side), along(u, step, side)).reshape(len(u), -1)


def surface(own: LightShape, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """s [point], a spline at a time."""
    return matrix(u, v, own.step, len(own.coefficients)) @ own.coefficients.ravel()
