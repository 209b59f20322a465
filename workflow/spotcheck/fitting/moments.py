"""Widths of a spot by second moments (ISO 11146-1:2021, ISO 11146-3:2004), with standard errors.

Along a principal axis u the width is D4σ = 4 √⟨u²⟩, where ⟨u²⟩ is the mean of the squared distance from the centroid,
weighted by the light. The moments are summed over the area of integration: a rectangle along the principal axes, three
widths long on each side. It is iterated until it no longer changes. The background, estimated from pixels around the
rectangle, is subtracted first. No shape is assumed, at the price of noise: a background error of 0.1 % of a Gaussian's
peak changes its width by 13 %.

An error dI of one reading I changes ⟨u²⟩ by (u² − ⟨u²⟩) dI / ΣI. The variance of a reading is estimated from
differences of neighbouring pixels: it includes read, shot and rounding noise, and needs no gain. The error of the
background is estimated from its scatter between directions from the spot, which includes stray light as well as noise.

# ASSUME: the background under the spot equals that around the area, and all light within the area is the spot's.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage
from skimage.measure import label

from spotcheck.characterization.noise_curve import compute_differences
from spotcheck.crops.spotfinding import find_light_centroid
from spotcheck.model.spot import PIXEL_VARIANCE

# Sides of the area of integration in widths (ISO 11146-1, clause 7).
AREA = 3.0
# The area is final when its width changes by less than this fraction, after so many iterations at most. The first
# `FULL_STEPS` iterations take a full step. Later ones take half a step, because pixels that enter and leave at the edge
# can make the area oscillate.
TOLERANCE, MAX_ITERATIONS, FULL_STEPS = 5e-4, 20, 8
# The background is estimated in a ring between the area and a rectangle of so many widths on each side. The ring is
# divided into so many sectors by the direction from the spot.
RING, SECTORS = 4.5, 32
# Sectors are used if they have more pixels than this fraction of their mean: those of few pixels have uncertain means.
LEAST_SECTOR = 1 / 4
# If the ring has fewer pixels than this fraction of the area's, the corners of the frame are used instead; their sides
# are this fraction of the frame's.
LEAST_RING, CORNER = 0.1, 0.05
# Variance per axis of the uniform disk where a Gaussian exceeds half of its peak, as a fraction of the Gaussian's.
WITHIN_HALF = np.log(2) / 2
# Smallest side of an image that is analysed [px].
SMALLEST_SIDE = 4
# A width is measured if its relative error is below this.
MAX_RELATIVE_ERROR = 0.5
# Fraction of the area of integration that a frame must contain for the width of the standard.
WHOLE_AREA = 0.9
# Largest part of the light that may fall on pixels that were not measured. Without it D4σ changes by at most 0.5 % if
# these pixels are within 3 σ of the centre.
MAX_LOST_LIGHT = 1e-3
# Largest distance [px] at which a pixel replaces one that was not measured.
FILL_DISTANCE = 2
# The axes differ significantly from each other by so many standard errors.
AXES_SIGMAS = 3.0
# Standard deviation over median absolute deviation, and standard error of a median over that of a mean, of normal
# numbers.
MAD_TO_SIGMA, MEDIAN_ERROR = 1.4826, 1.2533


@dataclass(frozen=True)
class Moments:
    """A spot by its moments; every value is NaN without light, and all but the centroid if there is no width."""

    x: float  # column of the centroid [px]
    y: float  # row of the centroid [px]
    x_stderr: float  # standard error of `x` [px]
    y_stderr: float  # standard error of `y` [px]
    major: float  # D4σ along the longer principal axis [px]
    minor: float  # D4σ along the shorter principal axis [px]
    major_stderr: float  # standard error of `major` [px]
    minor_stderr: float  # standard error of `minor` [px]
    azimuth: float  # direction of the longer axis from +x towards +y [deg]
    azimuth_stderr: float  # standard error of `azimuth` [deg]; infinite if the axes do not differ significantly
    light: float  # sum of readings less background over the area [DN]
    background: float  # reading beside the spot [DN]
    background_stderr: float  # standard error of `background` [DN]
    area_fraction: float  # fraction of the area of integration within the frame
    lost_light: float  # part of the light, by a Gaussian of these moments, that fell on pixels that were not measured
    has_converged: bool  # whether the area of integration stopped changing, within the errors of the widths

    @property
    def is_measured(self) -> bool:
        """Whether the light was measured, and relative errors of both widths are below `MAX_RELATIVE_ERROR`."""
        limit = MAX_RELATIVE_ERROR
        has_small_errors = self.major_stderr < limit * self.major and self.minor_stderr < limit * self.minor
        return bool(has_small_errors and not self.has_lost_light)

    @property
    def has_lost_light(self) -> bool:
        """Whether more light than `MAX_LOST_LIGHT` fell on pixels that were not measured."""
        return bool(self.lost_light > MAX_LOST_LIGHT)

    @property
    def mean_width(self) -> tuple[float, float]:
        """Mean of both widths and its standard error [px]."""
        return (self.major + self.minor) / 2, float(np.hypot(self.major_stderr, self.minor_stderr)) / 2

    @property
    def is_whole(self) -> bool:
        """Whether the frame contains the area that the standard integrates over."""
        return self.area_fraction >= WHOLE_AREA


NO_MOMENTS = Moments(*(np.nan,) * 15, has_converged=False)


class _Ellipse(NamedTuple):
    """Centroid and second moments of the light."""

    x: float  # column [px]
    y: float  # row [px]
    covariance: np.ndarray  # second moments about the centroid [(x, y), (x, y)] in px²


class _Area(NamedTuple):
    """The area of integration, or a larger rectangle like it, in its upright bounding box, the window."""

    top: int  # first row of its window
    left: int  # first column of its window
    mask: np.ndarray  # True for pixels of the area [row, column of the window]

    def crop(self, pixels: np.ndarray) -> np.ndarray:
        """Return the pixels of the window from an image [row, column]."""
        rows, columns = self.mask.shape
        return pixels[self.top : self.top + rows, self.left : self.left + columns]


def second_moments(image: np.ndarray) -> Moments:
    """Return the second-moment widths of the spot on an image [row, column] in DN, with standard errors.

    NaN pixels take the value of the nearest pixel, or of the background beyond `FILL_DISTANCE`. If no pixel around the
    area of integration was measured, the background and all widths are unknown. The errors are of first order in the
    noise: if `is_measured` is False the width is meaningless. Noise that is correlated between pixels, as in compressed
    images, is underestimated.
    """
    pixels, is_unmeasured = _fill_gaps(np.asarray(image, float))
    start = _estimate_start(pixels)
    if start is None:
        return NO_MOMENTS
    ellipse, change = start, np.inf
    for iteration in range(MAX_ITERATIONS):
        area = _place_area(ellipse, pixels.shape)
        background, _ = _estimate_background(pixels, is_unmeasured, ellipse, area)
        update = _compute_moments(np.where(is_unmeasured, background, pixels), area, background)
        if update is None:
            return replace(NO_MOMENTS, x=start.x, y=start.y)
        step = 1.0 if iteration < FULL_STEPS else 0.5
        # A single pixel above all others has no extent.
        extent = max(float(np.trace(ellipse.covariance)), np.finfo(float).tiny)
        # Relative change of the width: half of that of the variance.
        change = float(np.abs(update.covariance - ellipse.covariance).max()) / extent / 2
        changes: zip[tuple[Any, Any]] = zip(ellipse, update, strict=True)
        ellipse = _Ellipse(*(old + step * (new - old) for old, new in changes))
        if change < TOLERANCE:
            break
    return _describe_spot(pixels, is_unmeasured, ellipse, change)


def _fill_gaps(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an image with NaN pixels replaced, and a mask of those that are too far from a measured pixel.

    The mask is True for pixels without a measured one within `FILL_DISTANCE`; they take the median of the image. The
    others take the value of the nearest pixel. An image of NaN alone becomes 0.
    """
    gaps = np.isnan(pixels)
    if not gaps.any() or gaps.all():
        return np.where(gaps, 0.0, pixels), gaps
    distance, nearest = ndimage.distance_transform_edt(gaps, return_indices=True)
    is_unmeasured = distance > FILL_DISTANCE
    return np.where(is_unmeasured, np.nanmedian(pixels), pixels[tuple(nearest)]), is_unmeasured


def _estimate_start(pixels: np.ndarray) -> _Ellipse | None:
    """Return the ellipse of the Gaussian that fills the same region above half of its peak; None without a spot.

    `pixels` is an image [rows, columns] in DN.
    """
    if min(pixels.shape) < SMALLEST_SIDE:
        return None
    spot = find_light_centroid(pixels, min(pixels.shape))
    if not spot.exists:
        return None
    smooth = ndimage.uniform_filter(pixels, 3)
    # The median of every fourth pixel along each axis is accurate enough for a start.
    background = float(np.median(pixels[::4, ::4]))
    neighbours = smooth[max(spot.row - 1, 0) : spot.row + 2, max(spot.column - 1, 0) : spot.column + 2]
    is_bright = smooth - background > (float(neighbours.max()) - background) / 2
    regions = label(is_bright, connectivity=2)
    # 0 if the pixel of the centroid itself is not bright, as in a ring: all bright pixels are then used.
    region = regions[spot.row, spot.column]
    rows, columns = np.nonzero(regions == region if region else is_bright)
    covariance = np.cov(np.stack([columns, rows]), bias=True) if rows.size > 1 else np.zeros((2, 2))
    # A region of one pixel has the variance of a pixel.
    return _Ellipse(float(columns.mean()), float(rows.mean()), (covariance + np.eye(2) * PIXEL_VARIANCE) / WITHIN_HALF)


def _find_principal_axes(covariance: np.ndarray) -> tuple[float, float, float]:
    """Return the variances [px²] along the longer and the shorter axis, and the direction of the longer one [rad].

    `covariance` is [(x, y), (x, y)] in px². The direction runs from +x towards +y.
    """
    (minor_variance, major_variance), vectors = np.linalg.eigh(covariance)
    return float(major_variance), float(minor_variance), float(np.arctan2(vectors[1, 1], vectors[0, 1]))


def _place_area(ellipse: _Ellipse, shape: tuple[int, ...], side_widths: float = AREA) -> _Area:
    """Return the rectangle along the principal axes whose sides are `side_widths` times the width D4σ.

    It is clipped to the image of `shape` (rows, columns).
    """
    major_variance, minor_variance, angle = _find_principal_axes(ellipse.covariance)
    # Half of a side is side_widths · 4σ/2. An axis has at least the variance of a pixel.
    half_sides = side_widths * 2 * np.sqrt(np.maximum([major_variance, minor_variance], PIXEL_VARIANCE))
    cos, sin = np.cos(angle), np.sin(angle)
    half_width, half_height = half_sides @ np.abs([cos, sin]), half_sides @ np.abs([sin, cos])
    top, bottom = max(int(np.ceil(ellipse.y - half_height)), 0), min(int(ellipse.y + half_height), shape[0] - 1)
    left, right = max(int(np.ceil(ellipse.x - half_width)), 0), min(int(ellipse.x + half_width), shape[1] - 1)
    y = np.arange(top, bottom + 1)[:, None] - ellipse.y
    x = np.arange(left, right + 1)[None, :] - ellipse.x
    is_inside = (np.abs(x * cos + y * sin) <= half_sides[0]) & (np.abs(y * cos - x * sin) <= half_sides[1])
    return _Area(top, left, is_inside)


def _find_background_pixels(ellipse: _Ellipse, area: _Area, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the pixels of the ring around the area, both [pixel].

    If the frame of `shape` (rows, columns) contains too little of the ring, the corners of the frame replace it.
    """
    outer = _place_area(ellipse, shape, RING)
    ring = outer.mask.copy()
    top, left = area.top - outer.top, area.left - outer.left
    ring[top : top + area.mask.shape[0], left : left + area.mask.shape[1]] &= ~area.mask
    if np.count_nonzero(ring) >= LEAST_RING * np.count_nonzero(area.mask):
        rows, columns = np.nonzero(ring)
        return rows + outer.top, columns + outer.left
    corners = np.ones(shape, bool)
    height, width = (max(1, round(CORNER * side)) for side in shape)
    corners[height:-height, :] = corners[:, width:-width] = False
    rows, columns = np.nonzero(corners)
    return rows, columns


def _estimate_background(
    pixels: np.ndarray, is_unmeasured: np.ndarray, ellipse: _Ellipse, area: _Area
) -> tuple[float, float]:
    """Return the background around the area and its standard error, both in DN; NaN if no pixel there was measured.

    `pixels` is an image [rows, columns] in DN, and `is_unmeasured` marks its masked pixels.

    The background is the median of the mean readings of all sectors; a second spot in a few of them does not change it.
    """
    rows, columns = _find_background_pixels(ellipse, area, pixels.shape)
    is_known = ~is_unmeasured[rows, columns]
    rows, columns = rows[is_known], columns[is_known]
    if not rows.size:
        return np.nan, np.nan
    # Direction from the spot, as a fraction of a full turn.
    turns = np.arctan2(rows - ellipse.y, columns - ellipse.x) / (2 * np.pi) % 1.0
    sector = np.minimum((turns * SECTORS).astype(int), SECTORS - 1)
    count = np.bincount(sector, minlength=SECTORS)
    total = np.bincount(sector, pixels[rows, columns], minlength=SECTORS)
    is_used = count > len(rows) / SECTORS * LEAST_SECTOR
    means = total[is_used] / count[is_used]
    background = float(np.median(means))
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(means - background)))
    return background, MEDIAN_ERROR * scatter / np.sqrt(np.count_nonzero(is_used))


def _compute_moments(pixels: np.ndarray, area: _Area, background: float) -> _Ellipse | None:
    """Return centroid and second moments of the light above the background [DN] within the area.

    None if the sum of the light is not above 0, or if the second moments are not positive definite, as noise can cause.
    """
    light = np.where(area.mask, area.crop(pixels) - background, 0.0)
    total = float(light.sum())
    if not total > 0:
        return None
    y, x = np.arange(light.shape[0]) + area.top, np.arange(light.shape[1]) + area.left
    row_sums, column_sums = light.sum(axis=1), light.sum(axis=0)
    y0, x0 = float(y @ row_sums) / total, float(x @ column_sums) / total
    cov_xx, cov_yy = (x - x0) ** 2 @ column_sums / total, (y - y0) ** 2 @ row_sums / total
    cov_xy = float((y - y0) @ light @ (x - x0)) / total
    covariance = np.array([[cov_xx, cov_xy], [cov_xy, cov_yy]])
    if not np.linalg.eigvalsh(covariance)[0] > 0:
        return None
    return _Ellipse(x0, y0, covariance)


def _describe_spot(pixels: np.ndarray, is_unmeasured: np.ndarray, ellipse: _Ellipse, change: float) -> Moments:
    """Return the result of an iteration that ended at `ellipse`, with standard errors.

    `is_unmeasured` is the mask of `_fill_gaps` [row, column]; `change` is the last relative change of the width.
    """
    area = _place_area(ellipse, pixels.shape)
    major_variance, minor_variance, angle = _find_principal_axes(ellipse.covariance)
    background, background_stderr = _estimate_background(pixels, is_unmeasured, ellipse, area)
    pixels = np.where(is_unmeasured, background, pixels)
    light = np.where(area.mask, area.crop(pixels) - background, 0.0).sum()
    y = (np.arange(area.mask.shape[0]) + area.top - ellipse.y)[:, None]
    x = (np.arange(area.mask.shape[1]) + area.left - ellipse.x)[None, :]
    # Coordinates along the longer and the shorter axis [px].
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    noise_variance = _estimate_noise_variance(area.crop(pixels))

    def stderr(weights: np.ndarray) -> float:
        """Return the standard error of Σ weights · light / Σ light."""
        slopes = np.where(area.mask, weights, 0.0) / light
        return float(np.sqrt(np.sum(slopes**2 * noise_variance) + (slopes.sum() * background_stderr) ** 2))

    widths = 4 * np.sqrt([major_variance, minor_variance])
    # The width 4√m of a variance m has the differential 2 dm / √m.
    major_stderr = 2 * stderr(u**2 - major_variance) / np.sqrt(major_variance)
    minor_stderr = 2 * stderr(v**2 - minor_variance) / np.sqrt(minor_variance)
    cross_stderr, difference = stderr(u * v), major_variance - minor_variance
    difference_stderr = np.hypot(major_stderr * np.sqrt(major_variance), minor_stderr * np.sqrt(minor_variance)) / 2
    has_direction = difference > AXES_SIGMAS * difference_stderr
    tolerance = max(TOLERANCE, float(min(major_stderr, minor_stderr) / widths[0]))
    measured_pixels = float(np.count_nonzero(area.mask & ~area.crop(is_unmeasured)))
    return Moments(
        x=ellipse.x,
        y=ellipse.y,
        x_stderr=stderr(x + 0 * y),
        y_stderr=stderr(y + 0 * x),
        major=float(widths[0]),
        minor=float(widths[1]),
        major_stderr=float(major_stderr),
        minor_stderr=float(minor_stderr),
        azimuth=float(np.degrees(angle)) % 180.0,
        azimuth_stderr=float(np.degrees(cross_stderr / difference)) if has_direction else np.inf,
        light=float(light),
        background=background,
        background_stderr=background_stderr,
        area_fraction=min(1.0, measured_pixels / float(np.prod(AREA * widths))),
        lost_light=_estimate_lost_light(is_unmeasured, ellipse),
        has_converged=bool(change < tolerance),
    )


def _estimate_lost_light(is_unmeasured: np.ndarray, ellipse: _Ellipse) -> float:
    """Return the part of a Gaussian of the moments of `ellipse` in the pixels that `is_unmeasured` [row, column]."""
    rows, columns = np.nonzero(is_unmeasured)
    if not rows.size:
        return 0.0
    distance = np.stack([columns - ellipse.x, rows - ellipse.y])
    squares = np.sum(distance * np.linalg.solve(ellipse.covariance, distance), axis=0)
    return float(np.exp(-squares / 2).sum() / (2 * np.pi * np.sqrt(np.linalg.det(ellipse.covariance))))


def _estimate_noise_variance(window: np.ndarray) -> np.ndarray:
    """Return the noise variance of each pixel [row, column] in DN², from squared differences of its neighbours.

    The value of a single pixel is as uncertain as its size; sums over many pixels are accurate. A window that is too
    small for differences has the variance of its pixels instead.
    """
    squares = compute_differences(window).difference ** 2
    if not squares.size:
        return np.full(window.shape, float(np.var(window)))
    # Differences are missing for the first row and column and for the last two.
    return np.pad(squares, ((1, 2), (1, 2)), mode="edge")
