"""Residuals of a fit at all pixels of the crops, from which scatter is estimated and misfit is found.

A fit itself uses a subset of the pixels only.
"""

from dataclasses import dataclass

import numpy as np

from spotcheck.discrepancy.evaluation import evaluate, map_batches
from spotcheck.discrepancy.frames import Design, FrameParameters, FrameSet, Pixels
from spotcheck.discrepancy.joint_fit import JointModel

# Distance [σ of the spot] beyond which a pixel counts as dark: the light of a Gaussian is 4e-6 of its peak there.
DARK_RADIUS = 5.0


@dataclass(frozen=True)
class ResidualImages:
    """Residuals of a fit at all pixels of the crops; the first five arrays are [frame, row, column]."""

    residual: np.ndarray  # reading less mean of the model [DN], 0 where a pixel is masked
    weight: np.ndarray  # 1/variance of a reading by the model [1/DN²], 0 where a pixel is masked
    slope: np.ndarray  # derivative of the mean reading by the light [1]; below 1 where readings are cut or bent
    spot: np.ndarray  # derivative of the mean reading by ln peak [DN]: the light of the spot where `slope` is 1
    is_dark: np.ndarray  # True beyond `DARK_RADIUS` of the spot, unless the pixel is masked
    left: np.ndarray  # column of the sensor under column 0 of each crop [frame]
    top: np.ndarray  # row of the sensor under row 0 of each crop [frame]
    design: Design  # conditions of the frames
    spots: FrameParameters  # fitted spots


def select_all_pixels(frames: FrameSet) -> Pixels:
    """Return all pixels of the crops, without the variance and dispersion of granular light."""
    _, rows, columns = frames.readings.shape
    is_used = np.isfinite(frames.readings)
    return Pixels(
        x=(frames.left[:, None] + np.arange(columns, dtype=float))[:, None, :],
        y=(frames.top[:, None] + np.arange(rows, dtype=float))[:, :, None],
        readings=np.where(is_used, frames.readings, 0.0),
        is_used=is_used,
        row_share=np.ones((len(frames), rows, 1)),
        sensor_columns=frames.sensor_columns,
        sensor_rows=frames.sensor_rows,
        extra_variance=np.zeros((len(frames), 1, 1)),
        field_share=np.zeros((len(frames), 1, 1)),
    )


def measure_residuals(model: JointModel, frames: FrameSet) -> ResidualImages:
    """Return the residuals of all pixels of the crops under a model of these frames, in single precision."""
    pixels = select_all_pixels(frames)
    shape = frames.readings.shape
    images = {name: np.empty(shape, np.float32) for name in ("residual", "weight", "slope", "spot")}
    is_dark = np.empty(shape, bool)

    def fill_frames(batch: slice) -> None:
        """Fill the arrays of a batch of frames."""
        evaluation = evaluate(model, pixels, batch, with_slopes=False)
        slope, conditions = evaluation.moments.mean_slope, evaluation.conditions
        images["residual"][batch], images["weight"][batch] = evaluation.residual, evaluation.weight
        images["slope"][batch], images["spot"][batch] = slope, slope * evaluation.light.spot
        distance = np.hypot(conditions.pixels.x - conditions.x0, conditions.pixels.y - conditions.y0)
        is_dark[batch] = (distance > DARK_RADIUS * conditions.sigma_px) & pixels.is_used[batch]

    map_batches(fill_frames, pixels)
    return ResidualImages(
        **images, is_dark=is_dark, left=frames.left, top=frames.top, design=model.design, spots=model.spots
    )


def sum_over_blocks(images: np.ndarray, side: int) -> np.ndarray:
    """Return sums [frame, block row, block column] of images [frame, row, column] over blocks of `side` × `side` px.

    Rows and columns at the far edges that fill no block are left out.
    """
    frames, height, width = images.shape
    rows, columns = height // side, width // side
    blocks = images[:, : rows * side, : columns * side].reshape(frames, rows, side, columns, side)
    return blocks.sum(axis=(2, 4), dtype=float)


def place_on_sensor(images: np.ndarray, left: np.ndarray, top: np.ndarray) -> np.ndarray:
    """Return crops at their positions on the sensor, in the smallest rectangle that holds all crops; 0 elsewhere.

    Parameters
    ----------
    images : array [frame, row, column]
        Values at the pixels of the crops, in any unit.
    left, top : array [frame]
        Column and row of the sensor under pixel (0, 0) of each crop, integers.

    Returns
    -------
    array [frame, row, column]
        Row 0 is row top.min() of the sensor, column 0 is column left.min().
    """
    row_offsets, column_offsets = top - top.min(), left - left.min()
    frames, rows, columns = images.shape
    canvas = np.zeros((frames, rows + int(row_offsets.max()), columns + int(column_offsets.max())), images.dtype)
    for image, placed, row, column in zip(images, canvas, row_offsets, column_offsets, strict=True):
        placed[row : row + rows, column : column + columns] = image
    return canvas
