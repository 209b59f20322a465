"""What the frames' centres say of a scatter from frame to frame, beside the place of each site.

Of each frame the centre, of each site one place, of each exposure one shift: a learned shape that is not quite the
light's own moves the centre with the spot's width. What these leave is noise of known covariance and, along each axis,
one variance, by restricted maximum likelihood.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg, optimize

from spotcheck.discrepancy.evidence.components import root_of
from spotcheck.discrepancy.evidence.design import Design, missing
from spotcheck.discrepancy.evidence.influence import FrameNumbers
from spotcheck.model.effect import Effect
from spotcheck.model.effects import vocabulary

# Part of the frames that the test leaves out, those furthest off: a few bad frames are no scatter of all.
WORST = 0.1
# What is left of a normal law's variance in a plane without its outer tenth, 1 + p ln p / (1 − p) with p = `WORST`.
KEPT = 1 + WORST * np.log(WORST) / (1 - WORST)
# Singular values of the sites' and exposures' places below this, of the largest, are none.
NONE = 1e-9
# Fewer degrees of freedom than this tell no variance.
FEWEST = 4


class Scatter(NamedTuple):
    """A scatter of the centre along each axis: `value` and `error` [px], and of the test that leaves the worst frames
    out, z (0 or more) and the gain in −2 ln L against none (by chance half of χ²₁ and half 0)."""

    effect: Effect
    value: float
    error: float
    z: float
    gain: float


def centres_of(numbers: FrameNumbers, design: Design) -> tuple[Scatter, ...]:
    """The scatter of the centres, for each effect that is one and that the design can show."""
    effects = [e for e in vocabulary().values() if e.component == "centre" and not missing(e, design, law=True)]
    every = np.arange(len(design.site))
    fitted = scatter_of(numbers, design, every) if effects else None
    if fitted is None:
        return ()
    value, error = root_of(fitted.variance, fitted.error)
    tested = scatter_of(numbers, design, kept_of(numbers, design, fitted.variance), KEPT)
    gain = tested.gain if tested is not None else 0.0
    return tuple(Scatter(effect, value, error, float(np.sqrt(gain)), gain) for effect in effects)


class Variance(NamedTuple):
    """A variance [px²], its standard error, and the gain in −2 ln L against 0."""

    variance: float
    error: float
    gain: float


def scatter_of(numbers: FrameNumbers, design: Design, frames: np.ndarray, part: float = 1.0) -> Variance | None:
    """The scatter of some frames' centres; None where sites and exposures take all. `part` multiplies noise and
    scatter alike."""
    apart = _apart(design, frames)
    if 2 * apart.shape[1] < FEWEST:
        return None
    known, values = _centres(numbers, frames)
    lift = np.kron(apart, np.eye(2))
    noise, turn = np.linalg.eigh(part * (lift.T @ known @ lift))
    square = (turn.T @ (lift.T @ values)) ** 2

    def deviance(variance: float) -> float:
        total = noise + part * variance
        return float(np.sum(np.log(total) + square / total))

    highest = float(square.max()) / part
    # Between 0 and the largest square, on a grid first: the likelihood may have more than one top.
    grid = np.concatenate([[0.0], highest * np.geomspace(1e-8, 1.0, 60)])
    best = int(np.argmin([deviance(own) for own in grid]))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    found = optimize.minimize_scalar(deviance, bounds=(low, high), method="bounded", options={"xatol": 1e-6 * high})
    variance = float(found.x) if found.fun < deviance(0.0) else 0.0
    error = np.sqrt(2 / np.sum((part / (noise + part * variance)) ** 2))
    return Variance(variance, float(error), max(deviance(0.0) - deviance(variance), 0.0))


def kept_of(numbers: FrameNumbers, design: Design, variance: float) -> np.ndarray:
    """The frames but for the worst, whose centres lie furthest off in the errors of what sites and exposures leave."""
    every = np.arange(len(design.site))
    apart = _apart(design, every)
    lift = np.kron(apart @ apart.T, np.eye(2))
    known, values = _centres(numbers, every)
    off = (lift @ values).reshape(-1, 2)
    errors = (lift @ (known + variance * np.eye(len(known))) @ lift).reshape(len(every), 2, len(every), 2)
    # A frame alone at its site is off by nothing, with an error of nothing.
    far = [own @ np.linalg.pinv(errors[k, :, k], rcond=NONE, hermitian=True) @ own for k, own in enumerate(off)]
    return np.sort(np.argsort(far, kind="stable")[: len(every) - int(WORST * len(every))])


def _apart(design: Design, frames: np.ndarray) -> np.ndarray:
    """Orthonormal steps [frame, step] between frames that no place of a site and no shift of an exposure brings."""
    site, exposure = design.site[frames], design.exposure_s[frames]
    places = [own[:, None] == np.unique(own) for own in (site, exposure)]
    return linalg.null_space(np.concatenate(places, 1).T.astype(float), rcond=NONE)


def _centres(numbers: FrameNumbers, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariance and values [frame × axis] of some frames' centres [px]."""
    own = (4 * frames[:, None] + np.array([2, 3])).ravel()
    return numbers.covariance[np.ix_(own, own)], numbers.values[2:, frames].T.ravel()
