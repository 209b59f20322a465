"""Normal equations of the light's shape beside few other numbers: a banded part, a dense part, and what joins them.

The shape's coefficients are many, but each meets only its neighbours: G [coefficient, coefficient] is banded. All other
numbers (frames, effects, sheet) are few: D [number, number] is dense, X [coefficient, number] joins both. What the
shape leaves of the others is Schur's complement D − Xᵀ G⁻¹ X.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy import linalg

from spotcheck.model.light_shape import splines_at

# Part of its own information that every number gets on top where a system is solved.
DAMPING = 1e-9

compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def gather(u, v, step, side, weight, gram):
    """Add Σ w b bᵀ of the splines b at points u, v [point] to `gram` [coefficient, 4, 7]: each with itself and those
    behind it."""
    across, along = np.empty(4), np.empty(4)
    for k in range(u.size):
        heavy = weight[k]
        reached, i, j = splines_at(u[k], v[k], step, side, across, along)
        if heavy == 0 or not reached:
            continue
        for a in range(4):
            if not 0 <= i + a < side:
                continue
            for b in range(4):
                if not 0 <= j + b < side:
                    continue
                own = (i + a) * side + j + b
                mine = heavy * across[a] * along[b]
                for c in range(a, 4):
                    if i + c >= side:
                        break
                    part = mine * across[c]
                    for d in range(b if c == a else 0, 4):
                        if 0 <= j + d < side:
                            gram[own, c - a, d - b + 3] += part * along[d]


@compiled
def project(u, v, step, side, values, out):
    """Add Σ values b of the splines b at points u, v [point] to `out` [coefficient, column]; values [column, point]."""
    across, along = np.empty(4), np.empty(4)
    for k in range(u.size):
        reached, i, j = splines_at(u[k], v[k], step, side, across, along)
        if not reached:
            continue
        for a in range(4):
            if not 0 <= i + a < side:
                continue
            for b in range(4):
                if not 0 <= j + b < side:
                    continue
                own = (i + a) * side + j + b
                part = across[a] * along[b]
                for c in range(values.shape[0]):
                    out[own, c] += part * values[c, k]


def banded(gram: np.ndarray, side: int) -> np.ndarray:
    """`gram` in scipy's lower banded form [diagonal, coefficient]."""
    out = np.zeros((3 * side + 4, side * side))
    for a in range(4):
        for b in range(-3, 4):
            if a * side + b >= 0:
                out[a * side + b] += gram[:, a, b + 3]
    return out


def roughness(side: int) -> np.ndarray:
    """Σ of squared second differences along both axes, as a lower banded form [diagonal, coefficient]."""
    second = np.diff(np.eye(side), 2, axis=0)
    one = second.T @ second
    out = np.zeros((3 * side + 4, side * side))
    for gap in range(3):
        inner = np.zeros((side, side))
        inner[:, : side - gap] += np.diag(one, -gap)
        out[gap] += inner.ravel()
        outer = np.zeros((side, side))
        outer[: side - gap] += np.diag(one, -gap)[:, None]
        out[gap * side] += outer.ravel()
    return out


def product(band: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A symmetric banded matrix (lower form) times a vector."""
    out = band[0] * vector
    for gap in np.flatnonzero(band.any(axis=1)):
        if gap:
            out[gap:] += band[gap, :-gap] * vector[:-gap]
            out[:-gap] += band[gap, :-gap] * vector[gap:]
    return out


class Schur(NamedTuple):
    """G's Cholesky factor (lower banded), G⁻¹X, and what the shape takes and leaves of the other numbers'
    information."""

    factor: np.ndarray
    absorbed: np.ndarray
    given: np.ndarray
    left: np.ndarray

    def solve(self, shape: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Both parts of the solution for a right-hand side in two parts [coefficient], [number]."""
        inner = linalg.cho_solve_banded((self.factor, True), shape)
        if not others.size:
            return inner, others
        joined = self.absorbed.T @ shape
        step = solve(self.left, others - joined)
        return inner - self.absorbed @ step, step


def solve(information: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Steps of numbers; one of which nothing is told, or two that share all, do not stop the others."""
    own = np.diag(information)
    damped = information + np.diag(np.where(own > 0, DAMPING * own, 1.0))
    return linalg.solve(damped, score, assume_a="sym")


def schur(band: np.ndarray, joined: np.ndarray, dense: np.ndarray) -> Schur:
    """Factor G and reduce D."""
    factor = linalg.cholesky_banded(band, lower=True, check_finite=False)
    absorbed = linalg.cho_solve_banded((factor, True), joined) if joined.shape[1] else joined
    given = joined.T @ absorbed
    return Schur(factor, absorbed, given, dense - given)
