"""The two axes of a beam, which keep their direction through a scan, and its widths along them (ISO 11146-1).

A fit calls the longer axis of a spot the major one. Through the waists of an astigmatic beam the longer axis becomes
the shorter one, so that neither major nor minor is an axis of the beam. Each frame's covariance matrix Σ is therefore
projected onto the same two directions c: σ² = cᵀ Σ c.
"""

from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

# A beam whose axes have this ratio or more in every frame counts as round (ISO 11146-1, clause 3: stigmatic).
ROUND_RATIO = 0.87
# How far [deg] the axes of a frame may lie from those of the scan, beside three of their standard errors: at 10° a
# width differs from that of the axis by 3 % of what the two axes differ by. Beyond, the axes turn.
TURN_DEG = 10.0
# The scan has axes when its ellipses differ from round ones by more than noise makes of those once in so many scans.
CHANCE = 1e-3


class Widths(NamedTuple):
    """Fitted spots of a scan [spot]: widths along the longer and the shorter axis [px], direction of the longer one
    from +x towards +y [deg], and their standard errors; that of a direction is infinite where the spot is round."""

    major: np.ndarray
    minor: np.ndarray
    orientation: np.ndarray
    major_stderr: np.ndarray
    minor_stderr: np.ndarray
    orientation_stderr: np.ndarray


class Axes(NamedTuple):
    """Axes of a beam: direction of that nearer to +x, from +x towards +y, within ± 45° [deg], with its standard error,
    infinite where the beam is round; whether the beam counts as round; and the frame [number] whose axes lie farthest
    beyond what is allowed, with that angle [deg], where they turn."""

    azimuth: float
    azimuth_stderr: float
    stigmatic: bool
    turned: tuple[int, float] | None


def axes_of(spots: Widths) -> Axes:
    """One pair of axes for all spots, each weighted by how well it tells them.

    Of a spot, q = (σ²major − σ²minor)/(σ²major + σ²minor) and its direction ϑ make the number q exp(2iϑ). Those of
    fixed axes lie on one line through 0, on either side of it as the longer axis changes; the line is the principal
    axis of their weighted squares. Where they lie farther from it than their errors allow, by a grain of the light
    say, a scatter of q, one for all spots, is added to them until χ² is 1 per degree of freedom.
    """
    total = spots.major**2 + spots.minor**2
    q, angle = (spots.major**2 - spots.minor**2) / total, np.radians(spots.orientation)
    error = 2 * _cross_stderr(spots) / total

    def line(scatter: float) -> tuple[float, np.ndarray, float]:
        """Direction [rad] of the axes, weights, and χ² across the line for a scatter of q."""
        weight = 1 / (error**2 + scatter**2)
        azimuth = float(np.angle(np.sum(weight * q**2 * np.exp(4j * angle)))) / 4
        return azimuth, weight, float(np.sum(weight * (q * np.sin(2 * (angle - azimuth))) ** 2))

    azimuth, weight, chi2 = line(0.0)
    degrees = max(len(q) - 1, 1)
    if chi2 > degrees:
        scatter = optimize.brentq(lambda own: line(own)[2] - degrees, 0.0, 2.0)
        azimuth, weight, _ = line(scatter)
    along = q * np.cos(2 * (angle - azimuth))
    ratio_error = np.hypot(spots.minor_stderr / spots.minor, spots.major_stderr / spots.major)
    uneven = spots.minor / spots.major * (1 + 3 * ratio_error) < ROUND_RATIO
    if not uneven.any() and np.sum(weight * q**2) < stats.chi2.isf(CHANCE, 2 * len(q)):
        return Axes(0.0, np.inf, True, None)
    stderr = np.degrees(0.5 / np.sqrt(np.sum(weight * along**2)))
    # Directions of axes are alike every 90°.
    off = np.abs((spots.orientation - np.degrees(azimuth) + 45) % 90 - 45)
    beyond = np.where(uneven & np.isfinite(spots.orientation_stderr), off - 3 * spots.orientation_stderr, 0.0)
    worst = int(np.argmax(beyond))
    turned = (worst, float(off[worst])) if beyond[worst] > TURN_DEG else None
    return Axes(float(np.degrees(azimuth)), float(stderr), not uneven.any(), turned)


def along(spots: Widths, azimuth_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Width [px] of each spot along a direction, and its standard error: σ² = cᵀ Σ c. The errors of the widths and of
    the direction count as independent, which they are but for the grid of pixels."""
    angle = np.radians(spots.orientation - azimuth_deg)
    cos2, sin2 = np.cos(angle) ** 2, np.sin(angle) ** 2
    square = spots.major**2 * cos2 + spots.minor**2 * sin2
    variance = (2 * spots.major * spots.major_stderr * cos2) ** 2 + (2 * spots.minor * spots.minor_stderr * sin2) ** 2
    variance += (_cross_stderr(spots) * np.sin(2 * angle)) ** 2
    return np.sqrt(square), np.sqrt(variance) / (2 * np.sqrt(square))


def _cross_stderr(spots: Widths) -> np.ndarray:
    """Standard error [px²] of the element of Σ between the axes of each spot: of a round spot, whose direction is
    unknown, half the error of σ²major − σ²minor, as its Σ has no direction either."""
    round_ = np.hypot(spots.major * spots.major_stderr, spots.minor * spots.minor_stderr)
    known = np.isfinite(spots.orientation_stderr)
    turn = np.radians(np.where(known, spots.orientation_stderr, 0.0))
    return np.where(known, (spots.major**2 - spots.minor**2) * turn, round_)
