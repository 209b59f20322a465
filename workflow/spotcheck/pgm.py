"""Reading portable graymaps as they are: general image readers stretch a PGM whose white is not 255 or 65535."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

_HEADER = re.compile(rb"(P[25])\s+(?:#.*\s+)*(\d+)\s+(?:#.*\s+)*(\d+)\s+(?:#.*\s+)*(\d+)\s")


class Header(NamedTuple):
    """Binary or text, columns, rows, white value, and where the pixels start [byte]."""

    binary: bool
    columns: int
    rows: int
    white: int
    start: int

    @property
    def bits(self) -> int:
        """Bits of a stored pixel."""
        return 8 if self.white < 256 else 16


def header(path: Path) -> Header:
    """Header of a PGM file (P2 or P5). Raises `ValueError` when it is none, or too short for its pixels."""
    with path.open("rb") as stream:
        found = _HEADER.match(stream.read(4096))
    if found is None:
        raise ValueError("no PGM header")
    columns, rows, white = (int(found[k][:9]) for k in (2, 3, 4))
    if not 1 <= white <= 65535:
        raise ValueError(f"its white is {white}, not 1 to 65535")
    parsed = Header(found[1] == b"P5", columns, rows, white, found.end())
    if parsed.binary and path.stat().st_size < parsed.start + columns * rows * parsed.bits // 8:
        raise ValueError("cut short")
    return parsed


def read(path: Path) -> np.ndarray:
    """Pixels [rows, columns] as uint8 or uint16."""
    parsed = header(path)
    content = path.read_bytes()[parsed.start :]
    count = parsed.columns * parsed.rows
    if parsed.binary:
        stored = np.dtype(">u2" if parsed.bits == 16 else "u1")
        pixels = np.frombuffer(content, stored, count)
    else:
        words = re.sub(rb"#[^\n]*", b"", content).split()[:count]
        if len(words) < count:
            raise ValueError("cut short")
        if not all(word.isdigit() and len(word) < 7 for word in words):
            raise ValueError("holds what is no whole number")
        pixels = np.array(words, dtype=int)
    if pixels.size and pixels.max() > parsed.white:
        raise ValueError(f"holds the value {pixels.max()}, above its own white of {parsed.white}")
    return pixels.astype(np.uint16 if parsed.bits == 16 else np.uint8).reshape(parsed.rows, parsed.columns)
