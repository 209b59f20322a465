"""The inputs and intermediate results of the forward model for one frame: pixels, conditions, width and peak.

The exposure law gives peak and width of a spot as functions of the exposure; effects are deviations from this model.
The top hat cuts the Gaussian of the spot to a plateau.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class PixelGrid:
    """Pixels at which a model is evaluated, in px of the whole sensor; x to the right, y down, centres at integers."""

    x: np.ndarray  # columns of the pixels [px], an array that broadcasts with y, such as [1, column]
    y: np.ndarray  # rows of the pixels [px], such as [row, 1]
    sensor_columns: int  # columns of the sensor's frame
    sensor_rows: int  # rows of the sensor's frame
    # Number of rows of the sensor that each row of the grid stands for, in sums along columns; broadcasts with y.
    row_share: np.ndarray | float = 1.0

    @property
    def centre_x(self) -> float:
        """Column of the middle of the sensor's frame [px]."""
        return (self.sensor_columns - 1) / 2

    @property
    def centre_y(self) -> float:
        """Row of the middle of the sensor's frame [px]."""
        return (self.sensor_rows - 1) / 2


def crop_grid(columns: range, rows: range, sensor_columns: int, sensor_rows: int) -> PixelGrid:
    """Return the grid of a rectangular part of the sensor, given by ranges of its columns and rows [px].

    `sensor_columns` and `sensor_rows` are the size of the sensor's whole frame.
    """
    x, y = np.arange(columns.start, columns.stop, dtype=float), np.arange(rows.start, rows.stop, dtype=float)
    return PixelGrid(x[None, :], y[:, None], sensor_columns, sensor_rows)


# A number, or an array [frame, 1, 1] that broadcasts with the pixels [frame, row, column] of several frames.
PerFrame = Any


@dataclass(frozen=True)
class FrameConditions:
    """Conditions of one frame, or of several: the place of the spot, and how the frame was taken."""

    pixels: PixelGrid  # where the model is evaluated
    x0: PerFrame  # column of the spot's centre [px]
    y0: PerFrame  # row of the spot's centre [px]
    exposure_s: PerFrame  # nominal exposure [s]
    longest_s: float  # longest exposure of the dataset [s], at which the exposure law states the peak
    reference_s: float  # exposure [s] at which the effect spread_law (width as a power of t) leaves the width unchanged
    angle: PerFrame = 0.0  # angle of the fibres of the sample [rad]
    order: PerFrame = 0.5  # place in the order of acquisition, from 0 to 1
    peak_dn: PerFrame = np.nan  # peak of the spot [DN]; NaN, unused, if an exposure law gives it
    sigma_px: PerFrame = np.nan  # width σ_g of the spot [px]; NaN, unused, if an exposure law gives it
    # Known values of what random steps of effects draw, by the name of the effect. Values in a `Drawn` replace them.
    draws: Mapping[str, PerFrame] = field(default_factory=dict)


@dataclass(frozen=True)
class WidthLaw:
    """Width of the spot over the exposure t: σ_g = (p_b(t) + M σ_la/s_px) · factor, where M σ_la/s_px is the laser's.

    Without an exposure law each frame has its own width, which only `factor` changes.
    """

    propagation_px: Callable[[float], float]  # beam propagation p_b [px] as a function of the exposure [s]
    factor: float = 1.0  # factor on σ_g [1]


@dataclass(frozen=True)
class SpotState:
    """Peak and width of the spot of a frame, after the stages exposure, width and brightness."""

    peak_dn: float  # peak of the Gaussian before the top hat [DN]
    sigma_px: float  # width σ_g [px]
