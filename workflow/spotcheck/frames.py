"""Reading frames, finding the spot, cropping, and reducing what lies around it."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tifffile
from PIL import Image, UnidentifiedImageError
from scipy import ndimage
from skimage.measure import label

from spotcheck import pgm
from spotcheck.dataset import Dataset
from spotcheck.errors import InputError
from spotcheck.instrument import Instrument
from spotcheck.manifest import Frame

# Frames are the user's own: no size of theirs is an attack, and what is wrong with one is said in our own words.
Image.MAX_IMAGE_PIXELS = None
logging.getLogger("tifffile").setLevel(logging.CRITICAL)

# Side of the blocks of the reduced copy [px]: 64 × 48 numbers for a frame of 12 Mpx.
BLOCK_PX = 64
# Side of the blocks in which the light is first looked for [px].
SEARCH_PX = 16
# A spot must stand out of the noise of single pixels by this factor. The largest of 1e5 medians of nine reaches 1.9;
# where a black level of 0 cuts half of the noise away, its estimate comes out at 0.6 of it.
SPOT_OVER_NOISE = 6.0
# Firm light is the least of four or five readings, to which noise hardly lends anything: where black cuts half of it
# away and its estimate is 0.4 of it, this is reached once in 1e4 frames of 12 Mpx, elsewhere never.
FIRM_OVER_NOISE = 7.0
# Side of the first window in blocks: a block and its eight neighbours, and half a block each way for the spot's flank.
WINDOW_BLOCKS = 4
# Nor is anything fainter than this a spot: where rounding hides the noise, its estimate is 0.
FAINTEST_DN = 2.5


class Probe(NamedTuple):
    """What a file's header says of one page."""

    shape: tuple[int, int]
    bits: int


def probe(path: Path, page: int, name: str) -> Probe:
    """Shape [rows, columns] and container bits (8 or 16) of a page, from the header alone.

    Raises `InputError` for a file that is cut short, is no image, or holds anything but one unsigned channel.
    """
    wanted = "it must be one channel of 8 or 16 bit unsigned integers"
    if path.suffix.lower() in (".tif", ".tiff"):
        try:
            with tifffile.TiffFile(path) as tiff:
                if page >= len(tiff.pages):
                    count = len(tiff.pages)
                    raise InputError(f"{name}: page is {page}, but the file has {count}; pages count from 0")
                found = tiff.pages[page]
                shape, dtype = found.shape, found.dtype
                ends = [o + n for o, n in zip(found.dataoffsets, found.databytecounts, strict=True)]
        except (tifffile.TiffFileError, ValueError, KeyError, IndexError, TypeError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{name}: cannot be read as TIFF, perhaps cut short; copy the file again") from None
        if not ends or max(ends) > path.stat().st_size:
            raise InputError(f"{name}: the TIFF is cut short; copy the file again")
        if len(shape) != 2:
            raise InputError(f"{name}: has {getattr(found.keyframe, 'samplesperpixel', shape[-1])} channels; {wanted}")
        if dtype not in (np.uint8, np.uint16):
            raise InputError(f"{name}: holds {dtype} pixels; {wanted}")
        return Probe(shape, dtype.itemsize * 8)
    if page:
        raise InputError(f"{name}: only TIFF has pages; page must be 0 or blank")
    try:
        if path.suffix.lower() == ".pgm":
            found_pgm = pgm.header(path)
            return Probe((found_pgm.rows, found_pgm.columns), found_pgm.bits)
        with Image.open(path) as image:
            mode, (columns, rows) = image.mode, image.size
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError):
        raise InputError(f"{name}: cannot be read as an image, perhaps cut short; copy the file again") from None
    if mode not in ("L", "I;16", "I;16B"):
        raise InputError(f"{name}: has pixels of kind {mode}; {wanted}")
    return Probe((rows, columns), 8 if mode == "L" else 16)


def probe_all(dataset: Dataset) -> Probe:
    """Probe of every frame of a dataset; they must agree, and hold a crop. Raises `InputError`."""
    first: Probe | None = None
    for frame in dataset.frames:
        found = probe(dataset.folder / frame.file, frame.page, frame.label)
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
        if not all(found.shape):
            raise InputError(f"{frame.label}: has no pixels; copy the file again")
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
    path = dataset.folder / frame.file
    try:
        if path.suffix.lower() in (".tif", ".tiff"):
            pixels = tifffile.imread(path, key=frame.page)
        elif path.suffix.lower() == ".pgm":
            pixels = pgm.read(path)
        else:
            with Image.open(path) as image:
                pixels = np.asarray(image)
    except (OSError, ValueError, SyntaxError, tifffile.TiffFileError, RuntimeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{frame.label}: cannot be decoded ({reason}); copy the file again") from None
    if pixels.dtype.newbyteorder("=") != pixels.dtype:
        pixels = pixels.astype(pixels.dtype.newbyteorder("="))
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


class _Light(NamedTuple):
    """What a window shows of a spot: its pixel, and the peak over the frame's background and over the window's own
    [DN]."""

    spot: Spot
    peak: float
    contrast: float


def light_centroid(pixels: np.ndarray, window_px: int) -> Spot:
    """Centroid of the light above half a robust maximum, indifferent to isolated hot pixels, stuck rows and columns.

    The spot is looked for around the block that holds most light, and the 3 × 3 median takes isolated pixels away. A
    spot much smaller than a block may stand back there, and the median flattens one narrower than its nine pixels:
    where the block shows nothing, the spot is where light is firmest. Background is the median of the frame, sampled.
    `found` is False when nothing stands out of the noise: then the place is the frame's centre.
    """
    square, firm = _firm(pixels)
    background = float(np.median(pixels[::8, ::8]))
    # Differences of neighbours see the noise alone, also where a black level of 0 cuts half of it away.
    noise = float(np.median(np.abs(pixels[::4, :-1:8].astype(float) - pixels[::4, 1::8]))) / 0.954
    enough = max(SPOT_OVER_NOISE * noise, FAINTEST_DN)
    most = _centroid(pixels, _brightest_block(square), window_px, background, enough)
    row, column = map(int, np.unravel_index(np.argmax(firm), firm.shape))
    height = float(firm[row, column]) - background
    if most is not None and (most.contrast > enough or 2 * most.peak > height):
        return most.spot
    if height <= max(FIRM_OVER_NOISE * noise, FAINTEST_DN):
        return Spot(pixels.shape[0] // 2, pixels.shape[1] // 2, False) if most is None else most.spot
    own = _centroid(pixels, (row, column), window_px, background, enough)
    return Spot(row, column, True) if own is None or 2 * own.peak < height else own.spot


def _firm(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least reading of the square of 2 × 2 from each pixel on [rows − 1, columns − 1], and, of a square or a cross
    of five, the larger one [the same, of the square's first pixel]: what no isolated pixel, pair, row or column makes
    large, and of a spot of σ 0.7 px leaves a fifth of the peak at least."""
    down = np.minimum(pixels[:-1, :], pixels[1:, :])
    square = np.minimum(down[:, :-1], down[:, 1:])
    firm = square.copy()
    if min(pixels.shape) > 2:
        across = np.minimum(pixels[1:-1, :-2], pixels[1:-1, 2:])
        cross = np.minimum(np.minimum(down[:-1, 1:-1], pixels[2:, 1:-1]), across)
        np.maximum(firm[1:, 1:], cross, out=firm[1:, 1:])
    return square, firm


def _brightest_block(square: np.ndarray) -> tuple[int, int]:
    """Row and column of the middle of the block of `SEARCH_PX` that, with its neighbours, holds most light."""
    side = min(SEARCH_PX, *square.shape)
    rest = [(0, -length % side) for length in square.shape]
    sums = _block_mean(np.pad(square, rest, mode="edge"), side)
    sums = ndimage.uniform_filter(sums, 3, mode="nearest") if min(sums.shape) > 3 else sums
    block_row, block_column = np.unravel_index(np.argmax(sums), sums.shape)
    return int(block_row) * side + side // 2, int(block_column) * side + side // 2


def _centroid(
    pixels: np.ndarray, place: tuple[int, int], window_px: int, background: float, enough: float
) -> _Light | None:
    """Centroid of the light above half of the peak in a window around a place [row, column]; None where no peak is
    `enough` [DN].

    Twice: a first window may cut a spot that is wider than the block that found it. It is wide enough for a spot
    anywhere in that block and in those beside it, which lent it their light, however small the crop.
    """
    row, column = place
    for side in (max(window_px, WINDOW_BLOCKS * SEARCH_PX), window_px):
        top, left = max(row - side // 2, 0), max(column - side // 2, 0)
        window = _median_of_nine(pixels[top : top + side, left : left + side].astype(np.float32))
        signal = window - background
        peak = float(signal.max())
        if peak <= enough:
            return None
        regions = label(signal > peak / 2, connectivity=2)
        light = ndimage.sum_labels(signal, regions, np.arange(1, regions.max() + 1))
        rows, columns = np.nonzero(regions == 1 + int(np.argmax(light)))
        weight = signal[rows, columns]
        row = top + round(float(np.average(rows, weights=weight)))
        column = left + round(float(np.average(columns, weights=weight)))
    return _Light(Spot(row, column, True), peak, peak - float(np.median(signal)))


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
