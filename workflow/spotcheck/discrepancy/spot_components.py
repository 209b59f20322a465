"""Linear mean and variance components of brightness and width over F frames.

Observations are ln peak of all frames, then ln σ_g of all frames [2F]. The saturated mean contains every law across
frames. A variance component is scatter from frame to frame or from site to site; the frames of a site share the angle
of the fibres, the declared conditions and the repeat. A `Design` has the conditions of the frames, each [frame]:
`angle` [rad], `exposure_s`, `site`, and `order`, the position in the order of acquisition from 0 to 1.
"""

from collections.abc import Mapping

import numpy as np

from spotcheck.discrepancy.frames import Design

# Degrees of freedom that must be left beside the mean for a variance component to be estimated.
LEAST_FREE = 4
# Powers of the order of acquisition that describe a drift: in the test of a law, and in the saturated mean.
ORDER_POWERS, SLOW_POWERS = 4, 2


def build_factors(design: Design) -> dict[str, np.ndarray]:
    """Return columns [frame, k] from which means of laws are built, by the condition on which they depend.

    "angle" and "exposure" have a column for each distinct value, 1 for its frames and 0 for others. "order" has the
    powers 1 to `ORDER_POWERS` of the position in the order of acquisition, counted from the middle.
    """
    return {
        "angle": _indicators(design.angle),
        "exposure": _indicators(design.exposure_s),
        "order": np.stack([(design.order - 0.5) ** k for k in range(1, ORDER_POWERS + 1)], 1),
    }


def build_saturated_mean(design: Design, factors: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return columns [2F, k] of a mean that contains every law; `factors` by `build_factors`.

    Cells of angle and exposure have a mean each if most are repeated. Otherwise the means of both factors add up.
    """
    keys = np.stack([design.angle, design.exposure_s], 1)
    cell = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    is_repeated = np.median(np.bincount(cell)) >= 2
    mean = _indicators(cell) if is_repeated else np.hstack([factors["angle"], factors["exposure"]])
    drift = np.zeros((len(cell), 0))
    if design.has_order and len(cell) - np.linalg.matrix_rank(mean) > LEAST_FREE:
        drift = factors["order"][:, :SLOW_POWERS]
    zero = np.zeros_like(mean)
    # Laws of the order, such as a drift of the laser, change the brightness alone.
    return np.block([[mean, zero, drift], [zero, mean, np.zeros_like(drift)]])


def build_components(design: Design, noise: np.ndarray) -> dict[str, np.ndarray]:
    """Return the covariance [2F, 2F] of each variance component at a variance of 1, by its name.

    `noise` [2F, 2F] is the covariance of the observations by the fit of the spots. Components of sites are left out if
    no site has two frames.
    """
    frames = len(design.site)
    site = _indicators(design.site)
    same_site, identity, zero = site @ site.T, np.eye(frames), np.zeros((frames, frames))
    components = {
        "frame brightness": np.block([[identity, zero], [zero, zero]]),
        "frame width": np.block([[zero, zero], [zero, identity]]),
    }
    if same_site.sum() > frames:
        components["site brightness"] = np.block([[same_site, zero], [zero, zero]])
        components["site width"] = np.block([[zero, zero], [zero, same_site]])
    # If errors of the spots are understated, ln peak and ln σ_g of a frame scatter with the correlation of their noise.
    components["frame noise"] = np.block([[identity, identity], [identity, identity]]) * noise
    return components


def _indicators(values: np.ndarray) -> np.ndarray:
    """Return indicators [frame, level] of the distinct values [frame], in ascending order of these."""
    return (values[:, None] == np.unique(values)[None]).astype(float)
