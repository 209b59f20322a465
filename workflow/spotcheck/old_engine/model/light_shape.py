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
        """s at u, v (shapes that broadcast), row by row where u differs along the last axis alone and v along the one
        before it, as on a grid of pixels."""
        u, v = np.asarray(u, float), np.asarray(v, float)
        shape = np.broadcast_shapes(u.shape, v.shape)
        if u.ndim == v.ndim == 3 and u.shape[1] == 1 and v.shape[2] == 1:
            views = shape[0]
            along, across = (np.broadcast_to(own.reshape(len(own), -1), (views, own[0].size)) for own in (u, v))
            out = np.empty(shape)
            for k in range(views):
                evaluate_grid(along[k], across[k], self.step, self.coefficients, out[k])
            return out
        u, v = (np.ascontiguousarray(np.broadcast_to(own, shape)).ravel() for own in (u, v))
        out = np.empty(u.size)
        evaluate(u, v, self.step, self.coefficients, out)
        return out.reshape(shape)


def empty(step: float, reach: float) -> LightShape:
    """A shape that is 0 everywhere, with nodes as far as `reach` [σ] at least."""
    side = 2 * int(np.ceil(reach / step)) + 1
    return LightShape(step, np.zeros((side, side)))


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


@compiled
def splines_along(u, step, side):
    """First node and the four splines' values [point, 4] of one axis at each of some points; where a spline is none of
    the surface's, its value is 0 and its node the nearest there is."""
    first, values = np.zeros(u.size, np.int64), np.zeros((u.size, 4))
    middle = (side - 1) / 2
    own = np.empty(4)
    for k in range(u.size):
        t = u[k] / step + middle
        if not -2 < t < side + 1:
            continue
        start = weights_at(t, own)
        first[k] = min(max(start, 0), side - 4)
        for a in range(4):
            if 0 <= start + a < side:
                values[k, start + a - first[k]] = own[a]
    return first, values


@compiled
def evaluate_grid(u, v, step, coefficients, out):
    """s on a grid of points u [column], v [row]."""
    side = coefficients.shape[0]
    left, along = splines_along(u, step, side)
    top, across = splines_along(v, step, side)
    line = np.empty(side)
    for r in range(v.size):
        i = top[r]
        for j in range(side):
            line[j] = (across[r, 0] * coefficients[i, j] + across[r, 1] * coefficients[i + 1, j]
                       + across[r, 2] * coefficients[i + 2, j] + across[r, 3] * coefficients[i + 3, j])  # fmt: skip
        for c in range(u.size):
            j = left[c]
            out[r, c] = (along[c, 0] * line[j] + along[c, 1] * line[j + 1]
                         + along[c, 2] * line[j + 2] + along[c, 3] * line[j + 3])  # fmt: skip
