"""Frames as text that a page carries: 16-bit integers, deflated, in base64. A browser unpacks a frame when it is shown
(frames.js).

Measured readings go as they are; a model's mean, which is smooth, as the second differences along its rows. The two
bytes of the numbers stand apart, which deflates further.
"""

import base64
import itertools
import zlib
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

# The number that stands for a pixel that was not measured.
MISSING = 65_535
# Means of models are kept to this [DN]: a twelfth of it is their error, far below the noise of any converter.
FINEST_DN = 0.25
LEVEL = 9
# Bytes that a page may have: 15 MB for 96 frames, 40 MB for 1,000, and on a straight line between.
FEWEST, LEAST_ROOM, ROOM_EACH, MOST_ROOM = 96, 15_000_000, 27_650, 40_000_000
# Bytes of it that are kept for all but the frames: 4.8 MB of Plotly, and pictures and tables.
BESIDE = 8_000_000


class Layer(NamedTuple):
    """Readings [row, column] in DN, NaN where none was measured; what an integer stands for [DN]; whether they are
    smooth; and the layer, of the same step, from which they are kept as the difference ("": none)."""

    readings: np.ndarray
    step: float
    smooth: bool
    beside: str = ""


def step_of(full_scale: float) -> float:
    """The step in which means are kept [DN], a power of two."""
    return max(FINEST_DN, float(2.0 ** np.ceil(np.log2((full_scale + 1) / (MISSING + 1)))))


def room_of(count: int) -> int:
    """Bytes that so many frames may have together on a page."""
    return min(LEAST_ROOM + ROOM_EACH * max(count - FEWEST, 0), MOST_ROOM) - BESIDE


def block_of(size: Callable[[int], float], count: int) -> int:
    """The smallest side of a block of pixels [px] with which so many frames have room; `size` is that of one frame in
    such blocks [byte]."""
    return next(block for block in itertools.count(1) if count * size(block) <= room_of(count))


def thinned(image: np.ndarray, block: int) -> np.ndarray:
    """Means of square blocks of pixels [row, column], those left over at the far edges left out; NaN where one is."""
    rows, columns = (size // block for size in image.shape)
    return image[: rows * block, : columns * block].reshape(rows, block, columns, block).mean(axis=(1, 3))


def packed(layers: Mapping[str, Layer]) -> str:
    """The layers of one frame, in their order, as text."""
    whole = {name: _integers(own.readings, own.step) for name, own in layers.items()}
    parts = []
    for name, own in layers.items():
        values = whole[name] - whole[own.beside] if own.beside else whole[name]
        values = np.diff(values, n=2, axis=1, prepend=np.zeros((len(values), 2), np.uint16)) if own.smooth else values
        parts += [(values & 0xFF).astype(np.uint8).tobytes(), (values >> 8).astype(np.uint8).tobytes()]
    return base64.b64encode(zlib.compress(b"".join(parts), LEVEL)).decode()


def _integers(readings: np.ndarray, step: float) -> np.ndarray:
    gaps = np.isnan(readings)
    values = np.clip(np.rint(np.where(gaps, 0.0, readings) / step), 0, MISSING - gaps.any()).astype(np.uint16)
    values[gaps] = MISSING
    return values
