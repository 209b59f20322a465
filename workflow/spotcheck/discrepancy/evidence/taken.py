"""How much of the readings' noise a learned shape takes, by draws of its coefficients.

With H the fit's projection of standardised readings, noise is left with the covariance (1 − H)². In terms of the
shape's coefficients, S = G + λP, a sum aᵀz loses aᵀ(2H − H²)a = Var aᵀBx + Var aᵀBx', with x ~ N(0, S⁻¹) and
x' ~ N(0, S⁻¹λPS⁻¹).
"""

from collections.abc import Sequence

import numpy as np
from scipy import linalg

from spotcheck.discrepancy.evidence.cells import Standard
from spotcheck.discrepancy.nuisance.fit import Fitted
from spotcheck.discrepancy.nuisance.taken import draws_of
from spotcheck.model.light_shape import LightShape


def shapes_of(fitted: Fitted, count: int, rng: np.random.Generator) -> list[LightShape]:
    """Shapes x + x' whose variance at any place is what the shape takes of noise there; none of a declared one."""
    learned = fitted.model.baseline.learned
    if learned is None:
        return []
    side = len(learned.coefficients)
    second = np.diff(np.eye(side), 2, axis=0)
    out = []
    for drawn in draws_of(fitted.schur, side, count, rng):
        # P is the sum of squared second differences along both axes.
        bent = second.T @ rng.standard_normal((side - 2, side)) + rng.standard_normal((side, side - 2)) @ second
        smooth = linalg.cho_solve_banded((fitted.schur.factor, True), np.sqrt(fitted.penalty) * bent.ravel())
        out.append(LightShape(learned.step, drawn + smooth.reshape(side, side)))
    return out


def drawn_readings(seen: Standard, peak: float, shapes: Sequence[LightShape]) -> np.ndarray:
    """Changes of z [draw, pixel] that those shapes make, over the root of their number: columns whose squares add up to
    the variance taken."""
    unit = seen.offset * peak / np.sqrt(len(shapes))
    return np.stack([unit * shape(seen.u, seen.v) for shape in shapes])
