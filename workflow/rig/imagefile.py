"""Frames as files: equal pixels give equal bytes, and a file is there whole or not at all."""

from __future__ import annotations

import io
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import tifffile


def write_frame(path: Path, frame: np.ndarray, bit_depth: int) -> None:
    """Write a frame [DN] as TIFF, PNG or PGM, by the name's ending; TIFF always in 16 bits, the others in 8 or 16."""
    suffix = path.suffix.lower()
    if suffix in (".tif", ".tiff"):
        data = _tiff(frame.astype(np.uint16))
    else:
        narrow = frame.astype(np.uint8) if bit_depth <= 8 else frame.astype(">u2")
        data = _png(narrow) if suffix == ".png" else _pgm(narrow)
    write_whole(path, data)


def write_whole(path: Path, data: bytes) -> None:
    """Write to a temporary name beside the file, then rename."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _tiff(frame: np.ndarray) -> bytes:
    # No date, no software, no description; a predictor makes noise larger, a higher level only slower.
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        frame,
        photometric="minisblack",
        compression="zlib",
        compressionargs={"level": 1},
        rowsperstrip=64,
        metadata=None,
        software="",
        datetime=None,
    )
    return buffer.getvalue()


def _pgm(frame: np.ndarray) -> bytes:
    # Pillow scales a PGM whose white is below 65535 up to it: 10-bit values come back unchanged only with 65535.
    white = 255 if frame.itemsize == 1 else 65535
    return f"P5\n{frame.shape[1]} {frame.shape[0]}\n{white}\n".encode() + frame.tobytes()


def _png(frame: np.ndarray) -> bytes:
    height, width = frame.shape
    lines = frame.view(np.uint8).reshape(height, -1)
    rows = np.hstack([np.zeros((height, 1), np.uint8), lines]).tobytes()  # filter 0 before each row
    header = struct.pack(">IIBBBBB", width, height, 8 * frame.itemsize, 0, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows, 9)), (b"IEND", b""))
    body = b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body
