"""PNG files: chunks that change the meaning of a sample are checked here, and Pillow or imagecodecs decodes.

A sample is the stored number of one channel of a pixel: a grey pixel has one, an RGB pixel three. A file is a sequence
of chunks, each with its length, name, content and checksum.
"""

import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from PIL import Image

from spotcheck.io.formats.page import DEFLATE_RATIO, GREY, ONE_CHANNEL, RGB, ImageError, Page, check_length, check_size

# `check_size` refuses frames that are too large; Pillow's own limit is lower.
Image.MAX_IMAGE_PIXELS = None

SIGNATURE = b"\x89PNG\r\n\x1a\n"
# Colour type that is read, and those that are refused (PNG, third edition, section 11.2.1).
RGB_TYPE = 2
REFUSED_TYPES = {3: "a palette of colours", 4: "a channel of transparency", 6: "RGB colour and transparency"}
# Chunks (PNG, third edition, section 11.3) that change the meaning of a sample, and what they do.
REFUSED_CHUNKS = {b"tRNS": "makes pixels of one value transparent", b"acTL": "makes it a film of several images"}
# Bytes of the content of the header chunk, and first bytes of the content of a chunk that are read.
HEADER_BYTES, CONTENT_BYTES = 13, 64


class Header(NamedTuple):
    """Header of a file."""

    rows: int  # rows [px]
    columns: int  # columns [px]
    bits: int  # bits of a sample, 8 or 16
    significant_bits: int  # bits of a reading before it was scaled to the range of a sample (chunk sBIT)
    is_rgb: bool  # whether a pixel has three samples, not one


def read_header(path: Path) -> Header:
    """Return the header of a file from its chunks (PNG, third edition, sections 5 and 11). Raises `ImageError`."""
    length = path.stat().st_size
    with path.open("rb") as stream:
        stream.seek(len(SIGNATURE))
        name, content = _read_chunk(stream, length)
        if name != b"IHDR" or len(content) < HEADER_BYTES:
            raise ImageError("has no PNG header; copy the file again")
        columns, rows, bits, colour_type = struct.unpack(">IIBB", content[:10])
        significant_bits = bits
        while name != b"IEND":
            name, content = _read_chunk(stream, length)
            if name in REFUSED_CHUNKS:
                raise ImageError(f"its chunk {name.decode()} {REFUSED_CHUNKS[name]}; save it as a plain grey image")
            if name == b"sBIT" and content:
                significant_bits = content[0]
                if colour_type == RGB_TYPE and len(set(content[:3])) > 1:
                    raise ImageError("its chunk sBIT gives its colours different bits; save it without that chunk")
    if colour_type in REFUSED_TYPES:
        raise ImageError(f"has {REFUSED_TYPES[colour_type]} (PNG colour type {colour_type}); {ONE_CHANNEL}")
    if bits not in (8, 16):
        raise ImageError(f"holds {bits} bit pixels; {ONE_CHANNEL}")
    if not 1 <= significant_bits <= bits:
        raise ImageError(f"its chunk sBIT says {significant_bits} of {bits} bits; it must be 1 to {bits}")
    check_size(rows, columns)
    is_rgb = colour_type == RGB_TYPE
    # Each row has one more byte, the type of its filter.
    check_length(rows * ((3 if is_rgb else 1) * columns * bits // 8 + 1) // DEFLATE_RATIO, length)
    return Header(rows, columns, bits, significant_bits, is_rgb)


def _read_chunk(stream: BinaryIO, length: int) -> tuple[bytes, bytes]:
    """Return the name and the first `CONTENT_BYTES` of the content of the next chunk, and move behind it.

    Raises `ImageError` if the file of `length` bytes ends within the chunk.
    """
    # Four bytes each: length of the content, name and, behind the content, checksum.
    chunk_start = stream.read(8)
    size = int.from_bytes(chunk_start[:4])
    chunk_end = stream.tell() + size + 4
    if len(chunk_start) < 8 or chunk_end > length:
        raise ImageError("is cut short; copy the file again")
    content = stream.read(min(size, CONTENT_BYTES))
    stream.seek(chunk_end)
    return chunk_start[4:], content


def list_pages(path: Path) -> list[Page]:
    """Return the header of the only page of a file, as a list. Raises `ImageError`."""
    header = read_header(path)
    return [Page((header.rows, header.columns), header.significant_bits, colours=RGB if header.is_rgb else GREY)]


def read_pixels(path: Path, page: int) -> np.ndarray:
    """Return the readings of the only page [row, column] or [row, column, channel] as uint8 or uint16.

    Raises `ImageError`, and what Pillow or imagecodecs raises for a broken file.
    """
    header = read_header(path)
    if header.is_rgb and header.bits == 16:
        import imagecodecs

        # Pillow reduces colours of 16 bits to 8.
        pixels = imagecodecs.png_decode(path.read_bytes())
    else:
        with Image.open(path, formats=("PNG",)) as image:
            pixels = np.asarray(image)
    return _undo_scaling(pixels, header.bits, header.significant_bits)


def _undo_scaling(pixels: np.ndarray, bits: int, significant_bits: int) -> np.ndarray:
    """Return the readings of samples [row, column] or [row, column, channel]: their `significant_bits` high bits.

    A writer scales readings of `significant_bits` to samples of `bits`, which a shift to the right undoes (PNG, third
    edition, section 13.12). Raises `ImageError` if no way of scaling in section 12.4 gives the low bits.
    """
    shift = bits - significant_bits
    if not shift:
        return pixels
    readings = pixels >> shift
    values = range(2**significant_bits)
    # Samples of all values by each way of scaling: shifted, multiplied, and with their bits repeated.
    scalings = (
        [value << shift for value in values],
        [round(value * (2**bits - 1) / (2**significant_bits - 1)) for value in values],
        [int((f"{value:0{significant_bits}b}" * bits)[:bits], 2) for value in values],
    )
    if any(np.array_equal(pixels, np.array(samples, pixels.dtype)[readings]) for samples in scalings):
        return readings
    raise ImageError(
        f"its chunk sBIT says that {significant_bits} of {bits} bits hold readings, but the low ones do as well;"
        " save it without that chunk"
    )
