"""NumPy's .npy files: the header is checked here, and the pixels are read by memory mapping."""

import math
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.lib import format as npy

from spotcheck.io.formats.arrays import find_page_index, make_pages
from spotcheck.io.formats.page import ImageError, Page, check_length

SIGNATURE = npy.MAGIC_PREFIX


class Header(NamedTuple):
    """Header of a file."""

    shape: tuple[int, ...]  # length of each axis
    dtype: np.dtype  # type of the stored numbers
    order: Literal["F", "C"]  # "F": the first axis runs fastest; "C": the last one does
    start: int  # position of the first number [byte]


def read_header(path: Path) -> Header:
    """Return the header of a file (NumPy enhancement proposal 1).

    Raises `ImageError`, and what NumPy raises for a broken file.
    """
    with path.open("rb") as stream:
        version = npy.read_magic(stream)
        if version not in ((1, 0), (2, 0), (3, 0)):
            raise ImageError(f"has version {version[0]}.{version[1]} of its format; save it anew by numpy.save")
        # Version 3 differs from 2 only in the letters of field names, which frames do not have.
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, is_fortran, dtype = read(stream)
        start = stream.tell()
    if any(size < 0 for size in shape):
        raise ImageError(f"has the shape {shape}; copy the file again")
    return Header(shape, dtype, "F" if is_fortran else "C", start)


def list_pages(path: Path) -> list[Page]:
    """Return the header of each page of a file. Raises as `read_header` does."""
    header = read_header(path)
    pages = make_pages(header.shape, header.dtype)
    check_length(header.start + math.prod(header.shape) * header.dtype.itemsize, path.stat().st_size)
    return pages


def read_pixels(path: Path, page: int) -> np.ndarray:
    """Return a page [row, column] or [row, column, channel]. Raises as `read_header` does."""
    list_pages(path)
    shape, dtype, order, start = read_header(path)
    array = np.memmap(path, dtype=dtype, mode="r", offset=start, shape=shape, order=order)
    return np.array(array[find_page_index(page, shape)], dtype.newbyteorder("="), order="C")
