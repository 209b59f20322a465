"""What the forward model needs to know of a frame."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class PixelGrid:
    """Pixels at which a model is evaluated, in px of the whole sensor; x to the right, y down, centres at integers."""

    x: np.ndarray  # columns of the pixels [px], an array that broadcasts with y, such as [1, column]
    y: np.ndarray  # rows of the pixels [px], such as [row, 1]
    sensor_columns: int  # columns of the sensor's frame
    sensor_rows: int  # rows of the sensor's frame
    row_share: np.ndarray | float = 1.0  # rows of the sensor that each row of the grid stands for, in sums over columns

    @property
    def centre_x(self) -> float:
        """Column of the middle of the sensor's frame [px]."""
        return (self.sensor_columns - 1) / 2

    @property
    def centre_y(self) -> float:
        """Row of the middle of the sensor's frame [px]."""
        return (self.sensor_rows - 1) / 2


def crop_grid(columns: range, rows: range, sensor_columns: int, sensor_rows: int) -> PixelGrid:
    """Return the grid of a rectangular part of the sensor, with x [1, column] and y [row, 1]."""
    x, y = np.arange(columns.start, columns.stop, dtype=float), np.arange(rows.start, rows.stop, dtype=float)
    return PixelGrid(x[None, :], y[:, None], sensor_columns, sensor_rows)


# A number, or an array [frame, 1, 1] that broadcasts with the pixels [frame, row, column] of several frames.
PerFrame = Any


@dataclass(frozen=True)
class FrameConditions:
    """Conditions of one frame, or of several: where the spot lies and under which it was taken."""

    pixels: PixelGrid  # where the model is evaluated
    x0: PerFrame  # column of the spot's centre [px]
    y0: PerFrame  # row of the spot's centre [px]
    exposure_s: PerFrame  # nominal exposure [s]
    longest_s: float  # longest exposure of the dataset [s], at which the peak of the law is given
    reference_s: float  # reference exposure [s], at which the spread law leaves the width unchanged
    angle: PerFrame = 0.0  # angle of the fibres [rad]
    order: PerFrame = 0.5  # place in the order of acquisition, from 0 to 1
    peak_dn: PerFrame = np.nan  # peak of the spot [DN] where no law gives it
    sigma_px: PerFrame = np.nan  # width σ_g of the spot [px] where no law gives it


@dataclass(frozen=True)
class WidthLaw:
    """Width of the spot over the exposure: σ_g = (p_b(t) + M σ_la/s_px) · factor.

    Without a law of the exposure only `factor` is used, with the width of each frame.
    """

    propagation_px: Callable[[float], float]  # p_b [px] as a function of the exposure [s]
    factor: float = 1.0  # factor on σ_g [1]


@dataclass(frozen=True)
class SpotState:
    """The spot of a frame behind the stages exposure, width and brightness."""

    peak_dn: float  # peak of the Gaussian before the top hat [DN]
    sigma_px: float  # width σ_g [px]
