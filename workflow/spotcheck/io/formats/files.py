"""An image file, whatever its name: its first bytes say which format reads it."""

from pathlib import Path
from typing import Protocol

import numpy as np

from spotcheck.errors import InputError
from spotcheck.io.formats import colour, hdf5, npy, pgm, png, tiff
from spotcheck.io.formats.colour import Colour
from spotcheck.io.formats.names import split_inner_path
from spotcheck.io.formats.page import ONE_CHANNEL, Page, Refused


class Format(Protocol):
    """What the module of a format offers. Both functions raise `Refused`, or anything else for a broken file."""

    def pages(self, path: Path) -> list[Page]:
        """Every page of a file."""

    def read(self, path: Path, page: int) -> np.ndarray:
        """Pixels of a page, [rows, columns] or [rows, columns, colours], in native byte order."""


# First bytes, the format's name, and what reads it.
READERS: tuple[tuple[tuple[bytes, ...], str, Format], ...] = (
    (tiff.SIGNATURES, "TIFF", tiff),
    ((png.SIGNATURE,), "PNG", png),
    ((b"P2", b"P5", *pgm.COLOUR), "PGM", pgm),
    ((npy.SIGNATURE,), "NumPy", npy),
)
# Formats that a frame may turn out to be in, and that are not read.
OTHERS = (
    (b"BM", "BMP"),
    (b"\xff\xd8\xff", "JPEG"),
    (b"GIF8", "GIF"),
    (b"\0\0\0\x0cjP  ", "JPEG 2000"),
    (b"\xff\x4f\xff\x51", "JPEG 2000"),
    (b"SIMPLE  =", "FITS"),
    (b"CDF", "netCDF of the classic model (nccopy -k netCDF-4 makes netCDF-4 of it)"),
    (b"RIFF", "WebP or AVI"),
    (b"8BPS", "Photoshop"),
    (b"PK\3\4", "a ZIP archive"),
)


def pages(path: Path, name: str, taken: Colour = colour.NONE, *, readings: bool = True) -> list[Page]:
    """What the headers of a file say of the plane of a colour that is taken of every page. A path into an HDF5 file
    follows its name behind #. Raises `InputError`, which calls the file by `name`; also for floating-point numbers,
    which no converter reads, unless `readings` is False."""
    file, inside = split_inner_path(path.as_posix())
    kind, reader = _reader(Path(file), name)
    try:
        found = hdf5.pages(Path(file), inside) if reader is None else reader.pages(Path(file))
        if readings:
            _check_readings(any(not page.bits and not page.preview for page in found))
        return [colour.plane_of(page, taken) for page in found]
    except Exception as error:
        raise _said(error, name, kind) from None


def pixels(path: Path, page: int, name: str, taken: Colour = colour.NONE, *, readings: bool = True) -> np.ndarray:
    """Pixels [rows, columns] of a page, as they are stored, of the plane of a colour that is taken. Raises
    `InputError` as `pages` does."""
    file, inside = split_inner_path(path.as_posix())
    kind, reader = _reader(Path(file), name)
    try:
        found = hdf5.read(Path(file), page, inside) if reader is None else reader.read(Path(file), page)
        if readings:
            _check_readings(found.dtype.kind == "f")
        return colour.plane(found, taken)
    except Exception as error:
        raise _said(error, name, kind) from None


def stacks(path: Path, name: str) -> list[str]:
    """Names of a file's stacks: of HDF5 one for each dataset that holds frames, with its path behind #. Raises
    `InputError`."""
    kind, reader = _reader(path, name)
    try:
        return [name] if reader is not None else [f"{name}#{inside}" for inside in hdf5.stacks(path)]
    except Exception as error:
        raise _said(error, name, kind) from None


def _check_readings(is_floating: bool) -> None:
    """Raise `Refused` for floating-point numbers."""
    if is_floating:
        raise Refused(f"holds floating-point pixels, such as a mean of frames; {ONE_CHANNEL}")


def _reader(path: Path, name: str) -> tuple[str, Format | None]:
    """Name of the format that the first bytes tell, and what reads it, None for HDF5. Raises `InputError`."""
    with path.open("rb") as stream:
        start = stream.read(16)
    for signatures, kind, reader in READERS:
        if start.startswith(signatures):
            return kind, reader
    if start.startswith(hdf5.SIGNATURE):
        return "HDF5", None
    for signature, kind in OTHERS:
        if start.startswith(signature):
            raise InputError(f"{name}: is {kind} by its first bytes, which is not read; save it as TIFF, PNG or PGM")
    raise InputError(
        f"{name}: cannot be read as an image: by its first bytes it is none of TIFF, PNG, PGM, HDF5, netCDF-4 and .npy,"
        " or it is cut short; copy the file again"
    )


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
