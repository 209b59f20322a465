"""The two axes of a beam, which keep their direction through a scan, and its widths along them (ISO 11146-1).

A scan is a series of frames at several distances along the beam, with one spot each. A fit calls the longer axis of a
spot the major one. Through the waists of an astigmatic beam the longer axis becomes the shorter one, so that neither
major nor minor is an axis of the beam. The covariance matrix Σ of each spot [px²] is therefore projected onto the same
two directions, given by unit vectors c: σ² = cᵀ Σ c.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

# A beam whose ratio of minor to major width is this or more in every frame counts as round (ISO 11146-1, clause 3:
# stigmatic). A spot counts as elliptical if its ratio is smaller by `RATIO_SIGMAS` standard errors.
ROUND_RATIO, RATIO_SIGMAS = 0.87, 3.0
# Largest angle [deg] between the axes of a frame and those of the scan, in addition to `ANGLE_SIGMAS` standard errors.
# At 10° the width of a frame differs from the width along the axis by 3 % of the difference between both axes.
ROTATION_LIMIT_DEG, ANGLE_SIGMAS = 10.0, 3.0
# Noise alone gives a scan of a round beam significant axes with this probability.
FALSE_ALARM = 1e-3
# Largest scatter of the ellipticity that is tried [1]: an ellipticity is between 0 and 1, so it never scatters by more.
LARGEST_SCATTER = 2.0


@dataclass(frozen=True, eq=False)
class SpotWidths:
    """Fitted widths and directions of the spots of a scan, each an array over the spots."""

    major: np.ndarray  # standard deviation along the longer axis [px]
    minor: np.ndarray  # standard deviation along the shorter axis [px]
    orientation: np.ndarray  # direction of the longer axis from +x towards +y [deg]
    major_stderr: np.ndarray  # standard error of `major` [px]
    minor_stderr: np.ndarray  # standard error of `minor` [px]
    orientation_stderr: np.ndarray  # standard error of `orientation` [deg]; infinite for a round spot


class BeamAxes(NamedTuple):
    """Axes of a beam through a scan."""

    azimuth: float  # direction of the axis nearer to +x, from +x towards +y, within ± 45° [deg]
    azimuth_stderr: float  # its standard error [deg]; infinite for a round beam
    is_stigmatic: bool  # whether every spot is round to `ROUND_RATIO`
    rotated_spot: tuple[int, float] | None  # index and angle [deg] of the most rotated spot; None if the axes are fixed


def fit_beam_axes(widths: SpotWidths) -> BeamAxes:
    """Return the pair of axes that fits all spots of a scan, each weighted by its precision.

    The ellipticity q = (σ²major − σ²minor)/(σ²major + σ²minor) and the direction ϑ of a spot form the complex number
    q exp(2iϑ). With fixed axes these numbers lie on a line through 0, and change sides when the longer axis changes.
    The line is the principal axis of their weighted squares. Speckle can scatter them about the line by more than their
    errors. One scatter is then added to the errors of all q, in quadrature, so that χ² is 1 per degree of freedom.

    Parameters
    ----------
    widths : widths of the usable spots, without NaN.
    """
    total = widths.major**2 + widths.minor**2
    q, angle = (widths.major**2 - widths.minor**2) / total, np.radians(widths.orientation)
    # Across the line, q sin 2(ϑ − azimuth) is 2/total times the off-diagonal element of Σ along the axes of the beam.
    q_stderr = 2 * _cross_stderr(widths) / total

    def fit_line(scatter: float) -> tuple[float, np.ndarray, float]:
        """Return the direction of the axes [rad], weights [spot], and χ² across the line for a scatter of q."""
        weight = 1 / (q_stderr**2 + scatter**2)
        azimuth = float(np.angle(np.sum(weight * q**2 * np.exp(4j * angle)))) / 4
        return azimuth, weight, float(np.sum(weight * (q * np.sin(2 * (angle - azimuth))) ** 2))

    azimuth, weight, chi2 = fit_line(0.0)
    degrees_of_freedom = max(len(q) - 1, 1)
    if chi2 > degrees_of_freedom:
        scatter = optimize.brentq(lambda scatter: fit_line(scatter)[2] - degrees_of_freedom, 0.0, LARGEST_SCATTER)
        azimuth, weight, _ = fit_line(scatter)

    ratio_error = np.hypot(widths.minor_stderr / widths.minor, widths.major_stderr / widths.major)
    is_elliptical = widths.minor / widths.major * (1 + RATIO_SIGMAS * ratio_error) < ROUND_RATIO
    # The axes are undefined if no spot is elliptical and all q together, two components each, are within the noise.
    if not is_elliptical.any() and np.sum(weight * q**2) < stats.chi2.isf(FALSE_ALARM, 2 * len(q)):
        return BeamAxes(0.0, np.inf, True, None)
    q_along = q * np.cos(2 * (angle - azimuth))
    stderr = np.degrees(0.5 / np.sqrt(np.sum(weight * q_along**2)))

    # A pair of axes is the same after a turn by 90°.
    deviation = np.abs((widths.orientation - np.degrees(azimuth) + 45) % 90 - 45)
    has_direction = is_elliptical & np.isfinite(widths.orientation_stderr)
    excess = np.where(has_direction, deviation - ANGLE_SIGMAS * widths.orientation_stderr, 0.0)
    spot = int(np.argmax(excess))
    rotated_spot = (spot, float(deviation[spot])) if excess[spot] > ROTATION_LIMIT_DEG else None
    return BeamAxes(float(np.degrees(azimuth)), float(stderr), not is_elliptical.any(), rotated_spot)


def project_widths(widths: SpotWidths, azimuth_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the width σ of each spot along one direction and its standard error, both [spot] in px: σ² = cᵀ Σ c.

    The direction is `azimuth_deg` from +x towards +y. A spot with a NaN width gives NaN. The errors of both widths and
    of the orientation are taken as uncorrelated, which holds for a Gaussian that the pixels sample finely.
    """
    angle = np.radians(widths.orientation - azimuth_deg)
    cos_squared, sin_squared = np.cos(angle) ** 2, np.sin(angle) ** 2
    projected_variance = widths.major**2 * cos_squared + widths.minor**2 * sin_squared
    # Squared standard error of the projected variance [px⁴].
    squared_error = (2 * widths.major * widths.major_stderr * cos_squared) ** 2
    squared_error += (2 * widths.minor * widths.minor_stderr * sin_squared) ** 2
    squared_error += (_cross_stderr(widths) * np.sin(2 * angle)) ** 2
    return np.sqrt(projected_variance), np.sqrt(squared_error) / (2 * np.sqrt(projected_variance))


def _cross_stderr(widths: SpotWidths) -> np.ndarray:
    """Return the standard error [spot, px²] of the off-diagonal element of each Σ in coordinates along its axes.

    The orientation of a round spot has no finite error. Its off-diagonal element is as uncertain as half of
    σ²major − σ²minor, since all directions are alike.
    """
    round_spot_stderr = np.hypot(widths.major * widths.major_stderr, widths.minor * widths.minor_stderr)
    has_direction = np.isfinite(widths.orientation_stderr)
    angle_stderr = np.radians(np.where(has_direction, widths.orientation_stderr, 0.0))
    return np.where(has_direction, (widths.major**2 - widths.minor**2) * angle_stderr, round_spot_stderr)
