"""Condition means: what the refits see. Blocks of pixels, averaged over the frames of each condition."""

from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.measure import Measured
from spotcheck.discrepancy.shots import Design
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Free, Law, View
from spotcheck.model.sensor import SensorModel

# Bins of the base's light, as fractions of its peak, in which the noise is judged.
LEVELS = np.array([-1.0, 0.01, 0.05, 0.15, 0.35, 0.6, 2.0])


class Setting(NamedTuple):
    """What stays the same for every fit: baseline, sensor, rows of the frame and its centre [px]."""

    baseline: Baseline
    sensor: SensorModel
    frame_rows: float
    frame_centre: tuple[float, float]


class Cells(NamedTuple):
    """Mean residual [condition, row, column] in DN of each block, variance of that mean [DN²] under the base model,
    pixels in it, and the view and base at which the model is evaluated: two points a block along each axis, placed so
    that they have the pixels' own first and second moments.

    `rough` [condition, level] is the mean squared standardised residual about a plane, `rough_error` its standard
    error, `level` [condition, row, column] the bin of light of each block.
    """

    residual: np.ndarray
    variance: np.ndarray
    pixels: np.ndarray
    view: View
    base: Law | Free
    angle: np.ndarray
    place: np.ndarray
    frames: np.ndarray
    rough: np.ndarray
    rough_error: np.ndarray
    level: np.ndarray


def cells_of(measured: Measured, setting: Setting) -> Cells:
    """Cells of all frames of a measurement; a condition without frames has cells without pixels."""
    design, sums = measured.design, measured.sums
    shape = (design.conditions, *sums.residual.shape[1:])
    residual, variance, count, rough, dof, fourth = (np.zeros(shape) for _ in range(6))
    np.add.at(residual, design.condition, sums.residual * sums.pixels)
    np.add.at(variance, design.condition, sums.variance * sums.pixels)
    np.add.at(count, design.condition, sums.pixels)
    np.add.at(rough, design.condition, sums.rough)
    np.add.at(dof, design.condition, sums.rough_dof)
    np.add.at(fourth, design.condition, sums.fourth)
    filled = np.maximum(count, 1)
    residual, variance = residual / filled, np.where(count > 0, variance / filled**2, np.inf)
    view = view_of(measured, setting)
    level = _levels(measured, setting, shape)
    bins = len(LEVELS) - 1
    own, own_dof, own_fourth = (np.zeros((shape[0], bins)) for _ in range(3))
    index = np.broadcast_to(np.arange(shape[0])[:, None, None], shape)
    for total, part in ((own, rough), (own_dof, dof), (own_fourth, fourth)):
        np.add.at(total, (index, level), part)
    known = own_dof > 60
    filled_dof = np.where(known, own_dof, 1.0)
    ratio = np.where(known, own / filled_dof, np.nan)
    # Var z² from the frames' own fourth moments: clipped readings are far from normal.
    spread = np.maximum(own_fourth / filled_dof - (own / filled_dof) ** 2, 0.5)
    error = np.where(known, np.sqrt(spread / filled_dof), np.nan)
    base = measured.base.of_condition(design)
    frames = np.bincount(design.condition, minlength=design.conditions)
    return Cells(residual, variance, count, view, base, design.angle_deg, design.place, frames, ratio, error, level)


def view_of(measured: Measured, setting: Setting) -> View:
    """One view a condition: the mean of its frames' places and times."""
    design, base, side = measured.design, measured.base, measured.side
    blocks_y, blocks_x = measured.sums.residual.shape[1:]
    half = np.sqrt((side**2 - 1) / 12)
    points = [np.sort(np.concatenate([side * np.arange(n) + (side - 1) / 2 + s * half for s in (-1, 1)]))
              for n in (blocks_x, blocks_y)]  # fmt: skip
    used = np.bincount(design.condition, minlength=design.conditions)

    def mean(values):
        total = np.bincount(design.condition, weights=values, minlength=design.conditions)
        return (total / np.maximum(used, 1))[:, None, None]

    left, top = mean(measured.left), mean(measured.top)
    # Where exposures were not recorded all count as one second: what grows with them is the same in every frame.
    exposure = np.nan_to_num(design.exposure_s, nan=1.0)[:, None, None]
    angle = np.deg2rad(np.nan_to_num(design.angle_deg))[:, None, None]
    longest = float(np.max(exposure))
    known = design.exposure_s[np.isfinite(design.exposure_s)]
    return View(
        left + points[0][None, None, :],
        top + points[1][None, :, None],
        mean(base.x0 + measured.left),
        mean(base.y0 + measured.top),
        exposure,
        angle,
        orders_of(design),
        0.0 * exposure,
        0.0 * exposure,
        longest,
        float(np.exp(np.mean(np.log(np.unique(known))))) if known.size else 1.0,
        *setting.frame_centre,
        setting.frame_rows,
        side / 2,
    )


def orders_of(design: Design) -> np.ndarray:
    """Places in the order of acquisition of each condition's frames [condition, 1, frame], NaN where it has fewer; an
    unknown order counts as its middle."""
    own = [np.nan_to_num(design.order[design.condition == c], nan=0.5) for c in range(design.conditions)]
    out = np.full((design.conditions, 1, max(1, *(len(o) for o in own))), np.nan)
    for row, orders in zip(out[:, 0], own, strict=True):
        row[: len(orders)] = orders
        if not len(orders):
            row[0] = 0.5
    return out


def pooled(points: np.ndarray) -> np.ndarray:
    """Means over the four points of each block [..., row, column]."""
    paired = points[..., 0::2] + points[..., 1::2]
    return (paired[..., 0::2, :] + paired[..., 1::2, :]) / 4


def _levels(measured: Measured, setting: Setting, shape: tuple) -> np.ndarray:
    """Bin of the base's light of each block, as a fraction of the brightest spot's peak in the set."""
    base, design = measured.base, measured.design
    out = np.zeros(shape, int)
    side = measured.side
    y, x = (side * np.arange(n) + (side - 1) / 2 for n in shape[1:])
    for c in range(shape[0]):
        own = design.condition == c
        if not own.any():
            continue
        x0, y0, sigma = base.x0[own].mean(), base.y0[own].mean(), base.sigma[own].mean()
        fraction = np.exp(-((x[None] - x0) ** 2 + (y[:, None] - y0) ** 2) / (2 * sigma**2))
        out[c] = np.digitize(fraction, LEVELS) - 1
    return out
