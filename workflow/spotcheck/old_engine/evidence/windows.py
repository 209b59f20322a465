"""What the frames of each site add up to, pixel by pixel, and how products of its pixels fall off with distance.

A field δ on the light moves a reading by a δ, a its slope. With weights 1/V a frame has s = a r/V and n = a²/V of each
pixel, r what is left of its reading: s has the mean n δ and the variance n.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.old_engine.evidence.pixels import CELLS, cells_of
from spotcheck.old_engine.observe.design import Design
from spotcheck.old_engine.observe.pixels import Expected, Frame, Told

# Distances (rows, columns) in steps at which products of pixels are summed: close by, where grains are fine, and
# further off.
LAGS = ((0, 0), (0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0), (0, 3), (3, 0), (0, 4), (4, 0), (0, 6), (6, 0),
        (0, 9), (9, 0), (0, 14), (14, 0))  # fmt: skip
# In products pixels count alike from this n on, or the brightest alone would tell: where a field of contrast 0.05
# stands out of a pixel's noise.
BRIGHT = 400.0


class Site(NamedTuple):
    """Of one site: how far apart the pixels are that are looked at [px], the corner of its window (row, column) in such
    steps, and of its pixels [row, column] S, Σ s², N, Σ n² over its frames, and the cell; `single` where it has one
    frame; products of pixels of different frames at each of the distances, and what they would be for a field of
    variance 1 that is alike everywhere [lag]; and the part of a field's variance that shape and numbers leave [cell],
    of fields of each site and of the sensor, and the grain of the first [px]."""

    step: int
    corner: tuple[int, int]
    pull: np.ndarray
    square: np.ndarray
    weight: np.ndarray
    heavy: np.ndarray
    cell: np.ndarray
    single: bool
    product: np.ndarray
    product_unit: np.ndarray
    kept: np.ndarray = np.ones(CELLS)
    kept_by_sensor: np.ndarray = np.ones(CELLS)
    grain: float = 0.0

    @property
    def unit(self) -> np.ndarray:
        """What products of different frames [row, column], or the square of one alone, are for a field of variance
        1."""
        return self.weight**2 - (0.0 if self.single else self.heavy)


class Window:
    """The part of the sensor that holds the frames of one site, and their sums while they are gone through."""

    def __init__(self, frames: Sequence[Frame]):
        corners = np.array([corner_of(own) for own in frames])
        low = corners.min(axis=0)
        rows, columns = (corners + [own.pixels.shape for own in frames]).max(axis=0) - low
        self.step = frames[0].step
        self.corner, self.shape, self.single = (int(low[0]), int(low[1])), (int(rows), int(columns)), len(frames) < 2
        self.sums: list[np.ndarray] = []
        self.cell, self.by_lag = np.zeros((0, 0), np.int32), np.zeros((2, len(LAGS)))

    def at(self, frame: Frame) -> tuple[slice, slice]:
        """Where a frame lies in the window."""
        return placed(corner_of(frame), frame.pixels.shape, self.corner)

    def add(self, frame: Frame, seen: Expected, tells: Told) -> None:
        """Add what a frame reads."""
        if not self.sums:
            self.sums, self.cell = [np.zeros(self.shape) for _ in range(6)], np.zeros(self.shape, np.int32)
        at, a = self.at(frame), seen.spot * seen.slope
        s, n = a * tells.mean, a * a * tells.sure
        even = evened(n)
        flat = s * even, n * even
        for sums, part in zip(self.sums, (s, s * s, n, n * n, *flat), strict=True):
            sums[at] += part
        if self.single:
            # Of one frame, noise is in the square of a pixel alone.
            self.by_lag[0, 0] -= float(np.vdot(even * even, n))
        else:
            self.by_lag -= [products(part) for part in flat]
        self.cell[at] = cells_of(seen.u, seen.v)

    def site(self) -> Site:
        """The sums of all frames."""
        pull, square, weight, heavy, *flat = self.sums
        by_lag = self.by_lag + [products(part) for part in flat]
        return Site(self.step, self.corner, pull, square, weight, heavy, self.cell, self.single, by_lag[0], by_lag[1])


def evened(n: np.ndarray) -> np.ndarray:
    """Weights of pixels in products at a distance."""
    return 1 / (1 + n / BRIGHT)


def products(image: np.ndarray) -> np.ndarray:
    """Σ of products of pixels [row, column] at each of the distances [lag]."""
    rows, columns = image.shape
    out = np.zeros(len(LAGS))
    for k, (down, right) in enumerate(LAGS):
        if down < rows and abs(right) < columns:
            one = image[: rows - down, max(-right, 0) : columns - max(right, 0)]
            two = image[down:, max(right, 0) : columns - max(-right, 0)]
            out[k] = np.einsum("rc,rc->", one, two)
    return out


def corner_of(frame: Frame) -> tuple[int, int]:
    """The sensor's row and column of a frame's first pixel, in steps of the frame."""
    return int(np.rint(frame.view.y.min() / frame.step)), int(np.rint(frame.view.x.min() / frame.step))


def windows_of(frames: Sequence[Frame], design: Design) -> Iterator[tuple[Window, list[int]]]:
    """An empty window of each site, and its frames."""
    for site in np.unique(design.site):
        own = np.flatnonzero(design.site == site).tolist()
        yield Window([frames[k] for k in own]), own


def whole_of(sites: Sequence[Site]) -> Site | None:
    """Sites as members of one window, where theirs lie on the same pixels of the sensor."""
    if len(sites) < 2:
        return None
    low = np.min([own.corner for own in sites], axis=0)
    high = np.max([np.add(own.corner, own.pull.shape) for own in sites], axis=0)
    if np.any(high - low > 2 * np.max([own.pull.shape for own in sites], axis=0)):
        return None
    pull, square, weight, heavy = np.zeros((4, *(high - low)))
    none = np.zeros(len(LAGS))
    corner = int(low[0]), int(low[1])
    kept = sites[0].kept_by_sensor
    whole = Site(
        sites[0].step, corner, pull, square, weight, heavy, np.zeros(high - low, np.int32), False, none, none, kept
    )
    for own in sites:
        at = placed(own.corner, own.pull.shape, corner)
        members = (own.pull, own.pull**2, own.weight, own.weight**2)
        for sums, part in zip((pull, square, weight, heavy), members, strict=True):
            sums[at] += part
        whole.cell[at] = own.cell
    return whole


def placed(corner: Sequence[int], shape: Sequence[int], beside: Sequence[int]) -> tuple[slice, slice]:
    """Where so many rows and columns from a corner on lie in a window with another corner."""
    (top, left), (height, width) = np.subtract(corner, beside), shape
    return slice(top, top + height), slice(left, left + width)
