"""Reading frames, and reducing what lies around a spot."""

from collections.abc import Iterator
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spotcheck.dataset.folder import Dataset, in_frames
from spotcheck.dataset.instrument import BadPixels, Instrument
from spotcheck.dataset.manifest import Frame
from spotcheck.errors import InputError
from spotcheck.io.formats import files
from spotcheck.io.formats.colour import MONOCHROME, Colour, extract_plane
from spotcheck.io.formats.page import PREVIEW_MESSAGE, Page

# Side of the blocks of the reduced copy [px]: 64 × 48 numbers for a frame of 12 Mpx.
BLOCK_PX = 64
# Runs of pages that a message lists; more would not be read.
MOST_RUNS = 5


class Probe(NamedTuple):
    """What the headers of all frames say: rows and columns [px], bits of a stored pixel, and remarks on pages that no
    row names."""

    shape: tuple[int, int]
    bits: int
    remarks: tuple[str, ...] = ()


def colour_of(instrument: Instrument) -> Colour:
    """Which plane of its frames a dataset takes."""
    return Colour(instrument.sensor.channel, instrument.sensor.bayer)


def pages_of(dataset: Dataset) -> dict[str, list[Page]]:
    """Pages of every file that the manifest names; each row's is among them. Raises `InputError`."""
    found: dict[str, list[Page]] = {}
    for frame in dataset.frames:
        if frame.file not in found:
            found[frame.file] = files.list_pages(dataset.folder / frame.file, frame.file, colour_of(dataset.instrument))
        count = len(found[frame.file])
        if frame.page >= count:
            raise InputError(f"{frame.label}: page is {frame.page}, but the file has {count}; pages count from 0")
        if found[frame.file][frame.page].preview:
            raise InputError(f"{frame.label}: {PREVIEW_MESSAGE}")
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
            f"{dataset.instrument.file_of('sensor.bit_depth')}: sensor.bit_depth and value_shift_bits ask for"
            f" {(sensor.bit_depth or 1) + sensor.value_shift_bits} bits, but the frames hold {first.bits};"
            f" together they must not exceed that"
        )
    crop = dataset.instrument.crop_px
    if dataset.spots and crop > min(first.shape):
        raise InputError(
            f"instrument.yaml: crop_px is {crop}, but the frames have {first.shape[1]} × {first.shape[0]} px;"
            f" it must be at most {min(first.shape)}"
        )
    bad_pixels(dataset.instrument.bad_pixels, first.shape, colour_of(dataset.instrument))
    return first


@lru_cache(maxsize=4)
def bad_pixels(named: BadPixels, shape: tuple[int, int], taken: Colour = MONOCHROME) -> np.ndarray | None:
    """Which pixels [rows, columns] of frames that are read with `shape` instrument.yaml names as bad; None where it
    names none. It names places on the sensor, of which Bayer frames are read a plane.

    Raises `InputError` for a mask of another size, or for a place beyond the frame.
    """
    shape = shape[0] * taken.step, shape[1] * taken.step
    out = np.zeros(shape, bool)
    if named.mask is not None:
        name = Path(named.mask).name
        size = files.list_pages(Path(named.mask), name)[0].shape
        if size != shape:
            raise InputError(
                f"instrument.yaml: key bad_pixels.mask names {name!r}, which has {size[1]} × {size[0]} px, but the"
                f" frames have {shape[1]} × {shape[0]} px; it must have their size"
            )
        out |= files.read_pixels(Path(named.mask), 0, name) != 0
    for key, axis, places in (
        ("columns", 1, named.columns),
        ("rows", 0, named.rows),
        ("pixels", 1, [x for x, _ in named.pixels]),
        ("pixels", 0, [y for _, y in named.pixels]),
    ):
        if beyond := [place for place in places if place >= shape[axis]]:
            raise InputError(
                f"instrument.yaml: key bad_pixels.{key} names {'xy'[1 - axis]} = {beyond[0]}, but the frames have"
                f" {shape[1]} × {shape[0]} px; it must be at most {shape[axis] - 1}"
            )
    out[:, list(named.columns)] = True
    out[list(named.rows)] = True
    out[[y for _, y in named.pixels], [x for x, _ in named.pixels]] = True
    out = extract_plane(out, taken)
    if out.all():
        raise InputError("instrument.yaml: key bad_pixels names every pixel of the frames; some must be left")
    return out if out.any() else None


def read(dataset: Dataset, frame: Frame) -> np.ndarray:
    """Image of a frame of a dataset: pixels [rows, columns] in DN, unsigned, shifted out of a left-aligned container.

    Raises `InputError` for a file that cannot be decoded or holds values above the bit depth.

    Examples
    --------
    >>> import spotcheck
    >>> dataset = spotcheck.read_dataset("my-frames")
    >>> image = spotcheck.read_image(dataset, dataset.spots[-1])
    >>> image.shape, image.dtype, int(image.max())
    ((96, 96), dtype('uint16'), 620)
    """
    pixels = files.read_pixels(dataset.folder / frame.file, frame.page, frame.label, colour_of(dataset.instrument))
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


def read_good(dataset: Dataset, frame: Frame) -> np.ndarray:
    """As `read`, where instrument.yaml names bad pixels as float32 with NaN in their place: not measured."""
    pixels = read(dataset, frame)
    own = dataset.instrument
    bad = bad_pixels(own.bad_pixels, (pixels.shape[0], pixels.shape[1]), colour_of(own))
    return pixels if bad is None else np.where(bad, np.float32(np.nan), pixels.astype(np.float32))


def readings(pixels: np.ndarray) -> np.ndarray:
    """The readings of all pixels that are measured [DN], unsigned: the image itself where no pixel is bad."""
    return pixels if pixels.dtype.kind == "u" else pixels[~np.isnan(pixels)].astype(np.uint16)


def full_scale(instrument: Instrument, container_bits: int) -> int:
    """Largest reading [DN]: of the converter where its depth is given, else of the container."""
    return 2 ** (instrument.sensor.bit_depth or container_bits - instrument.sensor.value_shift_bits) - 1


class Surround(NamedTuple):
    """Reduced copy of a whole frame [DN]: block means [block_row, block_column], row and column means."""

    block_mean: np.ndarray
    row_mean: np.ndarray
    column_mean: np.ndarray


def reduce_frame(pixels: np.ndarray) -> Surround:
    """Block means (sides of `BLOCK_PX`, the remainder at the right and lower border left out), row and column means."""
    side = min(BLOCK_PX, *pixels.shape)
    return Surround(
        block_mean(pixels, side),
        good_mean(pixels, axis=1),
        good_mean(pixels, axis=0),
    )


def good_mean(pixels: np.ndarray, axis: int | tuple[int, ...]) -> np.ndarray:
    """Mean along axes of all pixels that are not NaN; NaN where there are none."""
    if pixels.dtype.kind != "f":
        return np.asarray(pixels.mean(axis=axis, dtype=np.float64))
    count = np.count_nonzero(~np.isnan(pixels), axis=axis)
    total = np.nansum(pixels, axis=axis, dtype=np.float64)
    return np.divide(total, count, out=np.full(np.shape(total), np.nan), where=count > 0)


def blocks_along(length: int, shape: tuple[int, int]) -> int:
    """Number of blocks of the reduced copy along a side of a frame of `shape`."""
    return length // min(BLOCK_PX, *shape)


def block_mean(pixels: np.ndarray, side: int) -> np.ndarray:
    """Means of square blocks, the remainder at the right and lower border left out; NaN pixels do not count."""
    rows, columns = pixels.shape[0] // side, pixels.shape[1] // side
    blocks = pixels[: rows * side, : columns * side].reshape(rows, side, columns, side)
    if pixels.dtype.kind == "f":
        return good_mean(blocks, axis=(1, 3))
    return blocks.sum(axis=(1, 3), dtype=np.uint32) / side**2


def spots(dataset: Dataset) -> Iterator[tuple[tuple[int, ...], Frame, np.ndarray]]:
    """Index on the grid, frame and pixels of every spot, NaN where bad, one at a time."""
    for index, frame in dataset.cells():
        yield index, frame, read_good(dataset, frame)
