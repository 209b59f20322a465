"""TIFF files: tags that change the meaning of a number are obeyed or refused here, and tifffile decodes."""

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
# Start of a JPEG 2000 codestream (ISO/IEC 15444-1, annex A.5.1), and bytes within which it is found.
CODESTREAM, CODESTREAM_BYTES = b"\xff\x4f\xff\x51", 1024
# Steps along stored rows and columns by which Orientation (TIFF 6.0, section 8) has them shown, if rows stay rows.
ORIENTATION_STEPS = {1: (1, 1), 2: (1, -1), 3: (-1, -1), 4: (-1, 1)}
# Tags that make the stored value a nonlinear function of the reading.
NONLINEAR_TAGS = ("GrayResponseCurve", "TransferFunction", "LinearizationTable")
PIXEL_TYPES = (np.uint8, np.uint16, np.float32, np.float64)
# Bits of NewSubfileType (TIFF 6.0, section 8): 1 a reduced copy of another page, 4 a mask.
REDUCED_OR_MASK = 1 | 4
# Tags of the colour filter array (TIFF/EP): CFARepeatPatternDim and CFAPattern.
CFA_SIZE_TAG, CFA_PATTERN_TAG = 33421, 33422


def list_pages(path: Path) -> list[Page]:
    """Return the header of each page of a file. Raises `ImageError`, and what tifffile raises for a broken file."""
    offsets, length = _find_directories(path)
    with _open_tiff(path) as tiff:
        _check_imagej(tiff)
        pages = [_make_page(_read_directory(tiff, offsets, number), length) for number in range(len(offsets))]
        return pages if len(pages) > 1 else pages * _count_images(tiff, length)


def read_pixels(path: Path, page: int) -> np.ndarray:
    """Return a page [row, column] or [row, column, channel]. Raises as `list_pages` does."""
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
    if pixels.ndim == 3 and directory.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
        pixels = np.moveaxis(pixels, 0, -1)
    row_step, column_step = ORIENTATION_STEPS[_read_orientation(directory)]
    pixels = pixels[::row_step, ::column_step]
    if directory.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
        pixels = pixels.dtype.type(2**directory.bitspersample - 1) - pixels
    return np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("="))


@contextmanager
def open_directories(path: Path) -> Iterator[tuple[tifffile.TiffFile, Iterator[tifffile.TiffPage]]]:
    """Open a file to read the tags of each page.

    Yields
    ------
    (TiffFile, iterator of TiffPage)
        The open file, and the directory of each page.

    Raises
    ------
    ImageError
        If the chain of directories is broken.
    """
    offsets, _ = _find_directories(path)
    with _open_tiff(path) as tiff:
        yield tiff, (_read_directory(tiff, offsets, number) for number in range(len(offsets)))


def _open_tiff(path: Path) -> tifffile.TiffFile:
    """Open a file as plain TIFF: formats of makers may refer to other files or number pages in another way."""
    return tifffile.TiffFile(path, is_ome=False, is_lsm=False, is_ndpi=False, is_scanimage=False)


def _find_directories(path: Path) -> tuple[tuple[int, ...], int]:
    """Return the position of each directory [byte], one per page, and the length of the file [byte]."""
    status = path.stat()
    return _follow_directories(path, status.st_size, status.st_mtime_ns), status.st_size


@lru_cache(maxsize=64)
def _follow_directories(path: Path, length: int, _changed_ns: int) -> tuple[int, ...]:
    """Return the position of each directory (TIFF 6.0, section 2; BigTIFF), found once for all pages of a stack.

    tifffile follows a circle of directories for ever, and silently shortens a stack that is cut short.
    """
    offsets = dict[int, None]()
    with path.open("rb") as stream:
        start = stream.read(16)
        byte_order = "<" if start[:2] == b"II" else ">"
        # Type of the number of entries, bytes of an entry, type of a position, and place of the first position.
        count_type, entry_bytes, offset_type, first = ("H", 12, "I", 4) if 42 in start[2:4] else ("Q", 20, "Q", 8)

        def read_number(kind: str) -> int:
            size = struct.calcsize(byte_order + kind)
            return int(struct.unpack(byte_order + kind, stream.read(size))[0])

        try:
            stream.seek(first)
            while offset := read_number(offset_type):
                if offset in offsets:
                    raise ImageError("its pages lead in a circle; copy the file again")
                if offset >= length:
                    raise ImageError(CUT_SHORT)
                offsets[offset] = None
                stream.seek(offset)
                stream.seek(read_number(count_type) * entry_bytes, 1)
        except (struct.error, OverflowError, OSError):
            raise ImageError(CUT_SHORT) from None
    if not offsets:
        raise ImageError("the TIFF has no page; copy the file again")
    return tuple(offsets)


def _read_directory(tiff: tifffile.TiffFile, offsets: tuple[int, ...], number: int) -> tifffile.TiffPage:
    """Return the directory of a page."""
    tiff.filehandle.seek(offsets[number])
    return tifffile.TiffPage(tiff, index=number)


def _count_images(tiff: tifffile.TiffFile, length: int) -> int:
    """Return the number of images behind the only directory of a file of `length` bytes.

    ImageJ (above 4 GB), MetaMorph and tifffile may write one directory for a whole stack. Raises `ImageError` for a
    stack that is cut short.
    """
    series, first = tiff.series[0], tiff.pages.first
    if series.is_truncated and first.is_final:
        count = math.prod(series.shape) // math.prod(first.shape)
        check_length(first.dataoffsets[0] + count * first.nbytes, length)
        return count
    # A page that was taken out of a stack may keep its description; then no second image follows.
    stated = (tiff.imagej_metadata or {}).get("images", 1)
    if stated > 1 and length >= first.dataoffsets[0] + 2 * first.nbytes:
        raise ImageError(f"the stack of {stated} images (ImageDescription) is cut short; copy the file again")
    return 1


def _check_imagej(tiff: tifffile.TiffFile) -> None:
    """Raise `ImageError` for a calibration of values, by which ImageJ stores signed numbers in unsigned ones."""
    metadata = tiff.imagej_metadata or {}
    if (metadata.get("c0", 0), metadata.get("c1", 1)) != (0, 1) or metadata.get("cf", 0) not in (0, 20):
        raise ImageError(
            "its ImageDescription holds a calibration of values by ImageJ (c0, c1);"
            " remove it (Analyze, Calibrate, Function: None) and save it as unsigned integers"
        )


def _read_orientation(directory: tifffile.TiffPage) -> int:
    """Return the tag Orientation, 1 if it is missing or broken."""
    value = directory.tags.valueof("Orientation", 1)
    return int(value) if isinstance(value, int) else 1


def _format_tag(value: int) -> str:
    """Return the name of the value of a tag, or its number if tifffile has no name for it."""
    return str(getattr(value, "name", value))


def _make_page(directory: tifffile.TiffPage, length: int) -> Page:
    """Return the header of a page in a file of `length` bytes. Raises `ImageError`, which names the tag."""
    rows, columns = directory.imagelength, directory.imagewidth
    if isinstance(directory.subfiletype, int) and directory.subfiletype & REDUCED_OR_MASK:
        return Page((rows, columns), 0, preview=True)
    colours = _read_colours(directory)
    bits = _count_bits(directory, colours)
    _check_tags(directory, colours, bits)
    check_size(rows, columns)
    check_size(1, math.prod(directory.chunks))
    _check_chunks(directory, length)
    return Page((rows, columns), bits, colours=colours)


def _count_bits(directory: tifffile.TiffPage, colours: str) -> int:
    """Return the bits of a stored pixel, 0 for floating-point numbers. Raises `ImageError` for other pixels."""
    channels, dimensions = (3, 3) if colours == RGB else (1, 2)
    if directory.samplesperpixel != channels:
        raise ImageError(f"has {directory.samplesperpixel} channels (SamplesPerPixel); {ONE_CHANNEL}")
    if len(directory.shape) != dimensions:
        raise ImageError(
            f"has {len(directory.shape)} dimensions (ImageDepth, PhotometricInterpretation); {ONE_CHANNEL}"
        )
    bits = directory.bitspersample
    if directory.dtype not in PIXEL_TYPES or bits < 8:
        kind = f"{bits} bit" if directory.dtype is None else str(directory.dtype)
        raise ImageError(f"holds {kind} pixels (SampleFormat, BitsPerSample {bits}); {ONE_CHANNEL}")
    return 0 if directory.dtype.kind == "f" else bits


def _check_tags(directory: tifffile.TiffPage, colours: str, bits: int) -> None:
    """Raise `ImageError` for a tag by which stored values are not readings in rows."""
    white, black = tifffile.PHOTOMETRIC.MINISWHITE, tifffile.PHOTOMETRIC.MINISBLACK
    if directory.photometric not in (white, black) and not colours:
        kind = _format_tag(directory.photometric)
        raise ImageError(f"PhotometricInterpretation is {kind}; it must be MinIsBlack or MinIsWhite")
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
    """Return the colours of a page by PhotometricInterpretation and, behind filters, by CFAPattern (TIFF/EP)."""
    if directory.photometric == tifffile.PHOTOMETRIC.RGB:
        return RGB
    if directory.photometric != tifffile.PHOTOMETRIC.CFA:
        return GREY
    size, pattern = directory.tags.valueof(CFA_SIZE_TAG), directory.tags.valueof(CFA_PATTERN_TAG)
    is_bayer = size in (None, (2, 2)) and isinstance(pattern, tuple | bytes) and sorted(pattern) == [0, 1, 1, 2]
    return "".join("RGB"[colour] for colour in pattern) if is_bayer else CFA


def _check_chunks(directory: tifffile.TiffPage, length: int) -> None:
    """Raise `ImageError` if strips or tiles end beyond the file, are too few, or hold too few bytes."""
    chunks = list(zip(directory.dataoffsets, directory.databytecounts, strict=True))
    if len(chunks) != math.prod(directory.chunked) or not all(offset and size for offset, size in chunks):
        raise ImageError("the TIFF lacks strips or tiles (StripOffsets, StripByteCounts); copy the file again")
    if max(offset + size for offset, size in chunks) > length:
        raise ImageError(CUT_SHORT)
    if directory.compression in JPEG_2000:
        for offset, _ in chunks:
            _check_codestream(directory, offset)
    stored = sum(size for _, size in chunks)
    row_bits = directory.imagewidth * directory.samplesperpixel * directory.bitspersample
    needed = directory.imagelength * math.ceil(row_bits / 8)
    check_length(math.ceil(needed / COMPRESSION_RATIOS[directory.compression]), stored)


def _check_codestream(directory: tifffile.TiffPage, offset: int) -> None:
    """Raise `ImageError` if the JPEG 2000 at an offset claims more pixels than its strip or tile has.

    Its decoder would allocate the memory for them.
    """
    stream = directory.parent.filehandle
    stream.seek(offset)
    start = stream.read(CODESTREAM_BYTES)
    size_at = start.find(CODESTREAM) + 8
    columns, rows = (int.from_bytes(start[at : at + 4]) for at in (size_at, size_at + 4))
    if columns * rows > math.prod(directory.chunks):
        raise ImageError(f"holds a strip or tile that claims {columns} × {rows} px; copy the file again")
