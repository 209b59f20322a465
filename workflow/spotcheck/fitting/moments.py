"""Widths of a spot by second moments (ISO 11146-1:2021, ISO 11146-3:2004), with standard errors.

Along a principal axis u the width is D4σ = 4 √⟨u²⟩. Light is summed over a rectangle along the principal axes, three
widths long on each side and found again until it stays; the background, which pixels around it read, is taken off
first. No shape is assumed, and the price is paid in noise: a background that is wrong by 0.1 % of a Gaussian's peak
changes its width by 13 %.

A reading I of one pixel moves ⟨u²⟩ by (u² − ⟨u²⟩) dI / ΣI. Its variance is what differences of neighbouring pixels show
at its place: read, shot and rounding noise, without a gain to be known. The background's is how much it differs between
directions from the spot, which sees stray light as well as noise.

# ASSUME: what lies around the area is what lies under the spot, and all light within the area is the spot's.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage
from skimage.measure import label

from spotcheck.characterization.noise_curve import compute_differences
from spotcheck.crops.spotfinding import find_light_centroid

# Sides of the area of integration in widths (ISO 11146-1, clause 7).
AREA = 3.0
# The area stays when its width changes by no more than this part, after so many steps at most; from the later ones on
# it goes but half of the way, since pixels that come and go at its edge may make it swing.
SETTLED, STEPS, LATER = 5e-4, 20, 8
# The background is that around the area, up to a rectangle of so many widths, in so many directions from the spot.
RING, SECTORS = 4.5, 32
# Where the frame holds less around the area than this part of it, corners of this part of the sides stand in for it.
ENOUGH, CORNER = 0.1, 0.05
# Within half of its peak a Gaussian has this part of its variance.
WITHIN_HALF = np.log(2) / 2
# A width is measured where its error is below this part of it.
KNOWN = 0.5
# Part of the area of integration that a frame must hold for the width to be that of the standard.
WHOLE = 0.9
# How far [px] a pixel stands in for one that was not measured.
NEAR = 2


class Moments(NamedTuple):
    """A spot by its moments; lengths in px, NaN where there is no light; a centre alone where there is no width.

    Attributes
    ----------
    x, y, x_stderr, y_stderr : column and row of the centroid.
    major, minor, major_stderr, minor_stderr : D4σ along the principal axes.
    azimuth, azimuth_stderr : direction of the longer axis from +x towards +y [degree]; the error is infinite where the
        axes differ by less than their errors.
    light : readings less background over the area [DN].
    background, background_stderr : what a pixel reads beside the spot [DN].
    inside : part of the area of integration that the frame holds.
    settled : whether the area stayed, within the errors of the widths.
    """

    x: float
    y: float
    x_stderr: float
    y_stderr: float
    major: float
    minor: float
    major_stderr: float
    minor_stderr: float
    azimuth: float
    azimuth_stderr: float
    light: float
    background: float
    background_stderr: float
    inside: float
    settled: bool

    @property
    def measured(self) -> bool:
        """Whether both widths are known to better than half of themselves."""
        return bool(self.major_stderr < KNOWN * self.major and self.minor_stderr < KNOWN * self.minor)

    @property
    def whole(self) -> bool:
        """Whether the frame holds the area that the standard sums over."""
        return self.inside >= WHOLE


NONE = Moments(*(np.nan,) * 14, settled=False)


class _Ellipse(NamedTuple):
    """Centre [px] and covariance matrix [px²] of the light."""

    x: float
    y: float
    covariance: np.ndarray


class _Area(NamedTuple):
    """The area of integration: first row and column of its window, and which pixels of the window it holds."""

    top: int
    left: int
    mask: np.ndarray

    def of(self, pixels: np.ndarray) -> np.ndarray:
        """The window's pixels."""
        rows, columns = self.mask.shape
        return pixels[self.top : self.top + rows, self.left : self.left + columns]


def second_moments(image: np.ndarray) -> Moments:
    """Second-moment widths of the spot on an image [rows, columns] in DN, with standard errors.

    NaN pixels take part as the nearest one, beyond `NEAR` px from it as background. The errors hold to first order in
    the noise: where one is large (`measured` is False) the width may be anything. Noise that pixels share, as in
    compressed images, is not seen.
    """
    pixels, gone = _filled(np.asarray(image, float))
    start = _start(pixels)
    if start is None:
        return NONE
    ellipse, change = start, np.inf
    for step in range(STEPS):
        area = _area(ellipse, pixels.shape)
        found = _moments(pixels, area, _background(pixels, ellipse, area)[0])
        if found is None:
            return NONE._replace(x=start.x, y=start.y)
        part = 1.0 if step < LATER else 0.5
        # A single pixel above all others has no extent.
        extent = max(float(np.trace(ellipse.covariance)), np.finfo(float).tiny)
        change = float(np.abs(found.covariance - ellipse.covariance).max()) / extent / 2
        ellipse = _Ellipse(
            ellipse.x + part * (found.x - ellipse.x),
            ellipse.y + part * (found.y - ellipse.y),
            ellipse.covariance + part * (found.covariance - ellipse.covariance),
        )
        if change < SETTLED:
            break
    return _with_errors(pixels, gone, ellipse, change)


def _filled(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The image with something in the place of NaN, and which pixels have nothing near that was measured."""
    gaps = np.isnan(pixels)
    if not gaps.any() or gaps.all():
        return np.where(gaps, 0.0, pixels), gaps
    distance, nearest = ndimage.distance_transform_edt(gaps, return_indices=True)
    gone = distance > NEAR
    return np.where(gone, np.nanmedian(pixels), pixels[tuple(nearest)]), gone


def _start(pixels: np.ndarray) -> _Ellipse | None:
    """The ellipse of the Gaussian that is as large at half of its peak as the light is; None where there is no spot."""
    if min(pixels.shape) < 4:
        return None
    at = find_light_centroid(pixels, min(pixels.shape))
    if not at.exists:
        return None
    smooth = ndimage.uniform_filter(pixels, 3)
    background = float(np.median(pixels[::4, ::4]))
    near = smooth[max(at.row - 1, 0) : at.row + 2, max(at.column - 1, 0) : at.column + 2]
    bright = smooth - background > (float(near.max()) - background) / 2
    regions = label(bright, connectivity=2)
    own = regions[at.row, at.column]
    rows, columns = np.nonzero(regions == own if own else bright)
    spread = np.cov(np.stack([columns, rows]), bias=True) if rows.size > 1 else np.zeros((2, 2))
    # A region of one pixel has the variance of a pixel.
    return _Ellipse(float(columns.mean()), float(rows.mean()), (spread + np.eye(2) / 12) / WITHIN_HALF)


def _axes(covariance: np.ndarray) -> tuple[float, float, float]:
    """Variances [px²] along the longer and the shorter principal axis, and direction of the longer one [rad]."""
    (minor, major), vectors = np.linalg.eigh(covariance)
    return float(major), float(minor), float(np.arctan2(vectors[1, 1], vectors[0, 1]))


def _area(ellipse: _Ellipse, shape: tuple[int, ...], widths: float = AREA) -> _Area:
    """The rectangle along the principal axes with sides of so many widths, as far as the frame holds it."""
    major, minor, angle = _axes(ellipse.covariance)
    half = widths * 2 * np.sqrt(np.maximum([major, minor], 1 / 12))
    cos, sin = np.cos(angle), np.sin(angle)
    reach_x, reach_y = half @ np.abs([cos, sin]), half @ np.abs([sin, cos])
    top, bottom = max(int(np.ceil(ellipse.y - reach_y)), 0), min(int(ellipse.y + reach_y), shape[0] - 1)
    left, right = max(int(np.ceil(ellipse.x - reach_x)), 0), min(int(ellipse.x + reach_x), shape[1] - 1)
    y = np.arange(top, bottom + 1)[:, None] - ellipse.y
    x = np.arange(left, right + 1)[None, :] - ellipse.x
    return _Area(top, left, (np.abs(x * cos + y * sin) <= half[0]) & (np.abs(y * cos - x * sin) <= half[1]))


def _outside(ellipse: _Ellipse, area: _Area, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels around the area that tell the background; the corners of the frame where it holds
    too few of them."""
    wide = _area(ellipse, shape, RING)
    ring = wide.mask.copy()
    top, left = area.top - wide.top, area.left - wide.left
    ring[top : top + area.mask.shape[0], left : left + area.mask.shape[1]] &= ~area.mask
    if np.count_nonzero(ring) >= ENOUGH * np.count_nonzero(area.mask):
        rows, columns = np.nonzero(ring)
        return rows + wide.top, columns + wide.left
    corners = np.ones(shape, bool)
    height, width = (max(1, round(CORNER * side)) for side in shape)
    corners[height:-height, :] = corners[:, width:-width] = False
    rows, columns = np.nonzero(corners)
    return rows, columns


def _background(pixels: np.ndarray, ellipse: _Ellipse, area: _Area) -> tuple[float, float]:
    """Median [DN] over directions of what pixels around the area read on average, which a second spot does not move,
    and its standard error by how much the directions differ."""
    rows, columns = _outside(ellipse, area, pixels.shape)
    turn = np.arctan2(rows - ellipse.y, columns - ellipse.x) / (2 * np.pi) % 1.0
    sector = np.minimum((turn * SECTORS).astype(int), SECTORS - 1)
    number = np.bincount(sector, minlength=SECTORS)
    total = np.bincount(sector, pixels[rows, columns], minlength=SECTORS)
    used = number > len(rows) / SECTORS / 4
    means = total[used] / number[used]
    level = float(np.median(means))
    # Of n normal numbers the median has 1.25 times the error of the mean, and the scatter is 1.48 median deviations.
    scatter = 1.4826 * float(np.median(np.abs(means - level)))
    return level, 1.2533 * scatter / np.sqrt(np.count_nonzero(used))


def _moments(pixels: np.ndarray, area: _Area, background: float) -> _Ellipse | None:
    """Centroid and second moments within the area; None where they are no ellipse."""
    light = np.where(area.mask, area.of(pixels) - background, 0.0)
    total = float(light.sum())
    if not total > 0:
        return None
    y, x = np.arange(light.shape[0]) + area.top, np.arange(light.shape[1]) + area.left
    of_rows, of_columns = light.sum(axis=1), light.sum(axis=0)
    y0, x0 = float(y @ of_rows) / total, float(x @ of_columns) / total
    cross = float((y - y0) @ light @ (x - x0)) / total
    covariance = np.array([[(x - x0) ** 2 @ of_columns / total, cross], [cross, (y - y0) ** 2 @ of_rows / total]])
    if not np.linalg.eigvalsh(covariance)[0] > 0:
        return None
    return _Ellipse(x0, y0, covariance)


def _with_errors(pixels: np.ndarray, gone: np.ndarray, ellipse: _Ellipse, change: float) -> Moments:
    """The moments of the last area, each with its standard error; `change` is the last step's, in parts of a width."""
    area = _area(ellipse, pixels.shape)
    major, minor, angle = _axes(ellipse.covariance)
    background, background_stderr = _background(pixels, ellipse, area)
    light = np.where(area.mask, area.of(pixels) - background, 0.0).sum()
    y = (np.arange(area.mask.shape[0]) + area.top - ellipse.y)[:, None]
    x = (np.arange(area.mask.shape[1]) + area.left - ellipse.x)[None, :]
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    noise = _variances(area.of(pixels))

    def stderr(moves: np.ndarray) -> float:
        """Of a number that a reading moves by so much."""
        moves = np.where(area.mask, moves, 0.0) / light
        return float(np.sqrt(np.sum(moves**2 * noise) + (moves.sum() * background_stderr) ** 2))

    widths = 4 * np.sqrt([major, minor])
    # d(4√m) = 2 dm / √m
    along, across = (2 * stderr(w**2 - m) / np.sqrt(m) for w, m in ((u, major), (v, minor)))
    turn, apart = stderr(u * v), major - minor
    differ = np.hypot(along * np.sqrt(major), across * np.sqrt(minor)) / 2
    azimuth_stderr = float(np.degrees(turn / apart)) if apart > 3 * differ else np.inf
    whole = np.prod(AREA * widths)
    settled = change < max(SETTLED, float(min(along, across) / widths[0]))
    return Moments(
        ellipse.x, ellipse.y, stderr(x + 0 * y), stderr(y + 0 * x), float(widths[0]), float(widths[1]), float(along),
        float(across), float(np.degrees(angle)) % 180.0, azimuth_stderr, float(light), background, background_stderr,
        min(1.0, float(np.count_nonzero(area.mask & ~area.of(gone)) / whole)), bool(settled),
    )  # fmt: skip


def _variances(window: np.ndarray) -> np.ndarray:
    """What each pixel's noise is by the differences of its neighbours [DN²]: right on average, not one by one."""
    own = compute_differences(window).difference ** 2
    if not own.size:
        return np.full(window.shape, float(np.var(window)))
    return np.pad(own, ((1, 2), (1, 2)), mode="edge")
