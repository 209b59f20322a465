"""An image file, whatever its name: its first bytes say which format reads it."""

from pathlib import Path
from typing import Protocol

import numpy as np

from spotcheck.errors import InputError
from spotcheck.formats import pgm, png, tiff
from spotcheck.formats.page import Page, Refused


class Format(Protocol):
    """What the module of a format offers."""

    def pages(self, path: Path) -> list[Page]:
        """Every page of a file. Raises `Refused`, or anything else for a broken file."""

    def read(self, path: Path, page: int) -> np.ndarray:
        """Pixels [rows, columns] of a page, uint8 or uint16, in the machine's byte order."""


# First bytes, the format's name, and what reads it.
READERS: tuple[tuple[tuple[bytes, ...], str, Format], ...] = (
    (tiff.SIGNATURES, "TIFF", tiff),
    ((png.SIGNATURE,), "PNG", png),
    ((b"P2", b"P5", *pgm.COLOUR), "PGM", pgm),
)
# Formats that a frame may turn out to be in, and that are not read.
OTHERS = (
    (b"BM", "BMP"),
    (b"\xff\xd8\xff", "JPEG"),
    (b"GIF8", "GIF"),
    (b"\0\0\0\x0cjP  ", "JPEG 2000"),
    (b"\xff\x4f\xff\x51", "JPEG 2000"),
    (b"SIMPLE  =", "FITS"),
    (b"\x89HDF", "HDF5"),
    (b"RIFF", "WebP or AVI"),
    (b"8BPS", "Photoshop"),
    (b"\x93NUMPY", "NumPy"),
    (b"PK\3\4", "a ZIP archive"),
)


def pages(path: Path, name: str) -> list[Page]:
    """What the headers of a file say of every page. Raises `InputError`, which calls the file by `name`."""
    kind, reader = _reader(path, name)
    try:
        return reader.pages(path)
    except Exception as error:
        raise _said(error, name, kind) from None


def pixels(path: Path, page: int, name: str) -> np.ndarray:
    """Pixels [rows, columns] of a page, uint8 or uint16, as they are stored. Raises `InputError`."""
    kind, reader = _reader(path, name)
    try:
        return reader.read(path, page)
    except Exception as error:
        raise _said(error, name, kind) from None


def _reader(path: Path, name: str) -> tuple[str, Format]:
    """Name of the format that the first bytes tell, and what reads it. Raises `InputError`."""
    with path.open("rb") as stream:
        start = stream.read(16)
    for signatures, kind, reader in READERS:
        if start.startswith(signatures):
            return kind, reader
    for signature, kind in OTHERS:
        if start.startswith(signature):
            raise InputError(f"{name}: is {kind} by its first bytes, which is not read; save it as TIFF, PNG or PGM")
    raise InputError(f"{name}: cannot be read as an image, perhaps cut short; copy the file again")


def _said(error: Exception, name: str, kind: str) -> Exception:
    """What to raise for what a reader raised: tifffile and Pillow promise no class of error for a broken file."""
    if isinstance(error, Refused):
        return InputError(f"{name}: {error}")
    if isinstance(error, OSError) and error.filename is not None:
        return error
    if isinstance(error, MemoryError):
        return InputError(f"{name}: does not fit into memory; free some, or copy the file again if it is no such size")
    reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
    return InputError(f"{name}: cannot be read as {kind} ({reason}), perhaps cut short; copy the file again")
