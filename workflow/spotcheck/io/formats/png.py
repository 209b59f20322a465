"""PNG: what its chunks say of the samples is checked here, Pillow decodes them."""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from spotcheck.io.formats.page import DEFLATE_RATIO, GREY, ONE_CHANNEL, RGB, Page, Refused, check_length, check_size

# Frames are the user's own: `check_size` says which are too large, in our own words.
Image.MAX_IMAGE_PIXELS = None

SIGNATURE = b"\x89PNG\r\n\x1a\n"
COLOUR = 2
REFUSED_COLOURS = {3: "a palette of colours", 4: "a channel of transparency", 6: "RGB colour and transparency"}
# Chunks (PNG, third edition, section 11.3) that make more of a sample than a number, and what they make of it.
REFUSED = {b"tRNS": "makes pixels of one value transparent", b"acTL": "makes it a film of several images"}


class Header(NamedTuple):
    """Rows, columns, bits of a sample, how many of them are significant, and samples of a pixel."""

    rows: int
    columns: int
    bits: int
    significant_bits: int
    samples: int


def header(path: Path) -> Header:
    """What the chunks of a file say (PNG, third edition, sections 5 and 11). Raises `Refused`."""
    length = path.stat().st_size
    with path.open("rb") as stream:
        stream.seek(len(SIGNATURE))
        name, content = _chunk(stream, length)
        if name != b"IHDR" or len(content) < 13:
            raise Refused("has no PNG header; copy the file again")
        columns, rows, bits, colour = struct.unpack(">IIBB", content[:10])
        significant = bits
        while name != b"IEND":
            name, content = _chunk(stream, length)
            if name in REFUSED:
                raise Refused(f"its chunk {name.decode()} {REFUSED[name]}; save it as a plain grey image")
            if name == b"sBIT" and content:
                significant = content[0]
                if colour == COLOUR and len(set(content[:3])) > 1:
                    raise Refused("its chunk sBIT gives its colours different bits; save it without that chunk")
    if colour in REFUSED_COLOURS:
        raise Refused(f"has {REFUSED_COLOURS[colour]} (PNG colour type {colour}); {ONE_CHANNEL}")
    if bits not in (8, 16):
        raise Refused(f"holds {bits} bit pixels; {ONE_CHANNEL}")
    if not 1 <= significant <= bits:
        raise Refused(f"its chunk sBIT says {significant} of {bits} bits; it must be 1 to {bits}")
    check_size(rows, columns)
    samples = 3 if colour == COLOUR else 1
    check_length(rows * (samples * columns * bits // 8 + 1) // DEFLATE_RATIO, length)
    return Header(rows, columns, bits, significant, samples)


def _chunk(stream, length: int) -> tuple[bytes, bytes]:
    """Name of the next chunk and the first bytes of its content. Raises `Refused` where the file ends first."""
    start = stream.read(8)
    size = int.from_bytes(start[:4])
    after = stream.tell() + size + 4
    if len(start) < 8 or after > length:
        raise Refused("is cut short; copy the file again")
    content = stream.read(min(size, 64))
    stream.seek(after)
    return start[4:], content


def pages(path: Path) -> list[Page]:
    """The one page of a file. Raises `Refused`."""
    found = header(path)
    return [Page((found.rows, found.columns), found.significant_bits, colours=RGB if found.samples == 3 else GREY)]


def read(path: Path, page: int) -> np.ndarray:
    """Pixels, [rows, columns] or [rows, columns, colours], as uint8 or uint16. Raises `Refused`, and what Pillow or
    imagecodecs raise for a broken file."""
    found = header(path)
    if found.samples == 1 or found.bits == 8:
        with Image.open(path, formats=("PNG",)) as image:
            pixels = np.asarray(image)
    else:
        import imagecodecs

        # Pillow makes eight bits of sixteen where there are colours.
        pixels = imagecodecs.png_decode(path.read_bytes())
    return _significant(pixels, found.bits, found.significant_bits)


def _significant(pixels: np.ndarray, bits: int, significant: int) -> np.ndarray:
    """Readings of fewer bits that were scaled to those of a sample, as chunk sBIT says: shifted back (section 13.12).

    Raises `Refused` where the low bits hold what no way of scaling puts there.
    """
    shift = bits - significant
    if not shift:
        return pixels
    back = pixels >> shift
    scaled = np.rint(back * ((2**bits - 1) / (2**significant - 1))).astype(pixels.dtype)
    if any(np.array_equal(pixels, own) for own in (back << shift, scaled, _repeated(back, bits, significant))):
        return back
    raise Refused(
        f"its chunk sBIT says that {significant} of {bits} bits hold readings, but the low ones do as well;"
        f" save it without that chunk"
    )


def _repeated(back: np.ndarray, bits: int, significant: int) -> np.ndarray:
    """Readings whose bits were repeated until a sample was full (section 12.4)."""
    wide = back.astype(np.uint64)
    out, place = np.zeros_like(wide), bits
    while place > 0:
        place -= significant
        out |= wide << np.uint64(place) if place >= 0 else wide >> np.uint64(-place)
    return out.astype(back.dtype)
