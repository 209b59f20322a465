"""Sums over the pixels of frames with the basis functions of a free light shape.

The basis functions are products of cubic B-splines along u and v at the nodes of a `ShapeGrid`, each with a
coefficient: that of node (row j, column i) has the number j · nodes + i. The derivative of the light of a pixel by a
coefficient is its basis function at the pixel, times the peak. At a pixel at (u, v) [σ from the centre] only the 4 × 4
splines of the nearest nodes differ from 0. An `Evaluation` has the derivative
of ln L by the light of each pixel (`light_score`), the Fisher information on it (`light_information`), and derivatives
of the light by the spot parameters ln peak, ln σ, x and y (`slopes`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from spotcheck.discrepancy.evaluation import Evaluation
from spotcheck.discrepancy.frames import SPOT_PARAMETERS
from spotcheck.model.light_shape import cubic_weights
from spotcheck.sensor.codes import compiled

if TYPE_CHECKING:
    from spotcheck.discrepancy.joint_fit import JointModel

# Coefficients that lie more than so many rows or columns apart share no pixel.
NEIGHBOURS = 3
# Splines along an axis that differ from 0 at a point.
SPLINES = NEIGHBOURS + 1


class ShapeSums:
    """Sums over the pixels of some frames with the basis functions of a free shape.

    The light of a pixel may be a sum of displaced copies of the spot, as after a blur or with a ghost. The score
    contains all copies. The information contains them as one copy at the place of the strongest, which keeps its band
    narrow: steps of a fit then differ from those of Fisher scoring, but end at the same place.

    Parameters
    ----------
    model : JointModel
        Model with a free shape.
    evaluation : Evaluation
        The model at the pixels of the frames.

    Attributes
    ----------
    nodes : int
        Number of nodes along each side of the grid.
    strongest : tuple of three arrays [frame, pixel]
        u and v [σ] of each pixel from the centre of the strongest copy, and the summed factor of all copies [DN].
    """

    def __init__(self, model: JointModel, evaluation: Evaluation) -> None:
        assert model.grid is not None
        self.nodes, self._per_step, self._evaluation = model.grid.nodes, 1 / model.grid.step, evaluation
        shape = evaluation.residual.shape
        # Each copy: u, v [σ] of each pixel from its centre, and factor [DN] of the basis functions [frame, pixel].
        copies = [
            tuple(np.ascontiguousarray(np.broadcast_to(array, shape)).reshape(shape[0], -1) for array in copy)
            for copy in model.forward.shape_response(evaluation.conditions)
        ]
        u, v, _ = max(copies, key=lambda copy: float(np.sum(np.abs(copy[2]))))
        self._copies, self.strongest = copies, (u, v, np.sum([factor for _, _, factor in copies], axis=0))

    def score(self) -> np.ndarray:
        """Return the score of the coefficients [coefficient]."""
        score = np.zeros((self.nodes**2, 1))
        for copy in self._copies:
            self._add_products(copy, self._evaluation.light_score[None], score)
        return score[:, 0]

    def products(self, values: np.ndarray) -> np.ndarray:
        """Return Σ (derivative of the light by each coefficient) · values [coefficient, k]; values [k, frame, h, w]."""
        sums = np.zeros((self.nodes**2, len(values)))
        self._add_products(self.strongest, values, sums)
        return sums

    def products_of_spots(self) -> np.ndarray:
        """Return the information between coefficients and spot parameters of F frames [coefficient, 4F]."""
        weighted = self._evaluation.slopes * self._evaluation.light_information
        frames = []
        for frame in range(weighted.shape[1]):
            sums = np.zeros((self.nodes**2, SPOT_PARAMETERS))
            self._add_products(tuple(array[frame] for array in self.strongest), weighted[:, frame], sums)
            frames.append(sums)
        return np.hstack(frames)

    def _add_products(self, copy: tuple[np.ndarray, ...], values: np.ndarray, sums: np.ndarray) -> None:
        """Add Σ (derivative of the light by each coefficient) · values [k, …] to `sums` [coefficient, k]."""
        u, v, factor = (array.ravel() for array in copy)
        columns = np.ascontiguousarray(values.reshape(len(values), u.size).T)
        add_products(self._per_step, self.nodes, u, v, factor, columns, sums)

    def band(self) -> np.ndarray:
        """Return the information of the coefficients as a band [diagonal, coefficient].

        It is the transposed band of `add_information`.
        """
        band = np.zeros((self.nodes**2, (NEIGHBOURS + 1) * (2 * NEIGHBOURS + 1)))
        u, v, factor = self.strongest
        weight = self._evaluation.light_information.reshape(factor.shape) * factor**2
        add_information(self._per_step, self.nodes, u.ravel(), v.ravel(), weight.ravel(), band)
        return np.ascontiguousarray(band.T)

    def values(self, coefficients: np.ndarray) -> np.ndarray:
        """Return changes of the light [k, frame, h, w; DN] by changes of the coefficients [coefficient, k]."""
        shape = self._evaluation.residual.shape
        changes = np.zeros((int(np.prod(shape)), coefficients.shape[1]))
        u, v, factor = (array.ravel() for array in self.strongest)
        add_values(self._per_step, self.nodes, u, v, factor, coefficients, changes)
        return changes.T.reshape(-1, *shape)


# Compiled sums over points, the pixels of several frames; arrays over points are flat. `per_step` is the number of
# nodes per σ. Points outside the grid are left out. The indices q and p count the splines along rows and columns that
# differ from 0 at a point.


@compiled
def locate(per_step, nodes, u, v):
    """Return column and row of the node below a point u, v [σ], and the weights of the splines along both.

    The column is 0 for points outside the grid, where not all splines have a node; it is at least 1 inside.
    """
    middle = (nodes - 1) / 2
    x, y = u * per_step + middle, v * per_step + middle
    is_inside = 1.0 <= x < nodes - 2.0 and 1.0 <= y < nodes - 2.0
    column, row = (math.floor(x), math.floor(y)) if is_inside else (0, 0)
    return column, row, cubic_weights(x - column), cubic_weights(y - row)


@compiled
def add_products(per_step, nodes, u, v, factor, values, sums):
    """Add Σ over points of factor · basis · values to `sums` [coefficient, k].

    u, v, factor [point]; values [point, k].
    """
    for n in range(u.size):
        column, row, column_weights, row_weights = locate(per_step, nodes, u[n], v[n])
        if factor[n] == 0.0 or column < 1:
            continue
        for k in range(values.shape[1]):
            value = factor[n] * values[n, k]
            for q in range(SPLINES):
                index = (row + q - 1) * nodes + column - 1
                for p in range(SPLINES):
                    sums[index + p, k] += value * row_weights[q] * column_weights[p]


@compiled
def add_values(per_step, nodes, u, v, factor, coefficients, values):
    """Add factor · Σ over coefficients of basis · coefficients to `values` [point, k].

    u, v, factor [point]; coefficients [coefficient, k].
    """
    for n in range(u.size):
        column, row, column_weights, row_weights = locate(per_step, nodes, u[n], v[n])
        if factor[n] == 0.0 or column < 1:
            continue
        for q in range(SPLINES):
            for p in range(SPLINES):
                value = factor[n] * row_weights[q] * column_weights[p]
                index = (row + q - 1) * nodes + column + p - 1
                for k in range(coefficients.shape[1]):
                    values[n, k] += value * coefficients[index, k]


@compiled
def add_information(per_step, nodes, u, v, weight, band):
    """Add Σ over points of weight · basis · basis' to `band` [coefficient, (NEIGHBOURS + 1) (2 NEIGHBOURS + 1)].

    u, v, weight [point]. The matrix is symmetric: for coefficient k, column dj (2 NEIGHBOURS + 1) + di + NEIGHBOURS of
    the band holds the information with the coefficient dj rows and di columns further, dj ≥ 0.
    """
    for n in range(u.size):
        column, row, column_weights, row_weights = locate(per_step, nodes, u[n], v[n])
        if weight[n] == 0.0 or column < 1:
            continue
        for q in range(SPLINES):
            for p in range(SPLINES):
                product = weight[n] * row_weights[q] * column_weights[p]
                of_coefficient = band[(row + q - 1) * nodes + column + p - 1]
                for dq in range(SPLINES - q):
                    factor = product * row_weights[q + dq]
                    for p_other in range(p if dq == 0 else 0, SPLINES):
                        of_coefficient[dq * (2 * NEIGHBOURS + 1) + p_other - p + NEIGHBOURS] += (
                            factor * column_weights[p_other]
                        )
