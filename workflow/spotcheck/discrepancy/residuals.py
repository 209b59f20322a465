"""Residuals of a fit at full resolution, for everything that scatters."""

from dataclasses import dataclass

import numpy as np

from spotcheck.discrepancy.evaluation import evaluate, map_batches
from spotcheck.discrepancy.frames import Design, FrameParameters, FrameSet, Pixels
from spotcheck.discrepancy.joint_fit import JointModel

# Distance [σ] from the spot beyond which a pixel is dark: the light of a Gaussian is 4e-6 of its peak there.
DARK_RADIUS = 5.0


@dataclass(frozen=True)
class ResidualImages:
    """Residuals of a fit; arrays [frame, row, column]."""

    residual: np.ndarray  # reading less mean [DN], 0 where a pixel is masked
    weight: np.ndarray  # 1/variance of the model [1/DN²], 0 where a pixel is masked
    slope: np.ndarray  # derivative of the mean reading by the light [1]
    spot: np.ndarray  # derivative of the mean reading by ln peak [DN]
    is_dark: np.ndarray  # whether a pixel lies far from the spot and is not masked
    left: np.ndarray  # column of the sensor under column 0 of each crop [frame]
    top: np.ndarray  # row of the sensor under row 0 [frame]
    design: Design  # conditions of the frames
    spots: FrameParameters  # fitted spots


def whole_crops(frames: FrameSet) -> Pixels:
    """Return all pixels of the crops."""
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
    """Return the residuals of all pixels of the frames of a model."""
    pixels = whole_crops(frames)
    shape = frames.readings.shape
    out = {name: np.empty(shape, np.float32) for name in ("residual", "weight", "slope", "spot")}
    is_dark = np.empty(shape, bool)

    def of_batch(part: slice) -> None:
        at = evaluate(model, pixels, part, with_slopes=False)
        slope = at.moments.mean_slope
        out["residual"][part], out["weight"][part] = at.residual, at.weight
        out["slope"][part], out["spot"][part] = slope, slope * at.light.spot
        conditions = at.conditions
        distance = np.hypot(conditions.pixels.x - conditions.x0, conditions.pixels.y - conditions.y0)
        is_dark[part] = (distance > DARK_RADIUS * conditions.sigma_px) & pixels.is_used[part]

    map_batches(of_batch, pixels)
    return ResidualImages(
        **out, is_dark=is_dark, left=frames.left, top=frames.top, design=model.design, spots=model.spots
    )


def place_on_sensor(images: np.ndarray, left: np.ndarray, top: np.ndarray) -> np.ndarray:
    """Return images [frame, row, column] on the smallest part of the sensor that holds all of them, 0 elsewhere."""
    down, right = top - top.min(), left - left.min()
    frames, rows, columns = images.shape
    out = np.zeros((frames, rows + int(down.max()), columns + int(right.max())), images.dtype)
    for f in range(frames):
        out[f, down[f] : down[f] + rows, right[f] : right[f] + columns] = images[f]
    return out
