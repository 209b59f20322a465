"""Scatter of pixels beyond the noise of the model: read noise and rows from dark pixels.

Products of residuals that share no noise estimate a covariance. Residuals of dark pixels are turned into signals with
the slope of the mean reading, which is below 1 where readings are cut at 0.
"""

from dataclasses import dataclass

import numpy as np

from spotcheck.discrepancy.residuals import ResidualImages

# Dark pixels without which their noise is not assessed.
FEWEST_DARK = 5000
# Pixels of a line are taken in blocks of this length; blocks that touch are no pair, so that neighbours that share
# light or noise do not count as a line [px].
BLOCK_PX = 8
# Frames from which on their scatter alone gives errors; with fewer that over lines of pixels counts as well.
MANY_FRAMES = 10


@dataclass(frozen=True)
class Moment:
    """A covariance of dark signals."""

    value: float  # [DN²]
    stderr: float  # standard error [DN²]


@dataclass(frozen=True)
class DarkSlopes:
    """How mean and variance of a dark reading change with its noise and with light; readings that are cut at 0 rise
    with both."""

    variance_by_noise: float  # [1], by the variance of the read noise
    mean_by_noise: float  # [1/DN]
    variance_by_light: float  # [DN]
    mean_by_light: float  # [1]


@dataclass(frozen=True)
class DarkNoise:
    """Noise of dark pixels of a signal, before rounding and the cut at 0."""

    white: Moment  # variance beyond that of the model, without what rows, columns and smooth light share
    row: Moment  # variance common to a row of a frame
    column: Moment  # variance common to a column of a frame
    next_row: Moment  # covariance of rows that are neighbours
    same_row: Moment  # covariance of the same row in different frames
    neighbour: Moment  # covariance of neighbours in a row


def measure_dark_noise(images: ResidualImages, slopes: DarkSlopes) -> DarkNoise | None:
    """Return the noise of dark pixels, or None if there are too few or their readings do not depend on it.

    Parameters
    ----------
    images : ResidualImages
        Residuals of a fit.
    slopes : DarkSlopes
        Slopes of dark readings beside the fit.
    """
    dark = images.is_dark
    if dark.sum() < FEWEST_DARK or slopes.variance_by_noise == 0:
        return None
    # Signals that a reading shows, and how much of one it shows.
    residual, slope = images.residual * dark, images.slope * dark
    rows, rows_shown = _block_sums(residual, 2), _block_sums(slope, 2)
    columns, columns_shown = _block_sums(residual, 1), _block_sums(slope, 1)
    row_sum, row_shown = rows.sum(axis=2), rows_shown.sum(axis=2)
    same, same_shown = (float((rows.sum(axis=0) ** 2 - (rows**2).sum(axis=0)).sum()) for rows in (row_sum, row_shown))
    return DarkNoise(
        white=_white_moment(images, slopes),
        row=ratio_moment(_far_products(rows), _far_products(rows_shown)),
        column=ratio_moment(_far_products(columns), _far_products(columns_shown)),
        next_row=ratio_moment(row_sum[:, 1:] * row_sum[:, :-1], row_shown[:, 1:] * row_shown[:, :-1]),
        same_row=Moment(same / max(same_shown, 1e-300), np.nan),
        neighbour=ratio_moment(
            (residual[:, :, 1:].astype(float) * residual[:, :, :-1]).sum(axis=2),
            (slope[:, :, 1:].astype(float) * slope[:, :, :-1]).sum(axis=2),
        ),
    )


def _white_moment(images: ResidualImages, slopes: DarkSlopes) -> Moment:
    """Return the variance beyond that of the model from differences of differences of four neighbours: these share no
    rows, no columns and no slope of the mean image. What light that the model lacks adds to the variance is taken off;
    it shows in the mean, to which noise adds as well."""
    rows = images.residual.shape[1] // 2 * 2
    dark, residual = images.is_dark[:, :rows], images.residual[:, :rows].astype(float)
    by_mean = slopes.variance_by_light / slopes.mean_by_light
    expected = 1 / np.where(dark, images.weight[:, :rows], 1.0) + by_mean * residual
    tall, sums = residual[:, ::2] - residual[:, 1::2], expected[:, ::2] + expected[:, 1::2]
    both = dark[:, ::2] & dark[:, 1::2]
    used = both[:, :, 1:] & both[:, :, :-1]
    squares = np.where(used, (tall[:, :, 1:] - tall[:, :, :-1]) ** 2 - sums[:, :, 1:] - sums[:, :, :-1], 0.0)
    shown = 4 * (slopes.variance_by_noise - by_mean * slopes.mean_by_noise)
    return ratio_moment(squares.sum(axis=2), shown * used.sum(axis=2))


def ratio_moment(products: np.ndarray, shown: np.ndarray) -> Moment:
    """Return Σ products / Σ shown, both [frame, line], with the standard error of the scatter of frames or lines."""
    total = max(float(shown.sum()), 1e-300)
    value = float(products.sum()) / total
    influence = (products - value * shown) / total
    frames = len(influence)
    of_frames = influence.sum(axis=1)
    over_frames = np.sqrt(np.sum(of_frames**2) * frames / max(frames - 1, 1)) if frames > 1 else 0.0
    over_lines = 0.0 if frames >= MANY_FRAMES else np.sqrt(np.sum(influence**2))
    return Moment(value, float(max(over_frames, over_lines)))


def _block_sums(values: np.ndarray, axis: int) -> np.ndarray:
    """Return sums over blocks of each line [frame, line, block] along rows (axis 2) or columns (axis 1)."""
    lines = values if axis == 2 else values.transpose(0, 2, 1)
    blocks = lines.shape[2] // BLOCK_PX
    shape = (*lines.shape[:2], blocks, BLOCK_PX)
    return lines[:, :, : blocks * BLOCK_PX].reshape(shape).sum(axis=3, dtype=float)


def _far_products(sums: np.ndarray) -> np.ndarray:
    """Return twice the sum of products of the blocks of a line that do not touch [frame, line]."""
    touching = (sums[:, :, 1:] * sums[:, :, :-1]).sum(axis=2)
    return sums.sum(axis=2) ** 2 - (sums**2).sum(axis=2) - 2 * touching
