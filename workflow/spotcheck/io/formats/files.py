"""Image files of all formats: the first bytes of a file decide which reader is used."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np

from spotcheck.errors import InputError
from spotcheck.io.formats import hdf5, npy, pgm, png, tiff
from spotcheck.io.formats.colour import MONOCHROME, Colour, extract_plane, select_plane
from spotcheck.io.formats.names import split_inner_path
from spotcheck.io.formats.page import ONE_CHANNEL, ImageError, Page
from spotcheck.io.formats.pixel_checks import check_byte_order, check_colours


class Reader(Protocol):
    """Module that reads a format. Both functions raise `ImageError`, and possibly any exception for a broken file."""

    def list_pages(self, path: Path) -> list[Page]:
        """Return the header of each page of a file."""

    def read_pixels(self, path: Path, page: int) -> np.ndarray:
        """Return the stored pixels of a page [row, column] or [row, column, channel], in native byte order."""


# First bytes of a file, name of its format, and its reader; None for formats that are only named in a message.
READERS: tuple[tuple[tuple[bytes, ...], str, Reader | None], ...] = (
    (tiff.SIGNATURES, "TIFF", tiff),
    ((png.SIGNATURE,), "PNG", png),
    ((b"P2", b"P5", *pgm.OTHERS), "PGM", pgm),
    ((npy.SIGNATURE,), "NumPy", npy),
    ((hdf5.SIGNATURE,), "HDF5", hdf5),
    ((b"BM",), "BMP", None),
    ((b"\xff\xd8\xff",), "JPEG", None),
    ((b"GIF8",), "GIF", None),
    ((b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51"), "JPEG 2000", None),
    ((b"SIMPLE  =",), "FITS", None),
    ((b"CDF",), "netCDF of the classic model (nccopy -k netCDF-4 makes netCDF-4 of it)", None),
    ((b"RIFF",), "WebP or AVI", None),
    ((b"8BPS",), "Photoshop", None),
    ((b"PK\3\4",), "a ZIP archive", None),
)
# First bytes of a file in which its signature is looked for, and most characters of the text of an error in a message.
SIGNATURE_BYTES, LONGEST_REASON = 16, 120
FLOATING_POINT = f"holds floating-point pixels, such as a mean of frames; {ONE_CHANNEL}"


def list_pages(path: Path, name: str, colour: Colour = MONOCHROME, *, allow_floats: bool = False) -> list[Page]:
    """Return the header of each page of an image file.

    Parameters
    ----------
    path : Path
        Path of the file, perhaps with # and the path of a dataset inside an HDF5 file.
    name : str
        Name of the file in messages.
    colour : Colour
        Colour plane whose header is returned.
    allow_floats : bool
        Whether pages of floating-point numbers are accepted, which no camera writes.

    Returns
    -------
    list of Page
        Headers in the order of the pages, those of previews included.

    Raises
    ------
    InputError
        If the file is broken, or its images are not of the stated colours and types.
    """
    with _open_reader(path, name) as reader:
        pages = reader.list_pages(path)
        if not allow_floats and any(not page.bits and not page.preview for page in pages):
            raise ImageError(FLOATING_POINT)
        return [select_plane(page, colour) for page in pages]


def read_pixels(
    path: Path, page: int, name: str, colour: Colour = MONOCHROME, *, allow_floats: bool = False
) -> np.ndarray:
    """Return the stored pixels [row, column] of one colour plane of a page.

    Pages count from 0. The path, the name of the file in messages, and the exceptions are those of `list_pages`.
    Floating-point pixels raise `InputError` unless `allow_floats`; swapped bytes and false colours raise it always.
    """
    with _open_reader(path, name) as reader:
        pixels = reader.read_pixels(path, page)
        if not allow_floats and pixels.dtype.kind == "f":
            raise ImageError(FLOATING_POINT)
        check_byte_order(pixels)
        if pixels.ndim == 3 and pixels.dtype.kind == "u":
            check_colours(pixels)
        return extract_plane(pixels, colour)


def list_stacks(path: Path, name: str) -> list[str]:
    """Return the names of the stacks of images in a file.

    An HDF5 file has one stack per dataset of frames, named `name#/path/inside`. Any other file is one stack, `name`.
    The folder of the file and such a name form the path that `list_pages` takes. Raises `InputError` as it does.
    """
    with _open_reader(path, name) as reader:
        return [f"{name}#{inner_path}" for inner_path in hdf5.list_stacks(path)] if reader is hdf5 else [name]


@contextmanager
def _open_reader(path: Path, name: str) -> Iterator[Reader]:
    """Yield the reader for the format of a file, and raise the errors of the `with` block as `InputError`.

    Errors of the operating system that name a file are raised unchanged.
    """
    format_name, reader = _detect_format(Path(split_inner_path(path.as_posix())[0]), name)
    try:
        yield reader
    except Exception as error:
        raise _convert_error(error, name, format_name) from None


def _detect_format(path: Path, name: str) -> tuple[str, Reader]:
    """Return the name and the reader of the format that the first bytes of a file show.

    Raises `InputError` for other formats.
    """
    with path.open("rb") as stream:
        first_bytes = stream.read(SIGNATURE_BYTES)
    for signatures, format_name, reader in READERS:
        if first_bytes.startswith(signatures):
            if reader is None:
                raise InputError(
                    f"{name}: is {format_name} by its first bytes, which is not read; save it as TIFF, PNG or PGM"
                )
            return format_name, reader
    raise InputError(
        f"{name}: cannot be read as an image: by its first bytes it is none of TIFF, PNG, PGM, HDF5, netCDF-4 and .npy,"
        " or it is cut short; copy the file again"
    )


def _convert_error(error: Exception, name: str, format_name: str) -> Exception:
    """Return the exception to raise for an exception of a reader.

    It is `InputError`, because tifffile and Pillow raise any class for a broken file, except for errors of the
    operating system that name a file.
    """
    if isinstance(error, ImageError):
        return InputError(f"{name}: {error}")
    if isinstance(error, OSError) and error.filename is not None:
        return error
    if isinstance(error, MemoryError):
        return InputError(
            f"{name}: does not fit into memory; close other programs, or copy the file again if it is not that large"
        )
    reason = describe_error(error)
    return InputError(f"{name}: cannot be read as {format_name} ({reason}), perhaps cut short; copy the file again")


def describe_error(error: Exception) -> str:
    """Return the first line of the text of an error, shortened to `LONGEST_REASON`, or else the name of its class."""
    return str(error).splitlines()[0][:LONGEST_REASON] if str(error) else type(error).__name__
