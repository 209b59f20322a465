"""Normal equations of Fisher scoring.

Unknowns are the coefficients of a free light shape, if there is one; ln peak, ln σ, x and y of each frame; then the
fitted parameters of sensor and effects. The shape's coefficients are eliminated (Schur complement). Their information B
is banded and factored as L L'. With its cross terms C and score b, the other unknowns have the information
H − (L⁻¹C)'(L⁻¹C) and the score h − (L⁻¹C)'L⁻¹b.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import linalg

from spotcheck.discrepancy.evaluation import Column, Evaluation, differentiate_readings, evaluate, sum_batches
from spotcheck.discrepancy.frames import Pixels
from spotcheck.discrepancy.shape_grid import BlockFactor
from spotcheck.discrepancy.shape_sums import ShapeSums
from spotcheck.discrepancy.spline_basis import NEIGHBOURS

if TYPE_CHECKING:
    from spotcheck.discrepancy.joint_fit import JointModel

# Eigenvalues of an information matrix with a unit diagonal below which a direction carries no information.
NULL_EIGENVALUE = 1e-12
# Weight of the condition that steps of spots sum to 0 over frames, in terms of a spot's median information over F.
GAUGE_WEIGHT = 1e4
# Added to the information on a coefficient of the shape that stays at its least value, in terms of the largest.
AT_BOUND = 1e8
# Added to the diagonal of an information matrix that is scaled to 1, so that it can be factored.
RIDGE = 1e-11


@dataclass(frozen=True)
class ShapePart:
    """What is left of a free shape's coefficients after their elimination."""

    factor: BlockFactor  # Cholesky factor L of the shape's information
    of_spots: np.ndarray  # L⁻¹C of the spots [coefficient, 4F]
    spots_schur: np.ndarray  # its product with itself [4F, 4F]
    of_others: np.ndarray  # L⁻¹C of the parameters of sensor and effects [coefficient, k]
    score: np.ndarray  # L⁻¹b [coefficient]

    @property
    def cross(self) -> np.ndarray:
        """L⁻¹C of all other unknowns [coefficient, n]."""
        return np.hstack([self.of_spots, self.of_others])


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of a model: n unknowns beside the shape, of which the first 4F are the spots of F frames."""

    information: np.ndarray  # Fisher information beside the shape [n, n]
    gradient: np.ndarray  # score beside the shape [n]
    diagonal: np.ndarray  # diagonal of the information with the shape fixed fixed [n]
    deviance: float  # −2 ln L but for a constant, with the penalty of the shape
    dispersion: float  # mean squared standardised residual
    frames: int  # number F of frames
    shape: ShapePart | None = None  # what is left of the shape; None beside the declared one

    @property
    def size(self) -> int:
        """Number n of unknowns."""
        return len(self.gradient)

    def has_factor_of(self, other: NormalEquations) -> bool:
        """Whether these equations use the same factor of the shape's information as others."""
        return self.shape is not None and other.shape is not None and self.shape.factor is other.shape.factor

    def solve(self, damping: float, fixed: np.ndarray) -> np.ndarray:
        """Return the step [n] of Fisher scoring; `damping` is added to the diagonal, relative to it. Held unknowns
        [n] do not move."""
        matrix = self.information + damping * np.diag(self.diagonal)
        step = np.zeros(self.size)
        step[~fixed] = solve_positive(matrix[np.ix_(~fixed, ~fixed)], self.gradient[~fixed])
        return step

    def promise(self, step: np.ndarray) -> float:
        """Return the drop of −2 ln L that a step promises, with that of the shape which belongs to it."""
        of_shape = 0.0 if self.shape is None else float(self.shape.score @ self.shape.score)
        return float(2 * step @ self.gradient - step @ self.information @ step) + of_shape

    def shape_step(self, step: np.ndarray) -> np.ndarray:
        """Return the step of the shape's coefficients that belongs to a step of the other unknowns."""
        assert self.shape is not None
        return self.shape.factor.back_solve((self.shape.score - self.shape.cross @ step)[:, None])[:, 0]

    def decrements(self, step: np.ndarray, fixed: np.ndarray) -> tuple[float, float]:
        """Return the Newton decrement of all unknowns, and that of the effects beside the spots."""
        first = 4 * self.frames
        free = np.flatnonzero(~fixed[first:]) + first
        total = self.promise(step)
        if free.size == 0:
            return total, 0.0
        spots = np.arange(first)
        cross = self.information[np.ix_(spots, free)]
        beside = self.information[np.ix_(free, free)] - cross.T @ solve_positive(
            self.information[np.ix_(spots, spots)], cross
        )
        return total, float(step[free] @ beside @ step[free])


def solve_positive(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution of a symmetric, nearly positive system, scaled to a unit diagonal first."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * scale[:, None] * scale
    rhs = (right.T * scale).T
    try:
        factor = linalg.cho_factor(scaled + RIDGE * np.eye(len(scaled)), check_finite=False)
        solution = linalg.cho_solve(factor, rhs, check_finite=False)
    except linalg.LinAlgError:
        solution = np.linalg.lstsq(scaled, rhs, rcond=1e-9)[0]
    return (solution.T * scale).T


def invert_information(information: np.ndarray) -> np.ndarray:
    """Return the inverse of an information matrix, scaled to a unit diagonal first: units differ by many orders."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information * scale[:, None] * scale
    return np.linalg.pinv(scaled, rcond=NULL_EIGENVALUE, hermitian=True) * scale[:, None] * scale


def assemble(model: JointModel, pixels: Pixels, reuse: ShapePart | None = None) -> NormalEquations:
    """Return the normal equations of a model at the pixels.

    The factor of the shape's information and its cross terms with the spots may be taken over from an earlier step; the
    score stays exact.
    """
    frames, free = len(model.spots.x), len(model.free)
    size = 4 * frames + free
    has_new_factor = model.grid is not None and reuse is None
    coefficients = np.zeros(0) if model.grid is None else model.coefficients
    of_spots = np.zeros((coefficients.size, 4 * frames) if has_new_factor else (0, 0))

    def of_batch(part: slice) -> tuple[Any, ...]:
        at = evaluate(model, pixels, part)
        columns = differentiate_readings(model, at)
        information, gradient = np.zeros((size, size)), np.zeros(size)
        fill_equations(at, columns, part.start, frames, information, gradient)
        used = at.weight > 0
        squares = float(np.sum(at.residual**2 * at.weight))
        deviance = squares - float(np.sum(np.log(at.weight, where=used, out=np.zeros(used.shape))))
        if model.grid is None:
            return information, gradient, deviance, squares
        sums = ShapeSums(model, at)
        equivalents = np.array([at.light_equivalent(column) for column in columns]).reshape(-1, *used.shape)
        products = np.column_stack([sums.score(), sums.products(equivalents)])
        if not has_new_factor:
            return information, gradient, deviance, squares, products
        of_spots[:, 4 * part.start : 4 * part.stop] = sums.products_of_spots()
        return information, gradient, deviance, squares, products, sums.band()

    information, gradient, deviance, squares, *of_shape = sum_batches(of_batch, pixels)
    dispersion = squares / max(pixels.count, 1)
    deviance += _add_priors(model, information, gradient, pixels.share)
    if model.grid is None:
        return NormalEquations(information, gradient, np.diag(information), deviance, dispersion, frames)
    penalty = pixels.share * model.grid.penalize(coefficients)
    products = of_shape[0]
    if reuse is None:
        band = of_shape[1]
        is_at_bound = (coefficients <= model.least_coefficients) & (products[:, 0] - penalty < 0)
        band[NEIGHBOURS] += AT_BOUND * band[NEIGHBOURS].max() * is_at_bound
        factor = BlockFactor(model.grid, band, pixels.share)
        of_spots = factor.half_solve(of_spots)
        reuse = ShapePart(factor, of_spots, of_spots.T @ of_spots, np.zeros((0, 0)), np.zeros(0))
    products[:, 0] -= penalty
    solved = reuse.factor.half_solve(products)
    shape = replace(reuse, of_others=solved[:, 1:], score=solved[:, 0])
    schur = np.zeros((size, size))
    spots, others = slice(0, 4 * frames), slice(4 * frames, size)
    schur[spots, spots] = shape.spots_schur
    schur[spots, others] = shape.of_spots.T @ shape.of_others
    schur[others, spots] = schur[spots, others].T
    schur[others, others] = shape.of_others.T @ shape.of_others
    beside = information - schur + gauge_information(model, information)
    gradient = gradient - shape.cross.T @ shape.score
    deviance += float(coefficients @ penalty)
    return NormalEquations(beside, gradient, np.diag(information), deviance, dispersion, frames, shape)


def _add_priors(model: JointModel, information: np.ndarray, gradient: np.ndarray, share: float) -> float:
    """Add the priors of the data sheet to the equations in place, and return what they add to −2 ln L.

    A subset of the pixels takes its share of a prior, so that its fit ends where that of all pixels does.
    """
    added, first = 0.0, len(gradient) - len(model.free)
    for k, parameter in enumerate(model.free):
        deviation = parameter.prior_deviation(model.value_of(parameter))
        added += share * deviation**2
        gradient[first + k] -= share * deviation / parameter.stated_stderr
        information[first + k, first + k] += share * parameter.prior_information()
    return added


def gauge_information(model: JointModel, information: np.ndarray) -> np.ndarray:
    """Return what keeps steps of the spots at a sum of 0 over frames: shape and spots could run away together, since a
    wider shape beside smaller widths is the same light."""
    frames = len(model.spots.x)
    sigma = np.exp(model.spots.log_sigma)
    out = np.zeros_like(information)
    for k in range(4):
        direction = np.zeros(len(information))
        direction[k : 4 * frames : 4] = 1.0 if k < 2 else sigma / sigma.mean()
        weight = GAUGE_WEIGHT * np.median(np.diag(information)[k : 4 * frames : 4]) / frames
        out += weight * np.outer(direction, direction)
    return out


def fill_equations(
    at: Evaluation, columns: Sequence[Column], first: int, frames: int, information: np.ndarray, gradient: np.ndarray
) -> None:
    """Add the pixels of frames from `first` on to information [n, n] and gradient [n]; columns come behind the 4F
    spots."""
    slopes, score, weight = at.slopes, at.light_score, at.light_information
    count = slopes.shape[1]
    flat = slopes.reshape(4, count, -1)
    weighted = flat * weight.reshape(1, count, -1)
    blocks = np.einsum("afp,bfp->fab", weighted, flat, optimize=True)
    of_spots = np.einsum("afp,fp->fa", flat, score.reshape(count, -1))
    equivalents = [at.light_equivalent(column).reshape(count, -1) for column in columns]
    for f in range(count):
        rows = slice(4 * (first + f), 4 * (first + f) + 4)
        information[rows, rows] += blocks[f]
        gradient[rows] += of_spots[f]
        for k, equivalent in enumerate(equivalents):
            cross = flat[:, f] @ equivalent[f]
            information[rows, 4 * frames + k] += cross
            information[4 * frames + k, rows] += cross
    for k, column in enumerate(columns):
        gradient[4 * frames + k] += at.score(column)
        for j in range(k + 1):
            value = at.information_of(column, columns[j])
            information[4 * frames + k, 4 * frames + j] += value
            if j < k:
                information[4 * frames + j, 4 * frames + k] += value
