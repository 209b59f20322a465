"""What a learned shape takes up of the noise: residuals scatter less than readings do, most where few frames tell the
shape.

Readings of variance V, projected on the shape by H, leave residuals of variance V (1 − h), h the diagonal of H: the
variance of the fitted reading over that of the reading. Draws of the coefficients tell it.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg

from spotcheck.old_engine.model.light_shape import LightShape
from spotcheck.old_engine.nuisance.fit import Fitted
from spotcheck.old_engine.nuisance.normal import Schur
from spotcheck.old_engine.observe.pixels import Expected, Told

# Draws by which the shape's variance is told: to a third at a place, which sums over thousands of places make good.
DRAWS = 16
# Points in a cell along each axis at which it is told, and cells beyond the last node: so far a spline reaches.
BETWEEN, BEYOND = 2, 2


def draws_of(schur: Schur, side: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Coefficients [draw, light, row, column] ~ N(0, S⁻¹), S the shapes' information with its penalty."""
    turned = transposed(schur.factor)
    drawn = linalg.solve_banded((0, len(turned) - 1), turned, rng.standard_normal((turned.shape[1], count)))
    return drawn.T.reshape(count, -1, side, side)


def transposed(factor: np.ndarray) -> np.ndarray:
    """A lower banded matrix [diagonal, column] transposed, as an upper banded one."""
    out = np.zeros_like(factor)
    last = len(factor) - 1
    for gap in range(last + 1):
        out[last - gap, gap:] = factor[gap, : factor.shape[1] - gap]
    return out


class OverCells(NamedTuple):
    """A variance over the spot: means over square cells about the nodes [row, column], of a side of `step` [σ]."""

    step: float
    means: np.ndarray

    def __call__(self, u, v) -> np.ndarray:
        """At u, v [σ] of shapes that broadcast; 0 beyond all cells."""
        side = len(self.means)
        row, column = (np.floor(np.asarray(own) / self.step + side / 2).astype(int) for own in (v, u))
        inside = (row >= 0) & (row < side) & (column >= 0) & (column < side)
        return np.where(inside, self.means[np.clip(row, 0, side - 1), np.clip(column, 0, side - 1)], 0.0)


def variances_of(fitted: Fitted) -> list[OverCells | None]:
    """Of every frame the variance of its learned shape [squared peaks] over the spot, the same at each call; None where
    none is learned."""
    lights = fitted.model.lights
    if lights is None:
        return [None] * len(fitted.model.numbers.x)
    drawn = draws_of(fitted.schur, lights.side, DRAWS, np.random.default_rng(0))
    cells = lights.side + 2 * BEYOND
    at = lights.step * ((np.arange(BETWEEN * cells) + 0.5) / BETWEEN - cells / 2)
    each: list[OverCells | None] = []
    for light in np.moveaxis(drawn, 1, 0):
        shapes = (LightShape(lights.step, own)(at[None, None], at[None, :, None])[0] for own in light)
        square = np.mean([shape**2 for shape in shapes], axis=0)
        each.append(OverCells(lights.step, square.reshape(cells, BETWEEN, cells, BETWEEN).mean(axis=(1, 3))))
    return [each[light] for light in lights.which]


def leverage(variance: OverCells | None, peak: float, seen: Expected, tells: Told) -> np.ndarray:
    """h [row, column] of a frame: the part of its noise that the shape takes."""
    if variance is None:
        return np.zeros_like(tells.sure)
    # Where a cell of the surface lies half beyond the pixels, its mean is not that of the pixels: h is 1 at most.
    return np.minimum(variance(seen.u, seen.v) * (peak * seen.factor * tells.slope) ** 2 * tells.sure, 1.0)


def lacking(variance: OverCells | None, peak: float, seen: Expected, tells: Told) -> np.ndarray:
    """½ h / V [row, column] of a frame, which the score of its variance lacks: likelihood takes what the shape took for
    less noise, restricted likelihood (REML, Patterson & Thompson 1971) gives it back."""
    return leverage(variance, peak, seen, tells) * tells.sure / 2
