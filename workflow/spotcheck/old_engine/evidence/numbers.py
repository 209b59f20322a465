"""The frames' own numbers against the baseline's law: width and brightness of the exposure, one place for each site."""

from collections.abc import Callable

import numpy as np
from scipy import linalg, optimize

from spotcheck.old_engine.evidence.parts import Standing, standing_of
from spotcheck.old_engine.nuisance.numbers import Numbered

# A frame whose numbers are less well parted than this [condition of their information] tells none of them.
UNTOLD = 1e12


def numbers_of(numbered: Numbered, exposure_s: np.ndarray, site: np.ndarray) -> dict[str, Standing]:
    """What the law leaves of brightness, width and centre of each frame [frame, or frame × axis], beside what it takes.
    Without a law of the light (`free`) each frame has a brightness and a width of its own, and only centres are
    asked."""
    information, own, baseline = numbered.information, numbered.model.numbers, numbered.model.baseline
    known = np.flatnonzero([np.linalg.cond(matrix) < UNTOLD for matrix in information])
    if not known.size:
        return {}
    covariance, exposure = np.linalg.inv(information[known]), exposure_s[known]
    places = np.unique(site[known], return_inverse=True)[1].reshape(-1)
    value = np.stack([own.log_peak, own.log_width, own.x, own.y], 1)[known]

    def centre(theta: np.ndarray) -> np.ndarray:
        return theta.reshape(-1, 2)[places]

    def law(theta: np.ndarray) -> np.ndarray:
        # With one exposure p1 is 0.
        p1, p2, log_peak = (0.0, *theta) if lone else theta
        peak, width = baseline.relative_peak(exposure, p1, p2), baseline.sigma(exposure, p1, p2)
        return np.stack([log_peak + np.log(np.maximum(peak, 1e-300)), np.log(np.maximum(width, 1e-3))], 1)

    start = np.stack([value[places == j, 2:].mean(axis=0) for j in range(places.max() + 1)])
    z, taken = _left(value[:, 2:], covariance[:, 2:, 2:], centre, start.ravel())
    out = {"centre": standing_of(z.T.ravel(), np.concatenate([taken[:, 0], taken[:, 1]]), np.tile(known, 2))}
    if baseline.photon_budget != "free":
        width, lone = np.exp(value[:, 1]) - baseline.laser_px, np.ptp(exposure) == 0
        line = [np.median(width)] if lone else np.polyfit(np.log(exposure), width, 1)
        begun = np.array([*line, 0.0])
        begun[-1] = np.median(value[:, 0] - law(begun)[:, 0])
        z, taken = _left(value[:, :2], covariance[:, :2, :2], law, begun)
        out |= {name: standing_of(z[:, k], taken[:, k], known) for k, name in enumerate(("brightness", "width"))}
    return out


def _left(
    value: np.ndarray, covariance: np.ndarray, law: Callable[[np.ndarray], np.ndarray], start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What a law leaves of numbers [frame, number], in their own errors, and what its parameters take of these [frame,
    number, parameter]: with residuals made white, w, a projection."""
    half = np.linalg.cholesky(covariance)

    def white(theta: np.ndarray) -> np.ndarray:
        return np.linalg.solve(half, (value - law(theta))[..., None]).ravel()

    found = optimize.least_squares(white, start, method="lm", x_scale="jac")
    projection = linalg.orth(found.jac)
    error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    back = half / error[..., None]
    shape = (*value.shape, -1)
    return (back @ found.fun.reshape(shape))[..., 0], back @ projection.reshape(shape)
