"""Files of NumPy (.npy): the header is checked here, and the pixels are read by memory mapping."""

import math
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from spotcheck.io.formats.arrays import find_page_index, make_pages
from spotcheck.io.formats.page import ImageError, Page, check_length

SIGNATURE = npy.MAGIC_PREFIX


def list_pages(path: Path) -> list[Page]:
    """Return the header of each page of a file (NumPy enhancement proposal 1).

    Raises `ImageError`, and what NumPy raises for a broken file.
    """
    with path.open("rb") as stream:
        version = npy.read_magic(stream)
        if version not in ((1, 0), (2, 0), (3, 0)):
            raise ImageError(f"has version {version[0]}.{version[1]} of its format; save it anew by numpy.save")
        # Version 3 differs from 2 only in the encoding of field names, which frames do not have.
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = read_header(stream)
        header_bytes = stream.tell()
    if any(size < 0 for size in shape):
        raise ImageError(f"has the shape {shape}; copy the file again")
    pages = make_pages(shape, dtype)
    check_length(header_bytes + math.prod(shape) * dtype.itemsize, path.stat().st_size)
    return pages


def read_pixels(path: Path, page: int) -> np.ndarray:
    """Return the pixels of a page [row, column] or [row, column, channel]. Raises as `list_pages` does."""
    list_pages(path)
    array = npy.open_memmap(path, mode="r")
    return np.array(array[find_page_index(page, array.shape)], array.dtype.newbyteorder("="), order="C")
