"""What the shape takes up of the noise: residuals scatter less than readings do, most where few frames tell the shape.

Readings of variance V, projected on the shape by H, leave residuals of variance V (1 − h), h the diagonal of H. The
likelihood takes that for less noise; restricted likelihood (REML, Patterson & Thompson 1971) gives it back: a change w
of the variance gains the score ½ Σ w h / V.
"""

from collections.abc import Sequence

import numpy as np
from scipy import linalg

from spotcheck.discrepancy.nuisance import normal
from spotcheck.discrepancy.nuisance.fit import Fitted
from spotcheck.discrepancy.observe.pixels import Expectation, Frame, told
from spotcheck.model.light_shape import LightShape

# Draws by which h is told: the trace of H scatters by √(2 tr H) in one.
DRAWS = 2


def taken_up(frames: Sequence[Frame], fitted: Fitted) -> list[np.ndarray]:
    """½ h / V of each pixel [frame][pixel], which the score of a variance lacks: by random signs (Hutchinson 1989), so
    that sums over many pixels are right; the same at each call."""
    model, learned = fitted.model, fitted.model.baseline.learned
    assert learned is not None
    side = len(learned.coefficients)
    ready = Expectation(frames, model)
    rng = np.random.default_rng(0)
    places, shares = [], []
    drawn = np.zeros((side * side, DRAWS))
    for k, frame in enumerate(frames):
        seen = ready.of(frame, k)
        tells = told(frame, seen)
        u, v = (np.ascontiguousarray(part).ravel() for part in (seen.u, seen.v))
        share = np.exp(model.numbers.log_peak[k]) * tells.slope * np.sqrt(tells.sure)
        signs = share * rng.choice((-1.0, 1.0), (DRAWS, share.size))
        normal.project(u, v, learned.step, side, signs, drawn)
        places.append((seen.u, seen.v))
        shares.append((signs, tells.sure))
    back = linalg.cho_solve_banded((fitted.schur.factor, True), drawn)
    surfaces = [LightShape(learned.step, own.reshape(side, side)) for own in back.T]
    return [
        sum(sign * surface(*place).ravel() for sign, surface in zip(signs, surfaces, strict=True)) * sure / (2 * DRAWS)
        for place, (signs, sure) in zip(places, shares, strict=True)
    ]
