"""Images of frames as text on the page: 16-bit integers, compressed by DEFLATE, in base64.

The script frames.js unpacks a frame to show it. A layer is one image of a frame: the measured one, or the mean image
of a model. Readings are rounded to multiples of a step [DN] and stored as the number of steps. The mean image of a
model is smooth; it is stored as second differences along its rows, which are compressed better. Low and high bytes are
stored separately for the same reason. Differences and sums are taken modulo 2¹⁶, so that the integers are restored
exactly.
"""

import base64
import itertools
import zlib
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

# Integer of a pixel that was not measured; also the largest integer.
MISSING = 65_535
# Smallest step of mean images [DN]: the rounding error, step/√12, is far below the noise of any converter.
SMALLEST_STEP_DN = 0.25
COMPRESSION_LEVEL = 9  # the smallest output of zlib
# Largest size of a page [byte]: 15 MB up to 96 frames, then rising linearly to 40 MB for 1,000 frames or more.
FEW_FRAMES, SMALL_PAGE_BYTES, BYTES_PER_FRAME, LARGE_PAGE_BYTES = 96, 15_000_000, 27_650, 40_000_000
# Part of that size for everything but the frames [byte]: Plotly (4.8 MB), pictures and tables.
RESERVED_BYTES = 8_000_000


class Layer(NamedTuple):
    """An image of a frame: the measured one or that of a model."""

    readings: np.ndarray  # [row, column] in DN; NaN where not measured
    step: float  # multiple of DN to which readings are rounded [DN]
    is_smooth: bool  # whether it is stored as second differences along its rows
    base: str = ""  # name of a similar layer with the same step that is subtracted before storing; "" for none


def choose_step(full_scale: float) -> float:
    """Return the step of mean images [DN]: the smallest power of two with which all readings fit into 16 bits.

    `full_scale` is the largest reading [DN]. The step is at least `SMALLEST_STEP_DN`.
    """
    return max(SMALLEST_STEP_DN, float(2.0 ** np.ceil(np.log2((full_scale + 1) / (MISSING + 1)))))


def frames_budget(count: int) -> int:
    """Return the largest total size of the packed frames of a page [byte]; `count` is the number of frames."""
    page_bytes = min(SMALL_PAGE_BYTES + BYTES_PER_FRAME * max(count - FEW_FRAMES, 0), LARGE_PAGE_BYTES)
    return page_bytes - RESERVED_BYTES


def choose_block(frame_size: Callable[[int], float], count: int) -> int:
    """Return the smallest side of a block of pixels [px] with which all frames fit on the page.

    Parameters
    ----------
    frame_size : callable
        Mean size of a packed frame [byte] as a function of the side of the blocks [px].
    count : int
        Number of frames.
    """
    return next(side for side in itertools.count(1) if count * frame_size(side) <= frames_budget(count))


def block_means(image: np.ndarray, block: int) -> np.ndarray:
    """Return the means of square blocks of pixels [row, column]; `block` is their side [px].

    Incomplete blocks at the last rows and columns are omitted. A block with a NaN is NaN.
    """
    rows, columns = (size // block for size in image.shape)
    return image[: rows * block, : columns * block].reshape(rows, block, columns, block).mean(axis=(1, 3))


def pack_layers(layers: Mapping[str, Layer]) -> str:
    """Return the layers of one frame as base64 text, one after another in the order of `layers`.

    Parameters
    ----------
    layers : mapping of str to Layer
        Layers by name, of equal size. The mapping must include the `base` of each layer.
    """
    integers = {name: _round_readings(layer.readings, layer.step) for name, layer in layers.items()}
    chunks = []
    for name, layer in layers.items():
        # 16-bit differences may wrap around; frames.js adds them modulo 2¹⁶ as well.
        values = integers[name] - integers[layer.base] if layer.base else integers[name]
        if layer.is_smooth:
            # Two zeros before each row make the second difference invertible and keep the number of columns.
            values = np.diff(values, n=2, axis=1, prepend=np.zeros((len(values), 2), np.uint16))
        low_bytes, high_bytes = (values & 0xFF).astype(np.uint8), (values >> 8).astype(np.uint8)
        chunks += [low_bytes.tobytes(), high_bytes.tobytes()]
    return base64.b64encode(zlib.compress(b"".join(chunks), COMPRESSION_LEVEL)).decode()


def _round_readings(readings: np.ndarray, step: float) -> np.ndarray:
    """Return readings [row, column] in DN as 16-bit multiples of a step [DN]; `MISSING` for NaN."""
    is_missing = np.isnan(readings)
    # If a reading is missing, no other reading may become the integer `MISSING`.
    highest = MISSING - is_missing.any()
    integers = np.clip(np.rint(np.where(is_missing, 0.0, readings) / step), 0, highest).astype(np.uint16)
    integers[is_missing] = MISSING
    return integers
