"""Sums over the pixels of frames with the basis functions of a free light shape.

The basis functions are cubic B-splines at the nodes of a `ShapeGrid`, each with a coefficient. The derivative of the
light of a pixel by a coefficient is its basis function at the pixel, times the peak. An `Evaluation` has the derivative
of ln L by the light of each pixel (`light_score`), the Fisher information on it (`light_information`), and derivatives
of the light by the spot parameters ln peak, ln σ, x and y (`slopes`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from spotcheck.discrepancy.evaluation import SPOT_PARAMETERS, Evaluation
from spotcheck.discrepancy.spline_basis import NEIGHBOURS, add_information, add_products, add_values

if TYPE_CHECKING:
    from spotcheck.discrepancy.joint_fit import JointModel


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

        It is the transposed band of `spline_basis.add_information`.
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
