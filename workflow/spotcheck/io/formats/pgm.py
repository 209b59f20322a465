"""Portable graymaps (PGM). General image readers rescale a PGM whose white is not 255 or 65535; this one does not.

The white is the largest value that a pixel may have, which the header states.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spotcheck.io.formats.page import ONE_CHANNEL, ImageError, Page, check_length, check_size

# White space and comments, which end with their line, between the words of a header; and a whole header, which states
# columns, rows and white.
_GAP = rb"(?:\s+|#[^\n]*\n)+"
_HEADER = re.compile(rb"P[25]" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})(?:\s|#[^\n]*\n)")
# Bytes that some programs write between a header and its pixels: the rest of a Windows line end, or a comment.
_PADDING = re.compile(rb"\n|[ \t]*#[^\n]*\n")
# Longest header including comments [byte].
_HEADER_BYTES = 65536
# Most digits of a pixel in a text (P2): white is at most 65535.
MOST_DIGITS = 6
# Netpbm formats that are no graymaps, by their first bytes.
OTHERS = {b"P1": "black and white (PBM)", b"P4": "black and white (PBM)", b"P3": "colour (PPM)", b"P6": "colour (PPM)"}


class Header(NamedTuple):
    """Header of a file."""

    binary: bool  # whether pixels are stored as bytes (P5), not as text (P2)
    rows: int  # rows [px]
    columns: int  # columns [px]
    white: int  # largest value that a pixel may have
    start: int  # position of the first pixel [byte]

    @property
    def bits(self) -> int:
        """Bits of a stored pixel."""
        return 8 if self.white < 256 else 16


def read_header(path: Path) -> Header:
    """Return the header of a PGM file (P2 or P5). Raises `ImageError` if it does not fit the length of the file."""
    with path.open("rb") as stream:
        content = stream.read(_HEADER_BYTES)
    if content[:2] in OTHERS:
        raise ImageError(f"is {OTHERS[content[:2]]}; {ONE_CHANNEL}")
    match = _HEADER.match(content)
    if match is None:
        raise ImageError("has no whole PGM header, perhaps cut short; copy the file again")
    columns, rows, white = (int(word) for word in match.groups())
    check_size(rows, columns)
    if not 1 <= white <= 65535:
        raise ImageError(f"states the white value {white}; it must be 1 to 65535")
    header = Header(content[:2] == b"P5", rows, columns, white, match.end())
    # Text takes at least one digit per pixel and a blank between two.
    pixel_end = header.start + (rows * columns * header.bits // 8 if header.binary else 2 * rows * columns - 1)
    length = path.stat().st_size
    check_length(pixel_end, length)
    surplus = length - pixel_end
    if not header.binary or not surplus:
        return header
    padding = _PADDING.match(content, header.start)
    if padding and padding.end() - padding.start() == surplus:
        return header._replace(start=padding.end())
    raise ImageError(
        f"is {surplus} bytes longer than its header says, so that the first pixel cannot be located;"
        " save it again with one image per file"
    )


def list_pages(path: Path) -> list[Page]:
    """Return the header of the only page of a file, as a list. Raises `ImageError`."""
    header = read_header(path)
    return [Page((header.rows, header.columns), header.bits)]


def read_pixels(path: Path, page: int) -> np.ndarray:
    """Return the pixels [row, column] of the only page as uint8 or uint16. Raises `ImageError`."""
    header = read_header(path)
    content = path.read_bytes()[header.start :]
    count = header.columns * header.rows
    if header.binary:
        pixels = np.frombuffer(content, ">u2" if header.bits == 16 else "u1", count)
    else:
        # Numbers in a text, which may contain comments.
        words = re.sub(rb"#[^\n]*", b"", content).split()
        if len(words) != count:
            raise ImageError(f"holds {len(words)} numbers where its header says {count}; copy the file again")
        if not all(word.isdigit() and len(word) <= MOST_DIGITS for word in words):
            raise ImageError("holds pixels that are not whole numbers; copy the file again")
        pixels = np.array(words, dtype=int)
    if header.binary and pixels.max() > header.white >= pixels.byteswap().max():
        raise ImageError(
            f"has its high and low bytes swapped: only then no value is above its white of {header.white};"
            " save it with the high byte first"
        )
    if pixels.max() > header.white:
        raise ImageError(f"holds the value {pixels.max()}, above its own white of {header.white}; copy the file again")
    return pixels.astype(np.uint16 if header.bits == 16 else np.uint8).reshape(header.rows, header.columns)
