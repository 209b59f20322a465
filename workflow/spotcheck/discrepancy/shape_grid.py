"""Nodes of a free light shape, its roughness penalty, and the Cholesky factor of its information."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from spotcheck.discrepancy.spline_basis import NEIGHBOURS

# Distance of the nodes [σ]: at 0.2 a bend of q = −0.018 appears on real beams without any effect.
STEP = 0.13
# Half width of the square of nodes [σ]: real beams end at 4.6 rms widths, which may be 6 σ of the declared fit.
HALF_WIDTH = 5.5
# Prior standard deviation [peak] of a second difference of nodes 0.2 σ apart, for nodes without data.
ROUGHNESS_SD, ROUGHNESS_STEP = 0.3, 0.2
# Added to the diagonal of the penalty, in terms of its weight: the penalty alone is singular for planes.
RIDGE = 1e-3
# The same for nodes beyond a circle within the square: the shape must end at 0.
FIXED_AT_ZERO = 1e7


@dataclass(frozen=True)
class ShapeGrid:
    """Nodes of a free shape."""

    step: float = STEP  # distance of the nodes [σ]
    stiffness: float = 1.0  # factor of the roughness penalty

    @property
    def nodes(self) -> int:
        """Nodes along each side."""
        return 2 * round(HALF_WIDTH / self.step) + 3

    @property
    def places(self) -> np.ndarray:
        """Places of the nodes along each side [node, σ]."""
        return (np.arange(self.nodes) - (self.nodes - 1) / 2) * self.step

    @cached_property
    def penalty(self) -> dict[int, np.ndarray]:
        """Matrix P of the penalty c'Pc in −2 ln L on the coefficients c [peak], as diagonals of its lower half."""
        nodes = self.nodes
        weight = self.stiffness / (ROUGHNESS_SD * (self.step / ROUGHNESS_STEP) ** 2) ** 2
        second = np.diff(np.eye(nodes), 2, axis=0)
        line = second.T @ second
        penalty = {0: np.zeros(nodes * nodes)}
        for distance in range(3):
            along_u, along_v = np.zeros((nodes, nodes)), np.zeros((nodes, nodes))
            along_u[:, : nodes - distance] = np.diagonal(line, -distance)[None]
            along_v[: nodes - distance] = np.diagonal(line, -distance)[:, None]
            for offset, values in ((distance, along_u), (distance * nodes, along_v)):
                penalty[offset] = penalty.get(offset, 0.0) + weight * values.ravel()
        from_middle = np.arange(nodes) - (nodes - 1) / 2
        is_outer = np.hypot(from_middle[:, None], from_middle) > (nodes - 1) / 2 - NEIGHBOURS
        penalty[0] = penalty[0] + weight * (RIDGE + FIXED_AT_ZERO * is_outer.ravel())
        return penalty

    def penalize(self, coefficients: np.ndarray) -> np.ndarray:
        """Return P c [coefficient]."""
        product = self.penalty[0] * coefficients
        for offset, values in self.penalty.items():
            if offset:
                count = coefficients.size - offset
                product[offset:] += values[:count] * coefficients[:count]
                product[:count] += values[:count] * coefficients[offset:]
        return product


class BlockFactor:
    """Cholesky factor L of the information of a shape, in dense blocks as large as its band is wide.

    Dense blocks let hundreds of right-hand sides be solved at the speed of matrix products.
    """

    def __init__(self, grid: ShapeGrid, band: np.ndarray, share: float) -> None:
        """Factor the sum of a share of the penalty and the band of `spline_basis.add_information`."""
        nodes = grid.nodes
        self.count, self.size = nodes * nodes, NEIGHBOURS * nodes + NEIGHBOURS + 1
        blocks = -(-self.count // self.size)
        self.diagonal = np.zeros((blocks, self.size, self.size))
        self.below = np.zeros((blocks, self.size, self.size))
        width = 2 * NEIGHBOURS + 1
        for row, values in enumerate(band):
            offset = (row // width) * nodes + row % width - NEIGHBOURS
            if offset >= 0:
                self._add_diagonal(offset, values)
        for offset, values in grid.penalty.items():
            self._add_diagonal(offset, share * values)
        padding = np.arange(self.count, blocks * self.size) - (blocks - 1) * self.size
        self.diagonal[-1, padding, padding] = 1.0
        for b in range(blocks):
            block = np.tril(self.diagonal[b]) + np.tril(self.diagonal[b], -1).T
            if b:
                block -= self.below[b - 1] @ self.below[b - 1].T
            self.diagonal[b] = linalg.cholesky(block, lower=True, check_finite=False)
            if b + 1 < blocks:
                self.below[b] = linalg.solve_triangular(
                    self.diagonal[b], self.below[b].T, lower=True, check_finite=False
                ).T

    def _add_diagonal(self, offset: int, values: np.ndarray) -> None:
        """Add values [coefficient] at (k + offset, k) of the matrix."""
        k = np.arange(self.count - offset)
        block, column = np.divmod(k, self.size)
        row = k + offset - block * self.size
        inside = row < self.size
        np.add.at(self.diagonal, (block[inside], row[inside], column[inside]), values[k[inside]])
        outside = ~inside
        np.add.at(self.below, (block[outside], row[outside] - self.size, column[outside]), values[k[outside]])

    def half_solve(self, right: np.ndarray) -> np.ndarray:
        """Return L⁻¹ right [coefficient, k]."""
        solution = self._padded(right)
        for b, (diagonal, below) in enumerate(zip(self.diagonal, self.below, strict=True)):
            here = slice(b * self.size, (b + 1) * self.size)
            solution[here] = linalg.solve_triangular(diagonal, solution[here], lower=True, check_finite=False)
            if b + 1 < len(self.diagonal):
                solution[here.stop : here.stop + self.size] -= below @ solution[here]
        return solution[: self.count]

    def back_solve(self, right: np.ndarray) -> np.ndarray:
        """Return L⁻ᵀ right [coefficient, k]."""
        solution = self._padded(right)
        for b in range(len(self.diagonal) - 1, -1, -1):
            here = slice(b * self.size, (b + 1) * self.size)
            if b + 1 < len(self.diagonal):
                solution[here] -= self.below[b].T @ solution[here.stop : here.stop + self.size]
            solution[here] = linalg.solve_triangular(
                self.diagonal[b], solution[here], lower=True, trans=1, check_finite=False
            )
        return solution[: self.count]

    def _padded(self, right: np.ndarray) -> np.ndarray:
        padded = np.zeros((len(self.diagonal) * self.size, right.shape[1]))
        padded[: self.count] = right
        return padded
