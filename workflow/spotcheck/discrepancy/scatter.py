"""Scatter of pixels beyond the noise of the model: read noise and rows from dark pixels.

Products of residuals that share no noise estimate a covariance. Residuals of dark pixels are turned into signals with
the slope of the mean reading, which is below 1 where readings are cut at 0.
"""

from dataclasses import dataclass
from typing import NamedTuple

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
    found, shown = _multiply_lines(images.residual, dark), _multiply_lines(images.slope, dark)
    same, same_shown = (
        float((sums.sum(axis=0) ** 2 - (sums**2).sum(axis=0)).sum()) for sums in (found.row_sums, shown.row_sums)
    )
    return DarkNoise(
        white=_white_moment(images, slopes),
        row=ratio_moment(found.row, shown.row),
        column=ratio_moment(found.column, shown.column),
        next_row=ratio_moment(found.next_row, shown.next_row),
        same_row=Moment(same / max(same_shown, 1e-300), np.nan),
        neighbour=ratio_moment(found.neighbour, shown.neighbour),
    )


class LineProducts(NamedTuple):
    """Sums of products of dark pixels [frame, line]."""

    row: np.ndarray  # of blocks of a row
    column: np.ndarray  # of blocks of a column
    next_row: np.ndarray  # of the sums of two rows that touch
    neighbour: np.ndarray  # of neighbours in a row
    row_sums: np.ndarray  # sums of rows, without products


def _multiply_lines(values: np.ndarray, is_dark: np.ndarray) -> LineProducts:
    """Return the products of images [frame, row, column], frame by frame to save memory."""
    frames = []
    for image, dark in zip(values, is_dark, strict=True):
        image = image * dark
        rows = _block_sums(image)
        sums = rows.sum(axis=1)
        neighbours = (image[:, 1:].astype(float) * image[:, :-1]).sum(axis=1)
        columns = _far_products(_block_sums(image.T))
        frames.append((_far_products(rows), columns, sums[1:] * sums[:-1], neighbours, sums))
    return LineProducts(*map(np.array, zip(*frames, strict=True)))


def _white_moment(images: ResidualImages, slopes: DarkSlopes) -> Moment:
    """Return the variance beyond that of the model from differences of differences of four neighbours: these share no
    rows, no columns and no slope of the mean image. What light that the model lacks adds to the variance is taken off;
    it shows in the mean, to which noise adds as well."""
    by_mean = slopes.variance_by_light / slopes.mean_by_light
    lines = []
    for residual, weight, dark in zip(images.residual, images.weight, images.is_dark, strict=True):
        top, bottom = np.s_[: len(dark) // 2 * 2 : 2], np.s_[1::2]
        expected = 1 / np.where(dark, weight, 1.0).astype(float) + by_mean * residual
        tall, sums = residual[top].astype(float) - residual[bottom], expected[top] + expected[bottom]
        both = dark[top] & dark[bottom]
        used = both[:, 1:] & both[:, :-1]
        squares = np.where(used, (tall[:, 1:] - tall[:, :-1]) ** 2 - sums[:, 1:] - sums[:, :-1], 0.0)
        lines.append((squares.sum(axis=1), used.sum(axis=1)))
    squares, used = (np.array(part) for part in zip(*lines, strict=True))
    return ratio_moment(squares, 4 * (slopes.variance_by_noise - by_mean * slopes.mean_by_noise) * used)


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


def _block_sums(lines: np.ndarray) -> np.ndarray:
    """Return sums over blocks of lines [line, block]."""
    blocks = lines.shape[1] // BLOCK_PX
    return lines[:, : blocks * BLOCK_PX].reshape(len(lines), blocks, BLOCK_PX).sum(axis=2, dtype=float)


def _far_products(sums: np.ndarray) -> np.ndarray:
    """Return twice the sum of products of the blocks of a line that do not touch [line]."""
    touching = (sums[:, 1:] * sums[:, :-1]).sum(axis=1)
    return sums.sum(axis=1) ** 2 - (sums**2).sum(axis=1) - 2 * touching
