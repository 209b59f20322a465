"""Nodes of a free light shape, its roughness penalty, and the Cholesky factor of its information.

A free light shape is fitted beside the declared shape: a sum of cubic B-splines at the nodes of a square grid about the
centre of the spot. Coordinates u and v are column and row from the centre in units of the spot's width σ. Coefficients,
in peaks of the declared shape, are numbered row after row.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from scipy import linalg

from spotcheck.discrepancy.shape_sums import NEIGHBOURS, SPLINES

# Distance of the nodes [σ]: with 0.2 σ real beams appear to have an effect (a bend q = −0.018) that they do not have.
STEP = 0.13
# Half width of the square of nodes [σ]: real beams end at 4.6 rms widths, which may be 6 σ of the declared fit.
HALF_WIDTH = 5.5
# Prior standard deviation [peak] of the second difference of coefficients, and the distance [σ] of nodes for which it
# holds. It decides the shape where there are no data.
ROUGHNESS_SD, ROUGHNESS_STEP = 0.3, 0.2
# Number of neighbours along a line that the penalty on second differences couples with a node, itself included.
COUPLED = 3
# Added to the diagonal of the penalty [weight of the penalty]: the penalty alone is 0 for planes.
RIDGE = 1e-3
# Added to the diagonal of the penalty [weight of the penalty] for nodes beyond the circle within the square: the shape
# must end at 0.
FIXED_AT_ZERO = 1e7
# Solution of L x = b, or of L'x = b with trans=1, for a lower triangular matrix L.
_solve_lower = partial(linalg.solve_triangular, lower=True, check_finite=False)


@dataclass(frozen=True)
class ShapeGrid:
    """Nodes of a free light shape: N × N places about the centre of the spot."""

    step: float = STEP  # distance of the nodes [σ]

    @property
    def nodes(self) -> int:
        """Number N of nodes along each side."""
        return 2 * round(HALF_WIDTH / self.step) + 3

    @property
    def places(self) -> np.ndarray:
        """Places of the nodes along each side from the centre [node, σ]."""
        return (np.arange(self.nodes) - (self.nodes - 1) / 2) * self.step

    @cached_property
    def penalty(self) -> dict[int, np.ndarray]:
        """Matrix P of the penalty c'Pc in −2 ln L on the coefficients c.

        Keys are the distances of diagonals below the main one. Values are these diagonals [coefficient]: entry k is
        P[k + key, k]; the last entries, for which k + key exceeds the matrix, are 0.
        """
        nodes = self.nodes
        weight = 1 / (ROUGHNESS_SD * (self.step / ROUGHNESS_STEP) ** 2) ** 2
        # Matrix of the sum of squared second differences along one line of nodes.
        second_differences = np.diff(np.eye(nodes), 2, axis=0)
        line = second_differences.T @ second_differences
        penalty = {0: np.zeros(nodes * nodes)}
        for distance in range(COUPLED):
            along_u, along_v = np.zeros((nodes, nodes)), np.zeros((nodes, nodes))
            along_u[:, : nodes - distance] = np.diagonal(line, -distance)[None]
            along_v[: nodes - distance] = np.diagonal(line, -distance)[:, None]
            for offset, values in ((distance, along_u), (distance * nodes, along_v)):
                penalty[offset] = penalty.get(offset, 0.0) + weight * values.ravel()
        penalty[0] = penalty[0] + weight * (RIDGE + FIXED_AT_ZERO * self.is_outer)
        return penalty

    @property
    def is_outer(self) -> np.ndarray:
        """Whether a node lies beyond the circle within the square, where the shape is 0 [coefficient].

        The splines of two nodes overlap if they are at most `NEIGHBOURS` steps apart.
        """
        distance = np.hypot(self.places[:, None], self.places) / self.step
        return (distance > (self.nodes - 1) / 2 - NEIGHBOURS).ravel()

    @cached_property
    def block_of_node(self) -> np.ndarray:
        """Number of the block of each node along a side [node].

        A block has `SPLINES` nodes along each side, so that two of its nodes lie within the band of the information.
        The last block of a line holds fewer.
        """
        return np.arange(self.nodes) // SPLINES

    def average_blocks(self, values: np.ndarray) -> np.ndarray:
        """Return the means of values [coefficient] over blocks of nodes [block row, block column]."""
        lengths = np.bincount(self.block_of_node)
        starts = np.arange(len(lengths)) * SPLINES
        sums = np.add.reduceat(np.add.reduceat(values.reshape(self.nodes, self.nodes), starts, axis=0), starts, axis=1)
        return sums / np.outer(lengths, lengths)

    def spread_blocks(self, values: np.ndarray) -> np.ndarray:
        """Return to each node the value of its block [coefficient]; `values` are [block row, block column]."""
        return values[np.ix_(self.block_of_node, self.block_of_node)].ravel()

    def add_to_sums(self, band: np.ndarray, information: np.ndarray) -> None:
        """Add information on the sums over blocks [block row, block column] to a band of information in place.

        `band` is in the form of `ShapeSums.band`.
        """
        of_node = self.spread_blocks(information)
        row, column = np.divmod(np.arange(self.nodes**2), self.nodes)
        width = 2 * NEIGHBOURS + 1
        for k, values in enumerate(band):
            other_row, other_column = row + k // width, column + k % width - NEIGHBOURS
            is_in_block = (other_row // SPLINES == row // SPLINES) & (other_column // SPLINES == column // SPLINES)
            values += of_node * (is_in_block & (other_row < self.nodes) & (other_column < self.nodes))

    def penalize(self, coefficients: np.ndarray) -> np.ndarray:
        """Return P c [coefficient] for coefficients c [coefficient, peak]: half the gradient of the penalty."""
        product = self.penalty[0] * coefficients
        for offset, values in self.penalty.items():
            if offset:
                count = coefficients.size - offset
                product[offset:] += values[:count] * coefficients[:count]
                product[:count] += values[:count] * coefficients[offset:]
        return product


class BlockFactor:
    """Cholesky factor L of the Fisher information of a shape's coefficients, in dense blocks.

    The information is banded: it is cut into blocks as large as its band is wide, so that only blocks on the diagonal
    and the ones below them are not 0. Products of dense blocks solve hundreds of right-hand sides fast.

    Parameters
    ----------
    grid : ShapeGrid
        Nodes of the shape, with the penalty.
    band : array [diagonal, coefficient]
        Information from the pixels, in the form of `ShapeSums.band`.
    share : float
        Part of the penalty that is added to it: 1, or the share of a subset of the pixels.
    """

    def __init__(self, grid: ShapeGrid, band: np.ndarray, share: float) -> None:
        nodes = grid.nodes
        self._count, self._size = nodes * nodes, NEIGHBOURS * nodes + NEIGHBOURS + 1
        blocks = -(-self._count // self._size)
        # Blocks on the diagonal, and below each of them [block, row, column]: first of the information, then of L.
        self._diagonal = np.zeros((blocks, self._size, self._size))
        self._below = np.zeros((blocks, self._size, self._size))
        width = 2 * NEIGHBOURS + 1
        for row, values in enumerate(band):
            # Position of the diagonal below the main one; diagonals above it repeat others, by symmetry.
            offset = (row // width) * nodes + row % width - NEIGHBOURS
            if offset >= 0:
                self._add_diagonal(offset, values)
        for offset, values in grid.penalty.items():
            self._add_diagonal(offset, share * values)
        # The last block is filled up with a unit matrix.
        padding = np.arange(self._count, blocks * self._size) - (blocks - 1) * self._size
        self._diagonal[-1, padding, padding] = 1.0
        for b in range(blocks):
            block = np.tril(self._diagonal[b]) + np.tril(self._diagonal[b], -1).T
            if b:
                block -= self._below[b - 1] @ self._below[b - 1].T
            self._diagonal[b] = linalg.cholesky(block, lower=True, check_finite=False)
            if b + 1 < blocks:
                self._below[b] = _solve_lower(self._diagonal[b], self._below[b].T).T

    def _add_diagonal(self, offset: int, values: np.ndarray) -> None:
        """Add values [coefficient] to the diagonal `offset` below the main one: value k to (k + offset, k)."""
        k = np.arange(self._count - offset)
        block, column = np.divmod(k, self._size)
        row = k + offset - block * self._size
        is_inside = row < self._size
        is_below = ~is_inside
        # No place occurs twice, so that the sums of indexed arrays are complete.
        self._diagonal[block[is_inside], row[is_inside], column[is_inside]] += values[k[is_inside]]
        self._below[block[is_below], row[is_below] - self._size, column[is_below]] += values[k[is_below]]

    def half_solve(self, right: np.ndarray) -> np.ndarray:
        """Return L⁻¹ right [coefficient, k] of right-hand sides [coefficient, k]."""
        solution = self._pad(right)
        for b, (diagonal, below) in enumerate(zip(self._diagonal, self._below, strict=True)):
            rows = slice(b * self._size, (b + 1) * self._size)
            solution[rows] = _solve_lower(diagonal, solution[rows])
            if b + 1 < len(self._diagonal):
                solution[rows.stop : rows.stop + self._size] -= below @ solution[rows]
        return solution[: self._count]

    def back_solve(self, right: np.ndarray) -> np.ndarray:
        """Return L⁻ᵀ right [coefficient, k] of right-hand sides [coefficient, k]."""
        solution = self._pad(right)
        for b in range(len(self._diagonal) - 1, -1, -1):
            rows = slice(b * self._size, (b + 1) * self._size)
            if b + 1 < len(self._diagonal):
                solution[rows] -= self._below[b].T @ solution[rows.stop : rows.stop + self._size]
            solution[rows] = _solve_lower(self._diagonal[b], solution[rows], trans=1)
        return solution[: self._count]

    def _pad(self, right: np.ndarray) -> np.ndarray:
        """Return right-hand sides [coefficient, k], filled up with zeros to whole blocks."""
        padded = np.zeros((len(self._diagonal) * self._size, right.shape[1]))
        padded[: self._count] = right
        return padded
