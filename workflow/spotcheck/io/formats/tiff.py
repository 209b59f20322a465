"""TIFF: tags that change what a number means are obeyed or refused here, tifffile decodes the rest."""

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
    PREVIEW,
    RGB,
    Page,
    Refused,
    check_length,
    check_size,
)

# What is wrong with a file is said in our own words.
logging.getLogger("tifffile").setLevel(logging.CRITICAL)

SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
JPEG_2000 = (33003, 33004, 33005, 34712)
# Compressions that give back what was stored (others, such as JPEG, alter readings), and how many bytes a byte of each
# makes at most, so that no file is believed to hold more.
LARGEST_GROWTH = {
    1: 1,  # none
    5: 2560,  # LZW: strings of 3838 in 12 bits
    8: DEFLATE_RATIO,
    32946: DEFLATE_RATIO,
    32773: 64,  # PackBits: 128 in two
    34925: 10_000,  # LZMA: some 7000 for zeros
    34926: 32_768,  # Zstandard: blocks of 128 KiB in four
    50000: 32_768,
    **dict.fromkeys(JPEG_2000, math.inf),  # which says itself how much it holds
}
# Start of a JPEG 2000 codestream (ISO/IEC 15444-1, annex A.5.1), and bytes in which it lies.
CODESTREAM, CODESTREAM_BYTES = b"\xff\x4f\xff\x51", 1024
# How Orientation (TIFF 6.0, section 8) has the stored rows shown, where they stay rows.
TURNED = {1: (1, 1), 2: (1, -1), 3: (-1, -1), 4: (-1, 1)}
# Tags by which equal steps of a stored value are no equal steps of a reading.
BENT = ("GrayResponseCurve", "TransferFunction", "LinearizationTable")
# Numbers of a pixel that are decoded.
READ = (np.uint8, np.uint16, np.float32, np.float64)
# Kinds of NewSubfileType (TIFF 6.0, section 8): 1 a reduced copy of another page, 4 a mask.
REDUCED_OR_MASK = 1 | 4


def pages(path: Path) -> list[Page]:
    """Every page of a file. Raises `Refused`, and what tifffile raises for a broken file."""
    starts, length = _directories(path)
    with _opened(path) as tiff:
        _check_imagej(tiff)
        directories = (_directory(tiff, starts, page) for page in range(len(starts)))
        found = [_preview(page) or _page_of(page, length) for page in directories]
        if len(found) == 1:
            found *= _planes(tiff, length)
    return found


def read(path: Path, page: int) -> np.ndarray:
    """Pixels of a page, [rows, columns] or [rows, columns, colours]. Raises as `pages` does."""
    starts, length = _directories(path)
    with _opened(path) as tiff:
        directory = _directory(tiff, starts, page if len(starts) > 1 else 0)
        if _preview(directory):
            raise Refused(PREVIEW)
        _page_of(directory, length)
        if len(starts) > 1 or not page:
            pixels = directory.asarray(maxworkers=1)
        else:
            stored = np.dtype(directory.dtype).newbyteorder(tiff.byteorder)
            start = directory.dataoffsets[0] + page * directory.nbytes
            pixels = np.fromfile(path, stored, math.prod(directory.shape), offset=start).reshape(directory.shape)
    if pixels.ndim == 3 and directory.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
        pixels = np.moveaxis(pixels, 0, -1)
    down, right = TURNED[_tag(directory, "Orientation", 1)]
    pixels = pixels[::down, ::right]
    if directory.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
        pixels = pixels.dtype.type(2**directory.bitspersample - 1) - pixels
    return np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("="))


@contextmanager
def directories(path: Path) -> Iterator[tuple[tifffile.TiffFile, Iterator[tifffile.TiffPage]]]:
    """An open file and its directories one after another, for what they say beside the pixels. Raises `Refused`."""
    starts, _ = _directories(path)
    with _opened(path) as tiff:
        yield tiff, (_directory(tiff, starts, page) for page in range(len(starts)))


@contextmanager
def _opened(path: Path) -> Iterator[tifffile.TiffFile]:
    """An open file, whose makers' own formats are not followed into other files or other rules for pages."""
    with tifffile.TiffFile(path, is_ome=False, is_lsm=False, is_ndpi=False, is_scanimage=False) as tiff:
        yield tiff


def _directories(path: Path) -> tuple[tuple[int, ...], int]:
    """Where the directories of a file start [byte], one a page, and how long it is [byte]. Raises `Refused`."""
    status = path.stat()
    return _starts(path, status.st_size, status.st_mtime_ns), status.st_size


@lru_cache(maxsize=64)
def _starts(path: Path, length: int, _changed_ns: int) -> tuple[int, ...]:
    """Where the directories start (TIFF 6.0, section 2; BigTIFF), looked up once for all pages of a stack.

    tifffile follows pages that lead in a circle for ever, and ends a stack without a word where it is cut short.
    """
    found = dict[int, None]()
    with path.open("rb") as stream:
        start = stream.read(16)
        order = "<" if start[:2] == b"II" else ">"
        count_of, entry, place_of, first = ("H", 12, "I", 4) if 42 in start[2:4] else ("Q", 20, "Q", 8)

        def number(kind: str) -> int:
            return int(struct.unpack(order + kind, stream.read(struct.calcsize(order + kind)))[0])

        try:
            stream.seek(first)
            while at := number(place_of):
                if at in found:
                    raise Refused("its pages lead in a circle; copy the file again")
                if at >= length:
                    raise Refused("the TIFF is cut short; copy the file again")
                found[at] = None
                stream.seek(at)
                stream.seek(number(count_of) * entry, 1)
        except (struct.error, OverflowError, OSError):
            raise Refused("the TIFF is cut short; copy the file again") from None
    if not found:
        raise Refused("the TIFF has no page; copy the file again")
    return tuple(found)


def _directory(tiff: tifffile.TiffFile, starts: tuple[int, ...], page: int) -> tifffile.TiffPage:
    """The directory of a page."""
    tiff.filehandle.seek(starts[page])
    return tifffile.TiffPage(tiff, index=page)


def _planes(tiff: tifffile.TiffFile, length: int) -> int:
    """Pages that the one directory of a file of `length` bytes stands for: ImageJ above 4 GB, MetaMorph and tifffile
    may write one for a stack. Raises `Refused` for a stack that is cut short."""
    series, first = tiff.series[0], tiff.pages.first
    if series.is_truncated and first.is_final:
        count = math.prod(series.shape) // math.prod(first.shape)
        check_length(first.dataoffsets[0] + count * first.nbytes, length)
        return count
    # A single page that was taken out of a stack may keep its description, and has no second page behind it.
    stated = (tiff.imagej_metadata or {}).get("images", 1)
    if stated > 1 and length >= first.dataoffsets[0] + 2 * first.nbytes:
        raise Refused(f"the stack of {stated} images (ImageDescription) is cut short; copy the file again")
    return 1


def _check_imagej(tiff: tifffile.TiffFile) -> None:
    """Raise `Refused` for a scale of values: so ImageJ stores signed numbers in unsigned ones."""
    found = tiff.imagej_metadata or {}
    if (found.get("c0", 0), found.get("c1", 1)) != (0, 1) or found.get("cf", 0) not in (0, 20):
        raise Refused(
            "its ImageDescription holds a calibration of values by ImageJ (c0, c1);"
            " take it away (Analyze, Calibrate, Function: None) and save it as unsigned integers"
        )


def _tag(page: tifffile.TiffPage, name: str, default: int) -> int:
    """Value of a tag that holds one number."""
    value = page.tags.valueof(name, default)
    return int(value) if isinstance(value, int) else default


def _named(value: int) -> str:
    """Name of a tag's value, or its number where tifffile has no name for it."""
    return str(getattr(value, "name", value))


def _page_of(page: tifffile.TiffPage, length: int) -> Page:
    """What a directory says of its page, in a file of `length` bytes. Raises `Refused`, which names the tag."""
    colours = _colours(page)
    if page.samplesperpixel != (3 if colours == RGB else 1):
        raise Refused(f"has {page.samplesperpixel} channels (SamplesPerPixel); {ONE_CHANNEL}")
    if len(page.shape) != (3 if colours == RGB else 2):
        raise Refused(f"has {len(page.shape)} dimensions (ImageDepth, PhotometricInterpretation); {ONE_CHANNEL}")
    if page.dtype not in READ or page.bitspersample < 8:
        kind = f"{page.bitspersample} bit" if page.dtype is None else str(page.dtype)
        raise Refused(f"holds {kind} pixels (SampleFormat, BitsPerSample {page.bitspersample}); {ONE_CHANNEL}")
    is_floating = page.dtype.kind == "f"
    if page.photometric not in (0, 1) and not colours:
        raise Refused(f"PhotometricInterpretation is {_named(page.photometric)}; it must be MinIsBlack or MinIsWhite")
    if is_floating and page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
        raise Refused("PhotometricInterpretation is MinIsWhite, and floating-point numbers have no white to count from")
    if page.fillorder != 1:
        raise Refused(f"FillOrder is {page.fillorder}; it must be 1, the highest bit first")
    if (turn := _tag(page, "Orientation", 1)) not in TURNED:
        raise Refused(f"Orientation is {turn}, by which rows are columns; save it with its rows as rows, Orientation 1")
    for name in BENT:
        if name in page.tags:
            raise Refused(f"{name} says that equal steps of its values are no equal steps of light; save it without")
    if page.compression not in LARGEST_GROWTH:
        raise Refused(
            f"Compression is {_named(page.compression)}, which may alter readings; save it uncompressed or by Deflate"
        )
    rows, columns = page.imagelength, page.imagewidth
    check_size(rows, columns)
    check_size(1, math.prod(page.chunks))
    _check_parts(page, length)
    return Page((rows, columns), 0 if is_floating else page.bitspersample, colours=colours)


def _colours(page: tifffile.TiffPage) -> str:
    """Colours of a page by its PhotometricInterpretation: RGB, or filters as CFAPattern names them (TIFF/EP)."""
    if page.photometric == tifffile.PHOTOMETRIC.RGB:
        return RGB
    if page.photometric != tifffile.PHOTOMETRIC.CFA:
        return GREY
    size, filters = page.tags.valueof(33421), page.tags.valueof(33422)
    known = size in (None, (2, 2)) and isinstance(filters, tuple | bytes) and len(filters) == 4
    named = "".join("RGB"[own] if own in (0, 1, 2) else "?" for own in filters) if known else ""
    return named if sorted(named) == list("BGGR") else CFA


def _preview(page: tifffile.TiffPage) -> Page | None:
    """The page as a mere preview, whatever its pixels are, if its NewSubfileType says so."""
    is_one = isinstance(page.subfiletype, int) and page.subfiletype & REDUCED_OR_MASK
    return Page((page.imagelength, page.imagewidth), 0, True) if is_one else None


def _check_parts(page: tifffile.TiffPage, length: int) -> None:
    """Raise `Refused` where strips or tiles lie beyond the file, are too few, or hold less than they must."""
    parts = list(zip(page.dataoffsets, page.databytecounts, strict=True))
    if len(parts) != math.prod(page.chunked) or not all(at and size for at, size in parts):
        raise Refused("the TIFF lacks strips or tiles (StripOffsets, StripByteCounts); copy the file again")
    if max(at + size for at, size in parts) > length:
        raise Refused("the TIFF is cut short; copy the file again")
    if page.compression in JPEG_2000:
        for at, _ in parts:
            _check_codestream(page, at)
    stored = sum(size for _, size in parts)
    needed = page.imagelength * math.ceil(page.imagewidth * page.samplesperpixel * page.bitspersample / 8)
    check_length(math.ceil(needed / LARGEST_GROWTH[page.compression]), stored)


def _check_codestream(page: tifffile.TiffPage, at: int) -> None:
    """Raise `Refused` where JPEG 2000 at that byte claims more pixels than its strip or tile has: its decoder would ask
    for the memory."""
    stream = page.parent.filehandle
    stream.seek(at)
    start = stream.read(CODESTREAM_BYTES)
    size = start.find(CODESTREAM) + 8
    columns, rows = (int.from_bytes(start[k : k + 4]) for k in (size, size + 4))
    if columns * rows > math.prod(page.chunks):
        raise Refused(f"holds a strip or tile that claims {columns} × {rows} px; copy the file again")
