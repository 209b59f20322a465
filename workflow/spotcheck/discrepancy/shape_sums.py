"""Sums over the pixels of frames with the basis of a free light shape."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from spotcheck.discrepancy.evaluation import Evaluation
from spotcheck.discrepancy.spline_basis import NEIGHBOURS, add_information, add_products, add_values

if TYPE_CHECKING:
    from spotcheck.discrepancy.joint_fit import JointModel


class ShapeSums:
    """Sums over the pixels of an evaluation with the basis of a free shape.

    The score takes all copies of the spot, as of a blur or a ghost. In the information they count as one at the place
    of the strongest, which keeps its band narrow: steps of a fit are then not quite those of Fisher scoring, but end at
    the same place.
    """

    def __init__(self, model: JointModel, at: Evaluation) -> None:
        assert model.grid is not None
        self.nodes, self.per_step, self.at = model.grid.nodes, 1 / model.grid.step, at
        shape = at.residual.shape
        self.copies = [
            tuple(np.ascontiguousarray(np.broadcast_to(part, shape)).reshape(shape[0], -1) for part in copy)
            for copy in model.forward.shape_response(at.conditions)
        ]
        u, v, _ = max(self.copies, key=lambda copy: float(np.sum(np.abs(copy[2]))))
        self.strongest = (u, v, np.sum([factor for _, _, factor in self.copies], axis=0))

    def score(self) -> np.ndarray:
        """Return the score of the coefficients [coefficient]."""
        out = np.zeros((self.nodes**2, 1))
        for copy in self.copies:
            self._add_products(copy, self.at.light_score[None], out)
        return out[:, 0]

    def products(self, values: np.ndarray) -> np.ndarray:
        """Return Σ (derivative of the light by each coefficient) · values [coefficient, k]; values [k, frame, h, w]."""
        out = np.zeros((self.nodes**2, len(values)))
        self._add_products(self.strongest, values, out)
        return out

    def products_of_spots(self) -> np.ndarray:
        """Return the information between coefficients and the spots of the frames [coefficient, 4 frames]."""
        weighted = self.at.slopes * self.at.light_information
        frames = []
        for f in range(weighted.shape[1]):
            out = np.zeros((self.nodes**2, 4))
            self._add_products(tuple(part[f] for part in self.strongest), weighted[:, f], out)
            frames.append(out)
        return np.hstack(frames)

    def _add_products(self, copy: tuple[np.ndarray, ...], values: np.ndarray, out: np.ndarray) -> None:
        u, v, factor = (part.ravel() for part in copy)
        add_products(
            self.per_step, self.nodes, u, v, factor, np.ascontiguousarray(values.reshape(len(values), u.size).T), out
        )

    def band(self) -> np.ndarray:
        """Return the information of the coefficients as a band; see `spline_basis.add_information`."""
        band = np.zeros(((NEIGHBOURS + 1) * (2 * NEIGHBOURS + 1), self.nodes**2))
        u, v, factor = self.strongest
        weight = self.at.light_information.reshape(factor.shape) * factor**2
        add_information(self.per_step, self.nodes, u.ravel(), v.ravel(), weight.ravel(), band)
        return band

    def values(self, coefficients: np.ndarray) -> np.ndarray:
        """Return changes of the light [k, frame, h, w] by changes of the coefficients [coefficient, k]."""
        shape = self.at.residual.shape
        out = np.zeros((int(np.prod(shape)), coefficients.shape[1]))
        u, v, factor = (part.ravel() for part in self.strongest)
        add_values(self.per_step, self.nodes, u, v, factor, coefficients, out)
        return out.T.reshape(-1, *shape)
