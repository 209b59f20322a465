"""Reading of frames, masks of their pixels, and the reduction of frames to block, row and column means.

A frame is one row of the manifest: a file, or a page of a file that holds a stack. Bad pixels, which instrument.yaml
names, and impossible readings are NaN in masked images. Impossible readings belong to pixels that were not measured:
lost packets, masks or overlays replaced them by a constant (see the module `impossible_readings`). On a colour sensor a
frame is one colour plane: the pixels behind one filter.
"""

from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.impossible_readings import ImpossibleReadings, find_impossible_readings
from spotcheck.dataset.instrument import BadPixels, Instrument
from spotcheck.dataset.manifest import Frame
from spotcheck.errors import InputError
from spotcheck.io.formats import files
from spotcheck.io.formats.colour import MONOCHROME, Colour, extract_plane
from spotcheck.io.formats.page import PREVIEW_MESSAGE, Page

# Side of the blocks of a reduced frame [px]: 64 × 48 numbers for a frame of 12 Mpx.
BLOCK_PX = 64
# Least share of good pixels in the best crop. A crop is ten standard deviations of the spot wide: a circle of radius
# two of them holds 86 % of the light and covers 13 % of the crop. An inverted mask of pixels and lines leaves less.
LEAST_GOOD_SHARE = 0.1
# Most runs of consecutive pages that a message lists.
MOST_RUNS = 5


class FrameFormat(NamedTuple):
    """The common format of all frames of a dataset."""

    shape: tuple[int, int]  # rows and columns [px]
    bits: int  # bits of a stored pixel
    remarks: tuple[str, ...] = ()  # remarks on pages that no row of the manifest names


class ReducedFrame(NamedTuple):
    """Means of a whole frame [DN]; NaN if all their pixels are bad."""

    block_mean: np.ndarray  # means of square blocks of at most `BLOCK_PX`, shape [block_row, block_column]
    row_mean: np.ndarray  # means of rows, shape [row]
    column_mean: np.ndarray  # means of columns, shape [column]


def check_formats(dataset: Dataset) -> FrameFormat:
    """Return the common format of all frames, read from the headers of their files.

    Raises
    ------
    InputError
        If a file cannot be read, frames differ in size or depth, or instrument.yaml does not fit them.
    """
    pages = _read_pages(dataset)
    remarks = _check_pages_without_row(dataset, pages)
    first_frame = dataset.frames[0]
    first_page = pages[first_frame.file][first_frame.page]
    rows, columns = first_page.shape
    for frame in dataset.frames:
        page = pages[frame.file][frame.page]
        if page.shape != first_page.shape:
            raise InputError(
                f"{frame.label}: {page.shape[1]} × {page.shape[0]} px, but {first_frame.label} has"
                f" {columns} × {rows} px; all frames of a dataset must have one size"
            )
        if page.bits != first_page.bits:
            raise InputError(
                f"{frame.label}: {page.bits} bit, but {first_frame.label} has {first_page.bits} bit;"
                f" all frames of a dataset must have one depth"
            )
    instrument = dataset.instrument
    # Without a bit depth, at least one bit must remain beside the unused low bits.
    declared_bits = (instrument.sensor.bit_depth or 1) + instrument.sensor.value_shift_bits
    if declared_bits > first_page.bits:
        raise InputError(
            f"{instrument.get_file_name('sensor.bit_depth')}: sensor.bit_depth and value_shift_bits ask for"
            f" {declared_bits} bits, but the frames hold {first_page.bits}; together they must not exceed that"
        )
    if dataset.spots and instrument.crop_px > min(rows, columns):
        raise InputError(
            f"instrument.yaml: crop_px is {instrument.crop_px}, but the frames have {columns} × {rows} px;"
            f" it must be at most {min(rows, columns)}"
        )
    is_bad = build_bad_pixel_mask(instrument.bad_pixels, first_page.shape, get_colour(instrument))
    if is_bad is not None:
        _check_good_region(is_bad, instrument)
    return FrameFormat(first_page.shape, first_page.bits, remarks)


def _check_good_region(is_bad: np.ndarray, instrument: Instrument) -> None:
    """Raise `InputError` if bad pixels leave no region in which a spot could be measured.

    `is_bad` is the mask [rows, columns] of `build_bad_pixel_mask`.
    """
    if np.mean(is_bad) <= 1 - LEAST_GOOD_SHARE:
        return
    side = min(instrument.crop_px, *is_bad.shape)
    # Regions that reach beyond the frame count what is outside as bad.
    good_share = ndimage.uniform_filter((~is_bad).astype(np.float32), side, mode="constant")
    if good_share.max() < LEAST_GOOD_SHARE:
        raise InputError(
            f"instrument.yaml: key bad_pixels leaves {np.count_nonzero(~is_bad)} of {is_bad.size} pixels, and nowhere"
            f" {100 * LEAST_GOOD_SHARE:g} % of a crop of {side} × {side} px; {_advise_on_mask(instrument.bad_pixels)}"
        )


def _advise_on_mask(bad_pixels: BadPixels) -> str:
    """Return what to do if nearly all pixels are bad: a mask may be inverted."""
    if bad_pixels.mask is None:
        return "name fewer columns, rows and pixels"
    return f"in {Path(bad_pixels.mask).name!r} good pixels must be 0: invert the mask if there they are bright"


def get_colour(instrument: Instrument) -> Colour:
    """Return the colour plane that is read from the frames of a dataset; `MONOCHROME` for frames without colours."""
    return Colour(instrument.sensor.channel, instrument.sensor.bayer)


def _read_pages(dataset: Dataset) -> dict[str, list[Page]]:
    """Return the page headers of each file of the manifest, by file.

    Raises `InputError` for a file that cannot be read, and for a row whose page does not exist or is a preview.
    """
    pages: dict[str, list[Page]] = {}
    for frame in dataset.frames:
        if frame.file not in pages:
            pages[frame.file] = files.list_pages(
                dataset.folder / frame.file, frame.file, get_colour(dataset.instrument)
            )
        count = len(pages[frame.file])
        if frame.page >= count:
            raise InputError(f"{frame.label}: page is {frame.page}, but the file has {count}; pages count from 0")
        if pages[frame.file][frame.page].preview:
            raise InputError(f"{frame.label}: {PREVIEW_MESSAGE}")
    return pages


def _check_pages_without_row(dataset: Dataset, pages: dict[str, list[Page]]) -> tuple[str, ...]:
    """Return one remark on each stack in frames/ with pages that no row names; `pages` are those of each file.

    Raises `InputError` if only the first page of a stack has a row: the user may not know that it is a stack.
    """
    named_pages = {(frame.file, frame.page) for frame in dataset.frames}
    remarks = []
    for file, file_pages in pages.items():
        image_pages = (page_number for page_number, page in enumerate(file_pages) if not page.preview)
        unnamed = [page_number for page_number in image_pages if (file, page_number) not in named_pages]
        if not unnamed or Path(file).parts[0] != "frames":
            continue
        plural, verb = ("s", "are") if len(unnamed) > 1 else ("", "is")
        remark = f"{file}: page{plural} {_format_runs(unnamed)} {verb} named by no row of manifest.csv"
        if not any((file, page_number) in named_pages for page_number in range(1, len(file_pages))):
            raise InputError(f"{remark}; add a row with its page for each, or move the file out of frames/")
        remarks.append(remark)
    return tuple(remarks)


def _format_runs(numbers: list[int]) -> str:
    """Return ascending numbers as text, consecutive ones as a run: `1 to 8, 11`."""
    # Consecutive numbers have a constant difference from their positions in the list.
    runs = [[number for _, number in run] for _, run in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0])]
    texts = [f"{run[0]} to {run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs]
    return ", ".join(texts if len(texts) <= MOST_RUNS else [*texts[:MOST_RUNS], "…"])


@lru_cache(maxsize=4)
def build_bad_pixel_mask(
    bad_pixels: BadPixels, shape: tuple[int, int], colour: Colour = MONOCHROME
) -> np.ndarray | None:
    """Return the mask of bad pixels of a frame.

    Parameters
    ----------
    bad_pixels : section of instrument.yaml, in pixels of the files from 0.
    shape : rows and columns of a frame [px]; of a Bayer sensor those of one colour plane, half of those of the file.
    colour : colour plane that is read from the frames.

    Returns
    -------
    array or None
        Boolean, of `shape`, True where bad; None if no pixel is bad.

    Raises
    ------
    InputError
        If the mask image has another size, a pixel lies outside the frame, or all pixels are bad.
    """
    rows, columns = shape[0] * colour.step, shape[1] * colour.step
    is_bad = np.zeros((rows, columns), bool)
    if bad_pixels.mask is not None:
        name = Path(bad_pixels.mask).name
        mask_shape = files.list_pages(Path(bad_pixels.mask), name)[0].shape
        if mask_shape != is_bad.shape:
            raise InputError(
                f"instrument.yaml: key bad_pixels.mask names {name!r}, which has {mask_shape[1]} × {mask_shape[0]} px,"
                f" but the frames have {columns} × {rows} px; it must have their size"
            )
        is_bad |= files.read_pixels(Path(bad_pixels.mask), 0, name) != 0
    pixels_x, pixels_y = [x for x, _ in bad_pixels.pixels], [y for _, y in bad_pixels.pixels]
    for key, axis, size, coordinates in (
        ("columns", "x", columns, bad_pixels.columns),
        ("rows", "y", rows, bad_pixels.rows),
        ("pixels", "x", columns, pixels_x),
        ("pixels", "y", rows, pixels_y),
    ):
        first_outside = next((coordinate for coordinate in coordinates if coordinate >= size), None)
        if first_outside is not None:
            raise InputError(
                f"instrument.yaml: key bad_pixels.{key} names {axis} = {first_outside}, but the frames have"
                f" {columns} × {rows} px; it must be at most {size - 1}"
            )
    is_bad[:, list(bad_pixels.columns)] = True
    is_bad[list(bad_pixels.rows)] = True
    is_bad[pixels_y, pixels_x] = True
    is_bad = extract_plane(is_bad, colour)
    if is_bad.all():
        raise InputError(
            "instrument.yaml: key bad_pixels names every pixel of the frames; some must be left:"
            f" {_advise_on_mask(bad_pixels)}"
        )
    return is_bad if is_bad.any() else None


def read_image(dataset: Dataset, frame: Frame) -> np.ndarray:
    """Return the pixels of a frame [rows, columns] in DN, as uint8 or uint16.

    Readings that are stored left-aligned are shifted to the right by `sensor.value_shift_bits`.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    frame : Frame
        One of its frames.

    Raises
    ------
    InputError
        If the file cannot be decoded, or has values above the bit depth.

    Examples
    --------
    >>> import spotcheck
    >>> dataset = spotcheck.read_dataset("my-frames")
    >>> image = spotcheck.read_image(dataset, dataset.spots[-1])
    >>> image.shape, image.dtype, int(image.max())
    ((96, 96), dtype('uint16'), 620)
    """
    pixels = files.read_pixels(dataset.folder / frame.file, frame.page, frame.label, get_colour(dataset.instrument))
    sensor = dataset.instrument.sensor
    if sensor.value_shift_bits:
        if (pixels & (2**sensor.value_shift_bits - 1)).any():
            raise InputError(
                f"{frame.label}: holds values with low bits set, but sensor.value_shift_bits is"
                f" {sensor.value_shift_bits}; it must be 0 for values that are not left-aligned"
            )
        pixels = pixels >> sensor.value_shift_bits
    highest = int(pixels.max())
    if sensor.bit_depth is not None and highest > 2**sensor.bit_depth - 1:
        raise InputError(
            f"{frame.label}: holds the value {highest}, above the {2**sensor.bit_depth - 1} of"
            f" sensor.bit_depth {sensor.bit_depth}; correct the bit depth, or set sensor.value_shift_bits"
        )
    return pixels


def read_masked_image(dataset: Dataset, frame: Frame) -> np.ndarray:
    """Return the pixels of a frame in DN, with NaN for bad pixels and impossible readings.

    Parameters
    ----------
    dataset : the dataset.
    frame : one of its frames.

    Returns
    -------
    array
        Shape [rows, columns]: float32 if a pixel is NaN, otherwise uint8 or uint16 as `read_image` returns them.

    Raises
    ------
    InputError
        As `read_image` does.
    """
    return read_checked_image(dataset, frame)[0]


def read_checked_image(dataset: Dataset, frame: Frame) -> tuple[np.ndarray, ImpossibleReadings]:
    """Return the pixels of a frame as `read_masked_image` does, and its impossible readings.

    Readings that were cut off at a threshold (`ImpossibleReadings.is_cut`) do not become NaN. If the camera has a dead
    zone, all its frames have such readings, and the verdict detects the dead zone by them. `read_measured_image` and
    the fits mask them.
    """
    pixels = read_image(dataset, frame)
    rows, columns = pixels.shape
    instrument = dataset.instrument
    is_bad = build_bad_pixel_mask(instrument.bad_pixels, (rows, columns), get_colour(instrument))
    impossible = find_impossible_readings(pixels, is_bad)
    is_masked = impossible.mask if is_bad is None else impossible.mask | is_bad
    return mask_readings(pixels, is_masked), impossible


def read_measured_image(dataset: Dataset, frame: Frame) -> np.ndarray:
    """Return the pixels of a frame as `read_masked_image` does, with NaN also where faint light was cut off."""
    pixels, impossible = read_checked_image(dataset, frame)
    return mask_readings(pixels, impossible.is_cut)


def mask_readings(pixels: np.ndarray, is_masked: np.ndarray) -> np.ndarray:
    """Return pixels [row, column] with NaN where `is_masked`, as float32; unchanged if no pixel is masked."""
    return np.where(is_masked, np.float32(np.nan), pixels.astype(np.float32)) if is_masked.any() else pixels


def select_good_readings(pixels: np.ndarray) -> np.ndarray:
    """Return the unsigned readings [DN] of the pixels that are not NaN, shape [pixel].

    An image of unsigned integers has no bad pixels and is returned unchanged [rows, columns].
    """
    return pixels if pixels.dtype.kind == "u" else pixels[~np.isnan(pixels)].astype(np.uint16)


def get_full_scale(instrument: Instrument, container_bits: int) -> int:
    """Return the largest possible reading [DN] of the converter.

    If its bit depth is not given, it is that of a stored pixel of `container_bits`, less the unused low bits.
    """
    return 2 ** (instrument.sensor.bit_depth or container_bits - instrument.sensor.value_shift_bits) - 1


def reduce_frame(pixels: np.ndarray) -> ReducedFrame:
    """Return block, row and column means of a frame [rows, columns] in DN; NaN pixels do not count."""
    side = min(BLOCK_PX, *pixels.shape)
    return ReducedFrame(
        average_blocks(pixels, side), average_good_pixels(pixels, axis=1), average_good_pixels(pixels, axis=0)
    )


def average_good_pixels(pixels: np.ndarray, axis: int | tuple[int, ...]) -> np.ndarray:
    """Return the float64 means along axes of an array of any shape, unsigned or float; NaN pixels do not count.

    A mean of NaN pixels alone is NaN, without a warning.
    """
    if pixels.dtype.kind != "f":
        return np.asarray(pixels.mean(axis=axis, dtype=np.float64))
    count = np.count_nonzero(~np.isnan(pixels), axis=axis)
    total = np.nansum(pixels, axis=axis, dtype=np.float64)
    return np.divide(total, count, out=np.full(np.shape(total), np.nan), where=count > 0)


def count_blocks(length: int, shape: tuple[int, int]) -> int:
    """Return the number of blocks along a side of `length` px of a reduced frame of `shape` (rows, columns)."""
    return length // min(BLOCK_PX, *shape)


def average_blocks(pixels: np.ndarray, side: int) -> np.ndarray:
    """Return the means of square blocks; NaN pixels do not count.

    Incomplete blocks at the right and lower border are dropped.

    Parameters
    ----------
    pixels : readings [rows, columns] in any unit, unsigned or float.
    side : side of a block [px].

    Returns
    -------
    array
        float64, shape [rows // side, columns // side]; NaN where all pixels of a block are.
    """
    rows, columns = pixels.shape[0] // side, pixels.shape[1] // side
    blocks = pixels[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return average_good_pixels(blocks, axis=(1, 3))
