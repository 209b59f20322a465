"""Reading frames, finding the spot, cropping, and reducing what lies around it."""

from collections.abc import Iterator
from itertools import groupby
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from skimage.measure import label

from spotcheck.dataset import Dataset, in_frames
from spotcheck.errors import InputError
from spotcheck.formats import files
from spotcheck.formats.page import PREVIEW, Page
from spotcheck.instrument import Instrument
from spotcheck.manifest import Frame

# Side of the blocks of the reduced copy [px]: 64 × 48 numbers for a frame of 12 Mpx.
BLOCK_PX = 64
# Side of the blocks in which the light is first looked for [px]: about the diameter of the smallest spot of interest.
SEARCH_PX = 16
# A spot must stand out of the noise of single pixels by this factor. The largest of 1e5 medians of nine reaches 1.9;
# where a black level of 0 cuts half of the noise away, its estimate comes out at 0.6 of it.
SPOT_OVER_NOISE = 6.0
# Nor is anything fainter than this a spot: where rounding hides the noise, its estimate is 0.
FAINTEST_DN = 2.5
# Runs of pages that a message lists; more would not be read.
MOST_RUNS = 5


class Probe(NamedTuple):
    """What the headers of all frames say: rows and columns [px], bits of a stored pixel, and remarks on pages that no
    row names."""

    shape: tuple[int, int]
    bits: int
    remarks: tuple[str, ...] = ()


def pages_of(dataset: Dataset) -> dict[str, list[Page]]:
    """Pages of every file that the manifest names; each row's is among them. Raises `InputError`."""
    found: dict[str, list[Page]] = {}
    for frame in dataset.frames:
        if frame.file not in found:
            found[frame.file] = files.pages(dataset.folder / frame.file, frame.file)
        count = len(found[frame.file])
        if frame.page >= count:
            raise InputError(f"{frame.label}: page is {frame.page}, but the file has {count}; pages count from 0")
        if found[frame.file][frame.page].preview:
            raise InputError(f"{frame.label}: {PREVIEW}")
    return found


def _unnamed_pages(dataset: Dataset, pages: dict[str, list[Page]]) -> tuple[str, ...]:
    """Remarks on pages in frames/ that no row names. Raises `InputError` for a stack of which the first page alone is
    named, as it is where nobody knew that it is a stack."""
    named = {(frame.file, frame.page) for frame in dataset.frames}
    remarks = []
    for file, own in pages.items():
        unnamed = [k for k, page in enumerate(own) if (file, k) not in named and not page.preview]
        if not unnamed or not in_frames(file):
            continue
        said = f"{file}: page{'s' if len(unnamed) > 1 else ''} {_runs(unnamed)}"
        said += f" {'are' if len(unnamed) > 1 else 'is'} named by no row of manifest.csv"
        if not any((file, k) in named for k in range(1, len(own))):
            raise InputError(f"{said}; add a row with its page for each, or move the file out of frames/")
        remarks.append(said)
    return tuple(remarks)


def _runs(numbers: list[int]) -> str:
    """Ascending numbers in words: `1 to 8, 11`."""
    runs = [[k for _, k in run] for _, run in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0])]
    said = [f"{run[0]} to {run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs]
    return ", ".join(said if len(said) <= MOST_RUNS else [*said[:MOST_RUNS], "…"])


def probe_all(dataset: Dataset) -> Probe:
    """Probe of every frame of a dataset; they must agree, and hold a crop. Raises `InputError`."""
    first: Probe | None = None
    pages = pages_of(dataset)
    remarks = _unnamed_pages(dataset, pages)
    for frame in dataset.frames:
        own = pages[frame.file][frame.page]
        found = Probe(own.shape, own.bits, remarks)
        if first is None:
            first = found
        elif found.shape != first.shape:
            raise InputError(
                f"{frame.label}: {found.shape[1]} × {found.shape[0]} px, but {dataset.frames[0].label} has"
                f" {first.shape[1]} × {first.shape[0]} px; all frames of a dataset must have one size"
            )
        elif found.bits != first.bits:
            raise InputError(
                f"{frame.label}: {found.bits} bit, but {dataset.frames[0].label} has {first.bits} bit;"
                f" all frames of a dataset must have one depth"
            )
    assert first is not None  # read_manifest refuses an empty one
    sensor = dataset.instrument.sensor
    if (sensor.bit_depth or 1) + sensor.value_shift_bits > first.bits:
        raise InputError(
            f"instrument.yaml: sensor.bit_depth and value_shift_bits ask for"
            f" {(sensor.bit_depth or 1) + sensor.value_shift_bits} bits, but the frames hold {first.bits};"
            f" together they must not exceed that"
        )
    crop = dataset.instrument.crop_px
    if dataset.spots and crop > min(first.shape):
        raise InputError(
            f"instrument.yaml: crop_px is {crop}, but the frames have {first.shape[1]} × {first.shape[0]} px;"
            f" it must be at most {min(first.shape)}"
        )
    return first


def read(dataset: Dataset, frame: Frame) -> np.ndarray:
    """Image of a frame of a dataset: pixels [rows, columns] in DN, unsigned, shifted out of a left-aligned container.

    Raises `InputError` for a file that cannot be decoded or holds values above the bit depth.

    Examples
    --------
    >>> import spotcheck
    >>> dataset = spotcheck.read_dataset("my-frames")
    >>> image = spotcheck.read_image(dataset, dataset.spots[-1])
    >>> image.shape, image.dtype, int(image.max())
    ((96, 96), dtype('uint16'), 624)
    """
    pixels = files.pixels(dataset.folder / frame.file, frame.page, frame.label)
    sensor = dataset.instrument.sensor
    if sensor.value_shift_bits:
        if (pixels & (2**sensor.value_shift_bits - 1)).any():
            raise InputError(
                f"{frame.label}: holds values with low bits set, but sensor.value_shift_bits is"
                f" {sensor.value_shift_bits}; it must be 0 for values that are not left-aligned"
            )
        pixels = pixels >> sensor.value_shift_bits
    highest = int(pixels.max())
    if sensor.bit_depth is not None and highest > full_scale(dataset.instrument, 16):
        raise InputError(
            f"{frame.label}: holds the value {highest}, above the {full_scale(dataset.instrument, 16)} of"
            f" sensor.bit_depth {sensor.bit_depth}; correct the bit depth, or set sensor.value_shift_bits"
        )
    return pixels


def full_scale(instrument: Instrument, container_bits: int) -> int:
    """Largest reading [DN]: of the converter where its depth is given, else of the container."""
    return 2 ** (instrument.sensor.bit_depth or container_bits - instrument.sensor.value_shift_bits) - 1


class Spot(NamedTuple):
    """Where the spot is on the frame: pixel [row, column], and whether there is one."""

    row: int
    column: int
    found: bool


def brightest_pixel(pixels: np.ndarray) -> Spot:
    """The maximum of the frame; of several equal ones the left-most, then the top-most (Section 3.1.1)."""
    rows, columns = np.nonzero(pixels == pixels.max())
    first = np.lexsort((rows, columns))[0]
    return Spot(int(rows[first]), int(columns[first]), True)


def light_centroid(pixels: np.ndarray, window_px: int) -> Spot:
    """Centroid of the light above half a robust maximum, indifferent to isolated hot pixels.

    The 2 × 2 minimum removes isolated pixels of any brightness before the brightest block is looked for; within a
    window around it the 3 × 3 median does. Background is the median of the frame, sampled. `found` is False when
    nothing stands out of the noise: then the place is the frame's centre.
    """
    eroded = np.minimum(pixels[:-1, :], pixels[1:, :])
    eroded = np.minimum(eroded[:, :-1], eroded[:, 1:])
    side = min(SEARCH_PX, *eroded.shape)
    rest = [(0, -length % side) for length in eroded.shape]
    sums = _block_mean(np.pad(eroded, rest, mode="edge"), side)
    sums = ndimage.uniform_filter(sums, 3, mode="nearest") if min(sums.shape) > 3 else sums
    block_row, block_column = np.unravel_index(np.argmax(sums), sums.shape)
    row, column = int(block_row) * side + side // 2, int(block_column) * side + side // 2

    background = float(np.median(pixels[::8, ::8]))
    # Differences of neighbours see the noise alone, also where a black level of 0 cuts half of it away.
    noise = float(np.median(np.abs(pixels[::4, :-1:8].astype(float) - pixels[::4, 1::8]))) / 0.954
    # Twice: a first window may cut a spot that is wider than the block that found it.
    for _ in range(2):
        top, left = max(row - window_px // 2, 0), max(column - window_px // 2, 0)
        window = _median_of_nine(pixels[top : top + window_px, left : left + window_px].astype(np.float32))
        signal = window - background
        peak = float(signal.max())
        found = peak > max(SPOT_OVER_NOISE * noise, FAINTEST_DN)
        if not found:
            break
        regions = label(signal > peak / 2, connectivity=2)
        light = ndimage.sum_labels(signal, regions, np.arange(1, regions.max() + 1))
        rows, columns = np.nonzero(regions == 1 + int(np.argmax(light)))
        weight = signal[rows, columns]
        row = top + round(float(np.average(rows, weights=weight)))
        column = left + round(float(np.average(columns, weights=weight)))
    if not found:
        return Spot(pixels.shape[0] // 2, pixels.shape[1] // 2, False)
    return Spot(row, column, True)


def _median_of_nine(image: np.ndarray) -> np.ndarray:
    """3 × 3 median, the border repeated: the middle one of the largest low, the middle middle and the smallest high of
    three sorted rows. Equal to that of `scipy.ndimage`, whose sorting took most of the time of cropping."""
    wide = np.pad(image, 1, mode="edge")
    height, width = image.shape
    rows = [_sorted(*(wide[i : i + height, j : j + width] for j in range(3))) for i in range(3)]
    low, middle, high = zip(*rows, strict=True)
    return _sorted(np.maximum.reduce(low), _sorted(*middle)[1], np.minimum.reduce(high))[1]


def _sorted(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Three images in ascending order, pixel by pixel."""
    low, high = np.minimum(a, b), np.maximum(a, b)
    middle, high = np.minimum(high, c), np.maximum(high, c)
    return np.minimum(low, middle), np.maximum(low, middle), high


def cut(pixels: np.ndarray, spot: Spot, side: int) -> np.ndarray:
    """Crop [side, side] as float32 with the spot at pixel (side//2, side//2); NaN beyond the frame's border."""
    crop = np.full((side, side), np.nan, np.float32)
    top, left = spot.row - side // 2, spot.column - side // 2
    rows = slice(max(top, 0), min(top + side, pixels.shape[0]))
    columns = slice(max(left, 0), min(left + side, pixels.shape[1]))
    crop[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = pixels[rows, columns]
    return crop


class Surround(NamedTuple):
    """Reduced copy of a whole frame [DN]: block means [block_row, block_column], row and column means."""

    block_mean: np.ndarray
    row_mean: np.ndarray
    column_mean: np.ndarray


def reduce_frame(pixels: np.ndarray) -> Surround:
    """Block means (sides of `BLOCK_PX`, the remainder at the right and lower border left out), row and column means."""
    side = min(BLOCK_PX, *pixels.shape)
    return Surround(
        _block_mean(pixels, side),
        pixels.mean(axis=1, dtype=np.float64),
        pixels.mean(axis=0, dtype=np.float64),
    )


def blocks_along(length: int, shape: tuple[int, int]) -> int:
    """Number of blocks of the reduced copy along a side of a frame of `shape`."""
    return length // min(BLOCK_PX, *shape)


def _block_mean(pixels: np.ndarray, side: int) -> np.ndarray:
    rows, columns = pixels.shape[0] // side, pixels.shape[1] // side
    trimmed = pixels[: rows * side, : columns * side]
    return trimmed.reshape(rows, side, columns, side).sum(axis=(1, 3), dtype=np.uint32) / side**2


def spots(dataset: Dataset) -> Iterator[tuple[tuple[int, ...], Frame, np.ndarray]]:
    """Index on the grid, frame and pixels of every spot, one at a time."""
    for index, frame in dataset.cells():
        yield index, frame, read(dataset, frame)
