"""TIFF files: tags that change the meaning of a number are obeyed or refused here, and tifffile decodes.

A directory (image file directory) is the list of tags of a page. Its pixels are stored in chunks: strips or tiles.
"""

import logging
import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import numpy as np
import tifffile

from spotcheck.io.formats.page import (
    CFA,
    DEFLATE_RATIO,
    GREY,
    ONE_CHANNEL,
    PREVIEW_MESSAGE,
    RGB,
    ImageError,
    Page,
    check_length,
    check_size,
)

# Messages about broken files are those of `ImageError`.
logging.getLogger("tifffile").setLevel(logging.CRITICAL)

SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
CUT_SHORT = "the TIFF is cut short; copy the file again"
JPEG_2000 = (33003, 33004, 33005, 34712)
# Lossless compressions, and the largest ratio of unpacked to packed bytes of each; others, such as JPEG, alter pixels.
COMPRESSION_RATIOS = {
    1: 1,  # none
    5: 2560,  # LZW: strings of 3838 in 12 bits
    8: DEFLATE_RATIO,
    32946: DEFLATE_RATIO,
    32773: 64,  # PackBits: 128 in two
    34925: 10_000,  # LZMA: some 7000 for zeros
    34926: 32_768,  # Zstandard: blocks of 128 KiB in four
    50000: 32_768,
    **dict.fromkeys(JPEG_2000, math.inf),  # its codestream states the size, which is checked
}
# Start of a JPEG 2000 codestream (ISO/IEC 15444-1, annex A.5.1), bytes within which it is found, and distance [byte]
# from it to the numbers of columns and rows, of four bytes each.
CODESTREAM, CODESTREAM_BYTES, SIZE_OFFSET = b"\xff\x4f\xff\x51", 1024, 8
# Steps along stored rows and columns that give the image, by Orientation (TIFF 6.0, section 8). Orientations 5 to 8,
# which exchange rows and columns, are refused.
ORIENTATION_STEPS = {1: (1, 1), 2: (1, -1), 3: (-1, -1), 4: (-1, 1)}
# Tags that make the stored value a nonlinear function of the reading.
NONLINEAR_TAGS = ("GrayResponseCurve", "TransferFunction", "LinearizationTable")
# Types of stored pixels that are read.
PIXEL_TYPES = (np.uint8, np.uint16, np.float32, np.float64)
# Bits of NewSubfileType (TIFF 6.0, section 8): 1 a reduced copy of another page, 4 a mask.
REDUCED_OR_MASK = 1 | 4
# Tags of the colour filter array (TIFF/EP): CFARepeatPatternDim and CFAPattern.
CFA_SIZE_TAG, CFA_PATTERN_TAG = 33421, 33422


def list_pages(path: Path) -> list[Page]:
    """Return the header of each page of a file. Raises `ImageError`, or what tifffile raises for a broken file."""
    offsets, length = _find_directories(path)
    with _open_tiff(path) as tiff:
        _check_imagej(tiff)
        pages = [_make_page(_read_directory(tiff, offsets, page_number), length) for page_number in range(len(offsets))]
        # All images behind a single directory have the same header.
        return pages if len(pages) > 1 else pages * _count_images(tiff, length)


def read_pixels(path: Path, page: int) -> np.ndarray:
    """Return the pixels of a page [row, column] or [row, column, channel]. Raises as `list_pages` does."""
    offsets, length = _find_directories(path)
    has_directory = len(offsets) > 1 or page == 0
    with _open_tiff(path) as tiff:
        directory = _read_directory(tiff, offsets, page if has_directory else 0)
        if _make_page(directory, length).preview:
            raise ImageError(PREVIEW_MESSAGE)
        if has_directory:
            pixels = directory.asarray(maxworkers=1)
        else:
            # Later images of a stack with a single directory follow the first one without a gap.
            stored_type = np.dtype(directory.dtype).newbyteorder(tiff.byteorder)
            start = directory.dataoffsets[0] + page * directory.nbytes
            pixels = np.fromfile(path, stored_type, math.prod(directory.shape), offset=start).reshape(directory.shape)
    # 1. Channels that are stored one after the other become the last axis.
    if pixels.ndim == 3 and directory.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
        pixels = np.moveaxis(pixels, 0, -1)
    # 2. Rows run downwards and columns to the right.
    row_step, column_step = ORIENTATION_STEPS[_read_orientation(directory)]
    pixels = pixels[::row_step, ::column_step]
    # 3. Larger numbers are brighter.
    if directory.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
        pixels = pixels.dtype.type(2**directory.bitspersample - 1) - pixels
    return np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("="))


@contextmanager
def open_directories(path: Path) -> Iterator[tuple[tifffile.TiffFile, Iterator[tifffile.TiffPage]]]:
    """Open a file in a `with` block to read the tags of each page.

    Yields
    ------
    (TiffFile, iterator of TiffPage)
        The open file, and an iterator that reads the directories one after the other. A stack with a single directory
        (`_count_images`) yields that one alone.

    Raises
    ------
    ImageError
        If the chain of directories is broken.
    """
    offsets, _ = _find_directories(path)
    with _open_tiff(path) as tiff:
        yield tiff, (_read_directory(tiff, offsets, page_number) for page_number in range(len(offsets)))


def _open_tiff(path: Path) -> tifffile.TiffFile:
    """Return a file opened as plain TIFF: formats of makers may refer to other files or number pages in another way."""
    return tifffile.TiffFile(path, is_ome=False, is_lsm=False, is_ndpi=False, is_scanimage=False)


def _find_directories(path: Path) -> tuple[tuple[int, ...], int]:
    """Return the position of each directory [byte] in the order of the pages, and the length of the file [byte]."""
    status = path.stat()
    return _follow_directories(path, status.st_size, status.st_mtime_ns), status.st_size


@lru_cache(maxsize=64)
def _follow_directories(path: Path, length: int, _changed_ns: int) -> tuple[int, ...]:
    """Return the position of each directory [byte] in a file of `length` bytes (TIFF 6.0, section 2; BigTIFF).

    tifffile follows a circle of directories for ever, and silently shortens a stack that is cut short. The result is
    cached for all pages of a stack; the time of change is a key of the cache. Raises `ImageError`.
    """
    # The keys are the positions in their order, which are also looked up.
    offsets = dict[int, None]()
    with path.open("rb") as stream:
        signature = stream.read(4)
        byte_order = "<" if signature[:2] == b"II" else ">"
        # Types (of `struct`) of the number of entries and of a position, bytes of an entry, and place of the first
        # position, in classic TIFF (version 42) and BigTIFF.
        is_classic = 42 in signature[2:]
        count_type, offset_type, entry_bytes, first_place = ("H", "I", 12, 4) if is_classic else ("Q", "Q", 20, 8)

        def read_number(struct_type: str) -> int:
            """Return the next number of the file. Raises `struct.error` at its end."""
            size = struct.calcsize(byte_order + struct_type)
            return int(struct.unpack(byte_order + struct_type, stream.read(size))[0])

        try:
            stream.seek(first_place)
            while offset := read_number(offset_type):
                if offset in offsets:
                    raise ImageError("its pages lead in a circle; copy the file again")
                if offset >= length:
                    raise ImageError(CUT_SHORT)
                offsets[offset] = None
                # The position of the next directory follows behind the entries of this one.
                stream.seek(offset)
                stream.seek(read_number(count_type) * entry_bytes, 1)
        except (struct.error, OverflowError, OSError):
            raise ImageError(CUT_SHORT) from None
    if not offsets:
        raise ImageError("the TIFF has no page; copy the file again")
    return tuple(offsets)


def _read_directory(tiff: tifffile.TiffFile, offsets: tuple[int, ...], number: int) -> tifffile.TiffPage:
    """Return the directory of the page with this number; `offsets` are the positions of all directories [byte]."""
    tiff.filehandle.seek(offsets[number])
    return tifffile.TiffPage(tiff, index=number)


def _count_images(tiff: tifffile.TiffFile, length: int) -> int:
    """Return the number of images behind the only directory of a file of `length` bytes.

    ImageJ (above 4 GB), MetaMorph and tifffile may write one directory for a whole stack. Raises `ImageError` for a
    stack that is cut short.
    """
    series, directory = tiff.series[0], tiff.pages.first
    # tifffile calls a series truncated if its single directory describes several images, and a directory final if its
    # pixels are stored uncompressed in one piece, so that further images can follow.
    if series.is_truncated and directory.is_final:
        count = math.prod(series.shape) // math.prod(directory.shape)
        check_length(directory.dataoffsets[0] + count * directory.nbytes, length)
        return count
    # A page that was taken out of a stack may keep its description; then no second image follows.
    stated_count = (tiff.imagej_metadata or {}).get("images", 1)
    if stated_count > 1 and length >= directory.dataoffsets[0] + 2 * directory.nbytes:
        raise ImageError(f"the stack of {stated_count} images (ImageDescription) is cut short; copy the file again")
    return 1


def _check_imagej(tiff: tifffile.TiffFile) -> None:
    """Raise `ImageError` if ImageJ's description holds a calibration: a function from stored numbers to values.

    ImageJ stores signed integers as unsigned ones by such a function.
    """
    metadata = tiff.imagej_metadata or {}
    # ImageJ numbers its functions by cf: 0 is the straight line c0 + c1 · stored number, and 20 is no calibration.
    if (metadata.get("c0", 0), metadata.get("c1", 1)) != (0, 1) or metadata.get("cf", 0) not in (0, 20):
        raise ImageError(
            "its ImageDescription holds a calibration of values by ImageJ (c0, c1);"
            " remove it (Analyze, Calibrate, Function: None) and save it as unsigned integers"
        )


def _read_orientation(directory: tifffile.TiffPage) -> int:
    """Return the value of the tag Orientation; 1 (rows downwards, columns to the right) if it is missing or broken."""
    value = directory.tags.valueof("Orientation", 1)
    return int(value) if isinstance(value, int) else 1


def _format_tag(value: int) -> str:
    """Return the name of the value of a tag, or its number if tifffile has no name for it."""
    return str(getattr(value, "name", value))


def _make_page(directory: tifffile.TiffPage, length: int) -> Page:
    """Return the header of a page in a file of `length` bytes, after checks that its pixels are readings.

    The header of a preview or mask, which is never decoded, is returned without these checks and with 0 bits. Raises
    `ImageError` for any other page that fails a check; the message names the wrong tag if there is one.
    """
    rows, columns = directory.imagelength, directory.imagewidth
    if isinstance(directory.subfiletype, int) and directory.subfiletype & REDUCED_OR_MASK:
        return Page((rows, columns), 0, preview=True)
    colours = _read_colours(directory)
    bits = _count_bits(directory, colours)
    _check_tags(directory, colours, bits)
    check_size(rows, columns)
    # A strip or tile is unpacked as a whole and may be larger than the page.
    check_size(1, math.prod(directory.chunks))
    _check_chunks(directory, length)
    return Page((rows, columns), bits, colours=colours)


def _count_bits(directory: tifffile.TiffPage, colours: str) -> int:
    """Return the bits of a sample, 0 for floating-point numbers. Raises `ImageError` for pixels of other types.

    `colours` is that of `Page`: RGB must have three channels, all other pages one.
    """
    channels, dimensions = (3, 3) if colours == RGB else (1, 2)
    if directory.samplesperpixel != channels:
        raise ImageError(f"has {directory.samplesperpixel} channels (SamplesPerPixel); {ONE_CHANNEL}")
    if len(directory.shape) != dimensions:
        raise ImageError(
            f"has {len(directory.shape)} dimensions (ImageDepth, PhotometricInterpretation); {ONE_CHANNEL}"
        )
    bits = directory.bitspersample
    if directory.dtype not in PIXEL_TYPES or bits < 8:
        type_name = f"{bits} bit" if directory.dtype is None else str(directory.dtype)
        raise ImageError(f"holds {type_name} pixels (SampleFormat, BitsPerSample {bits}); {ONE_CHANNEL}")
    return 0 if directory.dtype.kind == "f" else bits


def _check_tags(directory: tifffile.TiffPage, colours: str, bits: int) -> None:
    """Raise `ImageError` for a tag by which stored values are not readings in rows.

    `colours` and `bits` are those of `Page`; 0 bits stand for floating-point numbers.
    """
    white, black = tifffile.PHOTOMETRIC.MINISWHITE, tifffile.PHOTOMETRIC.MINISBLACK
    if directory.photometric not in (white, black) and not colours:
        photometric_name = _format_tag(directory.photometric)
        raise ImageError(f"PhotometricInterpretation is {photometric_name}; it must be MinIsBlack or MinIsWhite")
    if not bits and directory.photometric == white:
        raise ImageError("PhotometricInterpretation is MinIsWhite; of floating-point numbers it must be MinIsBlack")
    if directory.fillorder != 1:
        raise ImageError(f"FillOrder is {directory.fillorder}; it must be 1, the highest bit first")
    orientation = _read_orientation(directory)
    if orientation not in ORIENTATION_STEPS:
        raise ImageError(
            f"Orientation is {orientation}, by which rows are columns; save it with its rows as rows, Orientation 1"
        )
    for name in NONLINEAR_TAGS:
        if name in directory.tags:
            raise ImageError(f"the tag {name} makes its values a nonlinear function of the light; save it without")
    if directory.compression not in COMPRESSION_RATIOS:
        raise ImageError(
            f"Compression is {_format_tag(directory.compression)}, which may alter readings;"
            " save it uncompressed or by Deflate"
        )


def _read_colours(directory: tifffile.TiffPage) -> str:
    """Return the colours of a page: GREY, RGB, CFA, or the filters of a Bayer sensor such as "RGGB" (see `Page`).

    The tag PhotometricInterpretation decides, and for pixels behind colour filters the tag CFAPattern (TIFF/EP). If its
    pattern is missing or not that of a Bayer sensor, the result is CFA.
    """
    if directory.photometric == tifffile.PHOTOMETRIC.RGB:
        return RGB
    if directory.photometric != tifffile.PHOTOMETRIC.CFA:
        return GREY
    pattern_shape, pattern = directory.tags.valueof(CFA_SIZE_TAG), directory.tags.valueof(CFA_PATTERN_TAG)
    # Filters are numbered: red 0, green 1, blue 2.
    is_bayer = (
        pattern_shape in (None, (2, 2)) and isinstance(pattern, tuple | bytes) and sorted(pattern) == [0, 1, 1, 2]
    )
    return "".join("RGB"[colour] for colour in pattern) if is_bayer else CFA


def _check_chunks(directory: tifffile.TiffPage, length: int) -> None:
    """Raise `ImageError` if strips or tiles end beyond a file of `length` bytes, are too few, or hold too few bytes."""
    chunks = list(zip(directory.dataoffsets, directory.databytecounts, strict=True))
    if len(chunks) != math.prod(directory.chunked) or not all(offset and size for offset, size in chunks):
        raise ImageError("the TIFF lacks strips or tiles (StripOffsets, StripByteCounts); copy the file again")
    if max(offset + size for offset, size in chunks) > length:
        raise ImageError(CUT_SHORT)
    if directory.compression in JPEG_2000:
        for offset, _ in chunks:
            _check_codestream(directory, offset)
    stored_bytes = sum(size for _, size in chunks)
    row_bits = directory.imagewidth * directory.samplesperpixel * directory.bitspersample
    pixel_bytes = directory.imagelength * math.ceil(row_bits / 8)
    check_length(math.ceil(pixel_bytes / COMPRESSION_RATIOS[directory.compression]), stored_bytes)


def _check_codestream(directory: tifffile.TiffPage, offset: int) -> None:
    """Raise `ImageError` if the JPEG 2000 data at an offset [byte] claim more pixels than their strip or tile has.

    Their decoder would allocate the memory for these pixels.
    """
    stream = directory.parent.filehandle
    stream.seek(offset)
    first_bytes = stream.read(CODESTREAM_BYTES)
    size_start = first_bytes.find(CODESTREAM) + SIZE_OFFSET
    columns, rows = (int.from_bytes(first_bytes[start : start + 4]) for start in (size_start, size_start + 4))
    if columns * rows > math.prod(directory.chunks):
        raise ImageError(f"holds a strip or tile that claims {columns} × {rows} px; copy the file again")
