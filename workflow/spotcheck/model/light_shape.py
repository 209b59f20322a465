"""The light's shape beyond the declared one: a surface that is learned from frames, in the coordinates of the spot.

S(u, v) = B(u, v) + s(u, v) with u = (x − x₀)/σ, v = (y − y₀)/σ. B is the declared shape, of peak 1; s a tensor product
of uniform cubic B-splines (de Boor, A Practical Guide to Splines, ch. IX), 0 beyond its last nodes.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

compiled = njit(cache=True, nogil=True, error_model="numpy")


class LightShape(NamedTuple):
    """Distance of the nodes [σ], and the coefficients [row, column] in peaks of the declared shape, their middle at the
    spot's centre."""

    step: float
    coefficients: np.ndarray

    @property
    def reach(self) -> float:
        """Distance of the outermost nodes from the centre [σ]."""
        return self.step * (len(self.coefficients) - 1) / 2

    def __call__(self, u, v) -> np.ndarray:
        """s at u, v (shapes that broadcast); by matrices where u differs along the last axis alone and v along the one
        before it, as on a grid of pixels."""
        u, v = np.asarray(u, float), np.asarray(v, float)
        shape = np.broadcast_shapes(u.shape, v.shape)
        if u.ndim == v.ndim == 3 and u.shape[1] == 1 and v.shape[2] == 1:
            along, across = self.basis(u[:, 0, :]), self.basis(v[:, :, 0])
            return np.broadcast_to((across @ self.coefficients) @ np.swapaxes(along, -1, -2), shape)
        u, v = (np.ascontiguousarray(np.broadcast_to(own, shape)).ravel() for own in (u, v))
        out = np.empty(u.size)
        evaluate(u, v, self.step, self.coefficients, out)
        return out.reshape(shape)

    def basis(self, u: np.ndarray) -> np.ndarray:
        """Values [..., node] of the splines of one axis at u."""
        nodes = self.step * (np.arange(len(self.coefficients)) - (len(self.coefficients) - 1) / 2)
        return cubic((np.asarray(u)[..., None] - nodes) / self.step)


def empty(step: float, reach: float) -> LightShape:
    """A shape that is 0 everywhere, with nodes as far as `reach` [σ] at least."""
    side = 2 * int(np.ceil(reach / step)) + 1
    return LightShape(step, np.zeros((side, side)))


def cubic(t: np.ndarray) -> np.ndarray:
    """The cubic B-spline about 0 with nodes at whole numbers."""
    t = np.abs(t)
    return np.where(t < 1, 2 / 3 - t * t * (1 - t / 2), np.maximum(2 - t, 0.0) ** 3 / 6)


@compiled
def weights_at(t, out):
    """First node and the four splines' values at t, in steps from the first node of the surface."""
    first = int(np.floor(t)) - 1
    part = t - np.floor(t)
    rest = 1 - part
    out[0] = rest * rest * rest / 6
    out[1] = 2 / 3 - part * part * (1 - part / 2)
    out[2] = 2 / 3 - rest * rest * (1 - rest / 2)
    out[3] = part * part * part / 6
    return first


@compiled
def splines_at(u, v, step, side, across, along):
    """Whether any spline of a surface reaches a point, the first row and column of those that may, and their values
    along both axes."""
    middle = (side - 1) / 2
    tu, tv = u / step + middle, v / step + middle
    if not (-2 < tu < side + 1 and -2 < tv < side + 1):
        return False, 0, 0
    return True, weights_at(tv, across), weights_at(tu, along)


@compiled
def evaluate(u, v, step, coefficients, out):
    """s at points u, v [point]."""
    side = coefficients.shape[0]
    across, along = np.empty(4), np.empty(4)
    for k in range(u.size):
        out[k] = 0.0
        reached, i, j = splines_at(u[k], v[k], step, side, across, along)
        if not reached:
            continue
        for a in range(4):
            if 0 <= i + a < side:
                for b in range(4):
                    if 0 <= j + b < side:
                        out[k] += across[a] * along[b] * coefficients[i + a, j + b]
