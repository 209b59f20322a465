"""Normal equations of the light's shape beside few other numbers: a banded part, a dense part, and what joins them.

The shape's coefficients are many, but each meets only its neighbours: G [coefficient, coefficient] is banded. All other
numbers (frames, effects, sheet) are few: D [number, number] is dense, X [coefficient, number] joins both. What the
shape leaves of the others is Schur's complement D − Xᵀ G⁻¹ X.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy import linalg

from spotcheck.old_engine.model.light_shape import splines_along, splines_at

# Part of its own information that every number gets on top where a system is solved.
DAMPING = 1e-9
# Part of the best told coefficient's information that all of them get on top: of those that lie where no frame has
# pixels the penalty alone tells, which is next to nothing beside it.
SHALLOW = 1e-12
# From so many columns on a banded system is solved by blocks.
MANY = 16

compiled = njit(cache=True, nogil=True, error_model="numpy")


def gather(u, v, step: float, side: int, weight: np.ndarray, gram: np.ndarray):
    """Add Σ w b bᵀ of the splines b at the pixels of a frame to `gram` [coefficient, 4, 7]: each with itself and those
    behind it. u, v are of shapes that broadcast to that of the weights [row, column]. Without splines there is
    nothing."""
    if not side:
        return
    if _is_grid(u, v):
        gather_grid(u[0], v[:, 0], step, side, weight, gram)
    else:
        u, v = _flat(u, v, weight.shape)
        gather_points(u, v, step, side, weight.ravel(), gram)


def project(u, v, step: float, side: int, values: np.ndarray, out: np.ndarray):
    """Add Σ values b of the splines b at the pixels of a frame to `out` [coefficient, n]; values [n, row, column], u
    and v of shapes that broadcast to that of a frame."""
    if not side:
        return
    if _is_grid(u, v):
        project_grid(u[0], v[:, 0], step, side, values, out)
    else:
        u, v = _flat(u, v, values.shape[1:])
        project_points(u, v, step, side, values.reshape(len(values), -1), out)


def _is_grid(u, v) -> bool:
    """Whether u differs along columns alone and v along rows alone, so that sums go row by row."""
    return u.shape[0] == 1 and v.shape[1] == 1


def _flat(u, v, shape):
    return [np.ascontiguousarray(np.broadcast_to(own, shape)).ravel() for own in (u, v)]


@compiled
def gather_grid(u, v, step, side, weight, gram):
    """As `gather`, of u [column] and v [row]."""
    left, along = splines_along(u, step, side)
    top, across = splines_along(v, step, side)
    line = np.empty((side, 4))
    for r in range(v.size):
        line[:] = 0.0
        for c in range(u.size):
            heavy = weight[r, c]
            if heavy == 0:
                continue
            j = left[c]
            for b in range(4):
                own = heavy * along[c, b]
                for d in range(b, 4):
                    line[j + b, d - b] += own * along[c, d]
        i = top[r]
        for a in range(4):
            for c in range(a, 4):
                both = across[r, a] * across[r, c]
                if both == 0:
                    continue
                for j in range(side):
                    own = (i + a) * side + j
                    for d in range(min(4, side - j)):
                        gram[own, c - a, d + 3] += both * line[j, d]
                    if c > a:
                        for d in range(1, min(4, j + 1)):
                            gram[own, c - a, 3 - d] += both * line[j - d, d]


@compiled
def project_grid(u, v, step, side, values, out):
    """As `project`, of u [column] and v [row]."""
    left, along = splines_along(u, step, side)
    top, across = splines_along(v, step, side)
    line = np.empty(side)
    for n in range(values.shape[0]):
        for r in range(v.size):
            line[:] = 0.0
            for c in range(u.size):
                own, j = values[n, r, c], left[c]
                line[j] += own * along[c, 0]
                line[j + 1] += own * along[c, 1]
                line[j + 2] += own * along[c, 2]
                line[j + 3] += own * along[c, 3]
            for a in range(4):
                part = across[r, a]
                first = (top[r] + a) * side
                for j in range(side):
                    out[first + j, n] += part * line[j]


@compiled
def gather_points(u, v, step, side, weight, gram):
    """As `gather`, of any points u, v [point]."""
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
def project_points(u, v, step, side, values, out):
    """As `project`, of any points u, v [point]; values [n, point]."""
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
    """`gram` in scipy's lower banded form [diagonal, coefficient], of one light behind the other."""
    out = np.zeros((3 * side + 4, len(gram)))
    for a in range(4):
        for b in range(-3, 4):
            if a * side + b >= 0:
                out[a * side + b] += gram[:, a, b + 3]
    return out


def roughness(side: int, lights: int = 1) -> np.ndarray:
    """Σ of squared second differences along both axes, as a lower banded form [diagonal, coefficient], of so many
    lights one behind the other."""
    out = np.zeros((3 * side + 4, side * side))
    if not side:
        return out
    second = np.diff(np.eye(side), 2, axis=0)
    one = second.T @ second
    for gap in range(3):
        inner = np.zeros((side, side))
        inner[:, : side - gap] += np.diag(one, -gap)
        out[gap] += inner.ravel()
        outer = np.zeros((side, side))
        outer[: side - gap] += np.diag(one, -gap)[:, None]
        out[gap * side] += outer.ravel()
    return np.tile(out, lights)


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
        inner = solve_banded(self.factor, shape[:, None])[:, 0]
        if not others.size:
            return inner, others
        step = solve(self.left, others - self.absorbed.T @ shape)
        return inner - self.absorbed @ step, step

    def first(self, count: int) -> "Schur":
        """The same of so many of the numbers alone, the others held."""
        return Schur(self.factor, self.absorbed[:, :count], self.given[:count, :count], self.left[:count, :count])

    def without(self, places: np.ndarray) -> "Schur":
        """The same with the numbers at some places held."""
        keep = np.delete(np.arange(len(self.left)), places)
        both = np.ix_(keep, keep)
        return Schur(self.factor, self.absorbed[:, keep], self.given[both], self.left[both])

    def bordered(self, joined: np.ndarray, cross: np.ndarray, dense: np.ndarray) -> "Schur":
        """The same with more numbers behind: their X, what they share with those that are there [number, more], and
        their own D."""
        if not dense.size:
            return self
        more = solve_banded(self.factor, joined)
        given = np.block([[self.given, self.absorbed.T @ joined], [joined.T @ self.absorbed, joined.T @ more]])
        count = len(self.left)
        left = np.block([[self.left, cross], [cross.T, dense]])
        left[count:] -= given[count:]
        left[:count, count:] -= given[:count, count:]
        return Schur(self.factor, np.hstack([self.absorbed, more]), given, left)


def solve(information: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Steps of numbers for a score, or for columns of scores; one of which nothing is told, or two that share all, do
    not stop the others."""
    damped, unit = _damped(information)
    unit = unit if score.ndim == 1 else unit[:, None]
    return unit * linalg.solve(damped, unit * score, assume_a="sym")


def covariance(information: np.ndarray) -> np.ndarray:
    """Of numbers; infinite is the variance of one of which nothing is told."""
    damped, unit = _damped(information)
    out = linalg.inv(damped) * np.outer(unit, unit)
    untold = np.flatnonzero(np.diag(information) <= 0)
    out[untold, untold] = np.inf
    return out


def _damped(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Information in the numbers' own errors, some of which are told a million times as well as others, with a little
    on top; and these errors."""
    own = np.diag(information)
    unit = np.where(own > 0, 1 / np.sqrt(np.where(own > 0, own, 1.0)), 1.0)
    shared = np.where(np.outer(own > 0, own > 0), information, 0.0) * np.outer(unit, unit)
    return shared + np.diag(np.where(own > 0, DAMPING, 1.0)), unit


def schur(band: np.ndarray, joined: np.ndarray, dense: np.ndarray, lights: int = 1) -> Schur:
    """Factor G and reduce D. Of several lights, one behind the other, each meets few of the numbers."""
    factor = band
    if band.size:
        factor = np.vstack([band[:1] + SHALLOW * band[0].max(), band[1:]])
        factor = linalg.cholesky_banded(factor, overwrite_ab=True, lower=True, check_finite=False)
    absorbed = np.zeros_like(joined)
    for rows in np.array_split(np.arange(len(joined)), lights):
        met = joined[rows].any(axis=0)
        absorbed[np.ix_(rows, met)] = solve_banded(factor[:, rows], joined[np.ix_(rows, met)])
    given = joined.T @ absorbed
    return Schur(factor, absorbed, given, dense - given)


def solve_banded(factor: np.ndarray, right: np.ndarray) -> np.ndarray:
    """G⁻¹ times columns [coefficient, column], of G's lower banded Cholesky factor; of many columns by dense blocks,
    which is some ten times as fast as column by column."""
    if not right.size:
        return right
    if right.shape[1] < MANY:
        return linalg.cho_solve_banded((factor, True), right, check_finite=False)
    width, size = len(factor) - 1, factor.shape[1]
    starts = range(0, size, width)
    out = np.array(right, float)
    gap = np.arange(width)[:, None] - np.arange(width)
    blocks = []
    for start in starts:
        here, below = min(width, size - start), max(min(width, size - start - width), 0)
        column = start + np.arange(here)
        own = np.where(gap[:here, :here] >= 0, factor[np.maximum(gap[:here, :here], 0), column], 0.0)
        under = gap[:below, :here] + width
        blocks.append((own, np.where(under <= width, factor[np.minimum(under, width), column], 0.0)))
    for start, (own, under) in zip(starts, blocks, strict=True):
        part = linalg.solve_triangular(own, out[start : start + len(own)], lower=True, check_finite=False)
        out[start : start + len(own)] = part
        out[start + width : start + width + len(under)] -= under @ part
    for start, (own, under) in zip(reversed(starts), reversed(blocks), strict=True):
        part = out[start : start + len(own)] - under.T @ out[start + width : start + width + len(under)]
        out[start : start + len(own)] = linalg.solve_triangular(own, part, lower=True, trans=1, check_finite=False)
    return out
