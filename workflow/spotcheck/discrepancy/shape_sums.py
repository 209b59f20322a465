"""Sums over the pixels of frames with the basis of a free light shape."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from spotcheck.discrepancy.evaluation import Evaluation
from spotcheck.discrepancy.spline_basis import NEIGHBOURS, add_information, add_products, add_values

if TYPE_CHECKING:
    from spotcheck.discrepancy.joint_fit import JointModel


class ShapeSums:
    """Sums over the pixels of an evaluation with the basis of a free shape."""

    def __init__(self, model: JointModel, at: Evaluation) -> None:
        assert model.grid is not None
        self.nodes, self.per_step, self.at = model.grid.nodes, 1 / model.grid.step, at
        shape = at.residual.shape
        self.copies = [
            tuple(np.ascontiguousarray(np.broadcast_to(part, shape)).reshape(shape[0], -1) for part in copy)
            for copy in model.forward.shape_response(at.conditions)
        ]

    def products(self, values: np.ndarray) -> np.ndarray:
        """Return Σ (derivative of the light by each coefficient) · values [coefficient, k]; values [k, frame, h, w]."""
        out = np.zeros((self.nodes**2, len(values)))
        flat = np.ascontiguousarray(values.reshape(len(values), -1).T)
        for u, v, factor in self.copies:
            add_products(self.per_step, self.nodes, u.ravel(), v.ravel(), factor.ravel(), flat, out)
        return out

    def products_of_spots(self) -> np.ndarray:
        """Return the information between coefficients and the spots of the frames [coefficient, 4 frames]."""
        information = self.at.light_information
        frames = []
        for f in range(len(information)):
            out = np.zeros((self.nodes**2, 4))
            values = np.ascontiguousarray((self.at.slopes[:, f] * information[f]).reshape(4, -1).T)
            for u, v, factor in self.copies:
                add_products(self.per_step, self.nodes, u[f], v[f], factor[f], values, out)
            frames.append(out)
        return np.hstack(frames)

    def band(self) -> np.ndarray:
        """Return the information of the coefficients as a band; see `spline_basis.add_information`.

        Copies of the spot, as of a blur, count as one at the place of the first: steps of the fit are then not quite
        those of Fisher scoring, but end at the same place.
        """
        band = np.zeros(((NEIGHBOURS + 1) * (2 * NEIGHBOURS + 1), self.nodes**2))
        u, v, _ = self.copies[len(self.copies) // 2]
        total = np.sum([factor for _, _, factor in self.copies], axis=0)
        weight = self.at.light_information.reshape(total.shape) * total**2
        add_information(self.per_step, self.nodes, u.ravel(), v.ravel(), weight.ravel(), band)
        return band

    def values(self, coefficients: np.ndarray) -> np.ndarray:
        """Return changes of the light [k, frame, h, w] by changes of the coefficients [coefficient, k]."""
        shape = self.at.residual.shape
        out = np.zeros((np.prod(shape), coefficients.shape[1]))
        for u, v, factor in self.copies:
            add_values(self.per_step, self.nodes, u.ravel(), v.ravel(), factor.ravel(), coefficients, out)
        return out.T.reshape(-1, *shape)
