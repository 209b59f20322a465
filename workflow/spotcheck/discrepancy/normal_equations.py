"""Normal equations of Fisher scoring.

Unknowns are the coefficients of a free light shape, if there is one; ln peak, ln σ, x and y of each of F frames; then
the k fitted parameters of sensor and effects. The shape's coefficients are eliminated (Schur complement), so that the
equations have n = 4F + k unknowns. The information B on the coefficients is banded and factored as L L'. With its cross
terms C and score b, the other unknowns have the information H − (L⁻¹C)'(L⁻¹C) and the score h − (L⁻¹C)'L⁻¹b.

A score is a derivative of ln L. A column is the pair (dm, dv) of the derivatives of mean and variance of the readings
by one fitted parameter, arrays [frame, h, w]. The light equivalent of a column, times a change of the light, is the
information between the column and that change. An `Evaluation` has the `residual`, its `weight`, 1/variance, and the
derivatives of the light by the spot parameters (`slopes`), with the score and information of the light of each pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import linalg

from spotcheck.discrepancy.evaluation import Column, Evaluation, differentiate_readings, evaluate, sum_batches
from spotcheck.discrepancy.frames import CENTRE_X, SPOT_PARAMETERS, Pixels
from spotcheck.discrepancy.shape_grid import BlockFactor
from spotcheck.discrepancy.shape_sums import ShapeSums

if TYPE_CHECKING:
    from spotcheck.discrepancy.joint_fit import JointModel

# Eigenvalues of an information matrix with a unit diagonal below which a direction carries no information.
NULL_EIGENVALUE = 1e-12
# Weight of the condition that steps of spots sum to 0 over frames, relative to a spot's median information over F.
GAUGE_WEIGHT = 1e4
# Part of its least light, which is negative, below which a block of the shape may stay at it.
NEAR_BOUND = 0.99
# Information on the sum over a block that stays at its least light, relative to the largest of a coefficient.
AT_BOUND = 1e6
# Added to the unit diagonal of a scaled information matrix, so that it can be factored.
RIDGE = 1e-11
# Relative singular values below which a singular system is solved without a direction.
NULL_SINGULAR = 1e-9


@dataclass(frozen=True)
class ShapePart:
    """Result of the elimination of a free shape's coefficients."""

    factor: BlockFactor  # Cholesky factor L of the shape's information, with the penalty on roughness
    spots_cross: np.ndarray  # L⁻¹C of the spots [coefficient, 4F]
    spots_schur: np.ndarray  # (L⁻¹C)'(L⁻¹C) of the spots [4F, 4F]
    others_cross: np.ndarray  # L⁻¹C of the fitted parameters of sensor and effects [coefficient, k]
    score: np.ndarray  # L⁻¹b [coefficient]
    is_at_bound: np.ndarray | bool = False  # blocks of nodes that stay at their least light [block row, block column]

    def multiply_cross(self, values: np.ndarray) -> np.ndarray:
        """Return the product L⁻¹C · values [coefficient, …] for values of the other unknowns [n, …]."""
        first = self.spots_cross.shape[1]
        return self.spots_cross @ values[:first] + self.others_cross @ values[first:]

    def multiply_transposed(self, half: np.ndarray) -> np.ndarray:
        """Return the product (L⁻¹C)' · half [n, …] for results of `BlockFactor.half_solve` [coefficient, …]."""
        return np.concatenate([self.spots_cross.T @ half, self.others_cross.T @ half])

    def solve_coefficients(self, half: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Return the coefficients L⁻ᵀ(half − L⁻¹C · others) [coefficient, k].

        They solve the equations with the right-hand sides L · half [coefficient, k], where the other unknowns have the
        values `others` [n, k].
        """
        return self.factor.back_solve(half - self.multiply_cross(others))


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of a model in its n unknowns without the shape, of which the first 4F are the spots of F frames.

    Information and score "beside the shape" are those after its elimination.
    """

    information: np.ndarray  # Fisher information beside the shape [n, n]
    gradient: np.ndarray  # score beside the shape [n]
    diagonal: np.ndarray  # diagonal of the information with the shape fixed [n]
    deviance: float  # −2 ln L up to a constant, with priors and the penalty of the shape
    dispersion: float  # mean squared standardised residual
    frame_count: int  # number F of frames
    shape: ShapePart | None = None  # result of the elimination of the shape; None without a free shape

    @property
    def size(self) -> int:
        """Number n of unknowns."""
        return len(self.gradient)

    def has_factor_of(self, other: NormalEquations) -> bool:
        """Return whether these equations use the same factor of the shape's information as others."""
        return self.shape is not None and other.shape is not None and self.shape.factor is other.shape.factor

    def solve(self, damping: float, fixed: np.ndarray) -> np.ndarray:
        """Return the step [n] of Fisher scoring.

        `damping` times the diagonal of the information is added to it. Unknowns that are `fixed` [n] do not move.
        """
        matrix = self.information + damping * np.diag(self.diagonal)
        step = np.zeros(self.size)
        step[~fixed] = solve_positive(matrix[np.ix_(~fixed, ~fixed)], self.gradient[~fixed])
        return step

    def promise(self, step: np.ndarray) -> float:
        """Return the drop of −2 ln L that a step [n] promises by the quadratic approximation.

        It includes that of the shape, whose coefficients then take the step of `shape_step`.
        """
        shape_drop = 0.0 if self.shape is None else float(self.shape.score @ self.shape.score)
        return float(2 * step @ self.gradient - step @ self.information @ step) + shape_drop

    def shape_step(self, step: np.ndarray) -> np.ndarray:
        """Return the best step of the shape's coefficients [coefficient] for a step of the other unknowns [n]."""
        assert self.shape is not None
        return self.shape.factor.back_solve((self.shape.score - self.shape.multiply_cross(step))[:, None])[:, 0]

    def decrements(self, step: np.ndarray, fixed: np.ndarray) -> tuple[float, float]:
        """Return the Newton decrements [−2 ln L] of all unknowns, and of the fitted parameters beside the spots.

        `step` [n] is a step without damping. Unknowns that are `fixed` [n] do not count.
        """
        first = SPOT_PARAMETERS * self.frame_count
        free = np.flatnonzero(~fixed[first:]) + first
        total = self.promise(step)
        if free.size == 0:
            return total, 0.0
        return total, float(step[free] @ information_beside(self.information, free, np.arange(first)) @ step[free])


def solve_positive(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution of a symmetric system that is positive definite up to rounding.

    The matrix is scaled to a unit diagonal first, since units differ by many orders of magnitude. If it cannot be
    factored, the least-squares solution is returned. `right` is [n] or [n, k].
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * scale[:, None] * scale
    rhs = (right.T * scale).T
    try:
        factor = linalg.cho_factor(scaled + RIDGE * np.eye(len(scaled)), check_finite=False)
        solution = linalg.cho_solve(factor, rhs, check_finite=False)
    except linalg.LinAlgError:
        solution = np.linalg.lstsq(scaled, rhs, rcond=NULL_SINGULAR)[0]
    return (solution.T * scale).T


def information_beside(information: np.ndarray, targets: np.ndarray, others: np.ndarray | None = None) -> np.ndarray:
    """Return the information on targets [target, target] if others are fitted as well: the Schur complement.

    `targets` and `others` are positions in the information matrix [n, n]; None stands for all but the targets.
    """
    others = np.setdiff1d(np.arange(len(information)), targets) if others is None else others
    cross = information[np.ix_(others, targets)]
    absorbed = cross.T @ solve_positive(information[np.ix_(others, others)], cross)
    return information[np.ix_(targets, targets)] - absorbed


def invert_information(information: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse of an information matrix: directions without information have a variance of 0.

    The matrix is scaled to a unit diagonal first, since units differ by many orders of magnitude.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information * scale[:, None] * scale
    return np.linalg.pinv(scaled, rcond=NULL_EIGENVALUE, hermitian=True) * scale[:, None] * scale


def assemble(model: JointModel, pixels: Pixels, reuse: ShapePart | None = None) -> NormalEquations:
    """Return the normal equations of a model at the pixels of all its frames.

    `reuse` is the elimination of the shape at an earlier step: its factor and its cross terms with the spots are used
    again. The score is exact all the same. None: a new factor is computed.
    """
    frames = len(model.spots.x)
    size = SPOT_PARAMETERS * frames + len(model.free)
    has_new_factor = model.grid is not None and reuse is None
    coefficients = np.zeros(0) if model.grid is None else model.coefficients
    spots_cross = np.zeros((coefficients.size, SPOT_PARAMETERS * frames) if has_new_factor else (0, 0))

    def sum_batch(batch: slice) -> tuple[Any, ...]:
        """Return the sums over the pixels of some frames; fill their columns of `spots_cross`."""
        evaluation = evaluate(model, pixels, batch)
        columns = differentiate_readings(model, evaluation)
        information, gradient = sum_equations(evaluation, columns, batch.start, size)
        squares = float(np.sum(evaluation.residual**2 * evaluation.weight))
        deviance = squares + float(np.sum(evaluation.log_variance))
        if model.grid is None:
            return information, gradient, deviance, squares
        sums = ShapeSums(model, evaluation)
        equivalents = np.array([evaluation.light_equivalent(column) for column in columns]).reshape(
            -1, *evaluation.weight.shape
        )
        # Score of the coefficients, and their information with each fitted parameter [coefficient, 1 + k].
        products = np.column_stack([sums.score(), sums.products(equivalents)])
        if not has_new_factor:
            return information, gradient, deviance, squares, products
        spots_cross[:, SPOT_PARAMETERS * batch.start : SPOT_PARAMETERS * batch.stop] = sums.products_of_spots()
        return information, gradient, deviance, squares, products, sums.band()

    information, gradient, deviance, squares, *shape_sums = sum_batches(sum_batch, pixels)
    dispersion = squares / max(pixels.count, 1)
    deviance += _add_priors(model, information, gradient, pixels.share)
    if model.grid is None:
        return NormalEquations(information, gradient, np.diag(information), deviance, dispersion, frames)
    grid = model.grid
    penalty = pixels.share * grid.penalize(coefficients)
    products = shape_sums[0]
    if reuse is None:
        band = shape_sums[1]
        # A block near its least light whose score points below is moved there and stays.
        is_near = model.mean_light() < NEAR_BOUND * model.least_light
        is_at_bound = is_near & (grid.average_blocks(products[:, 0] - penalty) < 0)
        grid.add_to_sums(band, AT_BOUND * band.max() * is_at_bound)
        factor = BlockFactor(grid, band, pixels.share)
        spots_cross = factor.half_solve(spots_cross)
        reuse = ShapePart(factor, spots_cross, spots_cross.T @ spots_cross, np.zeros((0, 0)), np.zeros(0), is_at_bound)
    products[:, 0] -= penalty
    # L⁻¹ times the score of the coefficients (first column) and their information with the fitted parameters.
    half_solutions = reuse.factor.half_solve(products)
    shape = replace(reuse, others_cross=half_solutions[:, 1:], score=half_solutions[:, 0])
    spots_others = shape.spots_cross.T @ shape.others_cross
    schur = np.block([[shape.spots_schur, spots_others], [spots_others.T, shape.others_cross.T @ shape.others_cross]])
    beside_shape = information - schur + gauge_information(model, information)
    gradient = gradient - shape.multiply_transposed(shape.score)
    deviance += float(coefficients @ penalty)
    return NormalEquations(beside_shape, gradient, np.diag(information), deviance, dispersion, frames, shape)


def _add_priors(model: JointModel, information: np.ndarray, gradient: np.ndarray, share: float) -> float:
    """Add the priors of the data sheet to information [n, n] and gradient [n] in place.

    Returns what they add to −2 ln L. A subset of the pixels takes its `share` of a prior, so that its fit ends where
    that of all pixels does.
    """
    added, first = 0.0, len(gradient) - len(model.free)
    for k, parameter in enumerate(model.free, first):
        deviation = parameter.prior_deviation(model.value_of(parameter))
        added += share * deviation**2
        gradient[k] -= share * deviation / parameter.stated_stderr
        information[k, k] += share * (1 / parameter.stated_stderr**2)
    return added


def gauge_information(model: JointModel, information: np.ndarray) -> np.ndarray:
    """Return information [n, n] that keeps the mean step over frames of each spot parameter at 0.

    Without it shape and spots could drift together, since a wider shape of narrower spots is the same light. Centres
    count in units of their σ.
    """
    spots = SPOT_PARAMETERS * len(model.spots.x)
    sigma = np.exp(model.spots.log_sigma)
    gauge = np.zeros_like(information)
    for k in range(SPOT_PARAMETERS):
        direction = np.zeros(len(information))
        direction[k:spots:SPOT_PARAMETERS] = 1.0 if k < CENTRE_X else sigma / sigma.mean()
        weight = GAUGE_WEIGHT * np.median(np.diag(information)[k:spots:SPOT_PARAMETERS]) / len(sigma)
        gauge += weight * np.outer(direction, direction)
    return gauge


def sum_equations(
    evaluation: Evaluation, columns: Sequence[Column], first: int, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return information [n, n] and gradient [n] by the pixels of some frames, with the shape fixed.

    Parameters
    ----------
    evaluation : Evaluation
        Model at the pixels of the frames.
    columns : sequence of Column
        Column of each fitted parameter of sensor and effects.
    first : int
        Index of the first of these frames.
    size : int
        Number n of unknowns.
    """
    information, gradient, offset = np.zeros((size, size)), np.zeros(size), size - len(columns)
    count = evaluation.slopes.shape[1]
    # Derivatives of the light by the spot parameters [spot parameter, frame, pixel].
    slopes = evaluation.slopes.reshape(SPOT_PARAMETERS, count, -1)
    weighted = slopes * evaluation.light_information.reshape(1, count, -1)
    spots = slice(SPOT_PARAMETERS * first, SPOT_PARAMETERS * (first + count))
    blocks = np.einsum("afp,bfp->fab", weighted, slopes, optimize=True)
    information[spots, spots] = linalg.block_diag(*blocks)
    gradient[spots] = np.einsum("afp,fp->fa", slopes, evaluation.light_score.reshape(count, -1)).ravel()
    for k, column in enumerate(columns, offset):
        gradient[k] = evaluation.score(column)
        equivalent = evaluation.light_equivalent(column).reshape(count, -1)
        information[spots, k] = np.concatenate([slopes[:, f] @ equivalent[f] for f in range(count)])
        information[k, spots] = information[spots, k]
        for j, other in enumerate(columns[: k - offset + 1], offset):
            information[k, j] = information[j, k] = evaluation.information_of(column, other)
    return information, gradient
