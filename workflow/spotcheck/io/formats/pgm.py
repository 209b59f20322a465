"""Portable graymaps as they are: general image readers stretch a PGM whose white is not 255 or 65535."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spotcheck.io.formats.page import ONE_CHANNEL, Page, Refused, check_length, check_size

# Between two words of a header stand white space and comments, which end with their line.
_GAP = rb"(?:\s+|#[^\n]*\n)+"
_HEADER = re.compile(rb"P[25]" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})(?:\s|#[^\n]*\n)")
# What some programs write between a header and its pixels: the rest of a line end of Windows, or a comment.
_REST = re.compile(rb"\n|[ \t]*#[^\n]*\n")
# Bytes in which a header ends, comments included.
_HEADER_BYTES = 65536
COLOUR = {b"P1": "black and white (PBM)", b"P4": "black and white (PBM)", b"P3": "colour (PPM)", b"P6": "colour (PPM)"}


class Header(NamedTuple):
    """Binary or text, rows, columns, white value, and where the pixels start [byte]."""

    binary: bool
    rows: int
    columns: int
    white: int
    start: int

    @property
    def bits(self) -> int:
        """Bits of a stored pixel."""
        return 8 if self.white < 256 else 16

    @property
    def bytes(self) -> int:
        """Bytes of the pixels: as text at least one digit and what parts it from the next."""
        count = self.rows * self.columns
        return count * self.bits // 8 if self.binary else 2 * count - 1


def header(path: Path) -> Header:
    """Header of a PGM file (P2 or P5). Raises `Refused`."""
    with path.open("rb") as stream:
        content = stream.read(_HEADER_BYTES)
    if content[:2] in COLOUR:
        raise Refused(f"is {COLOUR[content[:2]]}; {ONE_CHANNEL}")
    found = _HEADER.match(content)
    if found is None:
        raise Refused("has no whole PGM header, perhaps cut short; copy the file again")
    columns, rows, white = (int(word) for word in found.groups())
    check_size(rows, columns)
    if not 1 <= white <= 65535:
        raise Refused(f"states the white value {white}; it must be 1 to 65535")
    parsed = Header(content[:2] == b"P5", rows, columns, white, found.end())
    length = path.stat().st_size
    check_length(parsed.start + parsed.bytes, length)
    surplus = length - parsed.start - parsed.bytes
    if not parsed.binary or not surplus:
        return parsed
    rest = _REST.match(content, parsed.start)
    if rest and rest.end() - rest.start() == surplus:
        return parsed._replace(start=rest.end())
    raise Refused(
        f"is {surplus} bytes longer than its header says, so that its first pixel cannot be told;"
        f" save it anew, a single image a file"
    )


def pages(path: Path) -> list[Page]:
    """The one page of a file. Raises `Refused`."""
    found = header(path)
    return [Page((found.rows, found.columns), found.bits)]


def read(path: Path, page: int) -> np.ndarray:
    """Pixels [rows, columns] as uint8 or uint16. Raises `Refused`."""
    parsed = header(path)
    content = path.read_bytes()[parsed.start :]
    count = parsed.columns * parsed.rows
    if parsed.binary:
        pixels = np.frombuffer(content, ">u2" if parsed.bits == 16 else "u1", count)
    else:
        words = re.sub(rb"#[^\n]*", b"", content).split()
        if len(words) != count:
            raise Refused(f"holds {len(words)} numbers where its header says {count}; copy the file again")
        if not all(word.isdigit() and len(word) < 7 for word in words):
            raise Refused("holds what is no whole number; copy the file again")
        pixels = np.array(words, dtype=int)
    if pixels.max() > parsed.white:
        raise Refused(f"holds the value {pixels.max()}, above its own white of {parsed.white}; copy the file again")
    return pixels.astype(np.uint16 if parsed.bits == 16 else np.uint8).reshape(parsed.rows, parsed.columns)
