"""NumPy's .npy: its header is checked here, pixels are read from where they lie."""

import math
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.lib import format as npy

from spotcheck.io.formats.arrays import pages_of, place_of
from spotcheck.io.formats.page import Page, Refused, check_length

SIGNATURE = npy.MAGIC_PREFIX


class Header(NamedTuple):
    """Shape, kind of number, whether the first axis runs fastest, and where the numbers start [byte]."""

    shape: tuple[int, ...]
    dtype: np.dtype
    fortran: bool
    start: int


def header(path: Path) -> Header:
    """Header of a file (NumPy enhancement proposal 1). Raises `Refused`, and what NumPy raises for a broken one."""
    with path.open("rb") as stream:
        version = npy.read_magic(stream)
        if version not in ((1, 0), (2, 0), (3, 0)):
            raise Refused(f"has version {version[0]}.{version[1]} of its format; save it anew by numpy.save")
        # Version 3 differs from 2 in the letters of field names alone, which frames have none of.
        reader = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran, dtype = reader(stream)
        start = stream.tell()
    if any(size < 0 for size in shape):
        raise Refused(f"has the shape {shape}; copy the file again")
    return Header(shape, dtype, fortran, start)


def pages(path: Path) -> list[Page]:
    """Every page of a file. Raises as `header` does."""
    found = header(path)
    pages = pages_of(found.shape, found.dtype)
    check_length(found.start + math.prod(found.shape) * found.dtype.itemsize, path.stat().st_size)
    return pages


def read(path: Path, page: int) -> np.ndarray:
    """Pixels of a page, [rows, columns] or [rows, columns, colours]. Raises as `header` does."""
    pages(path)
    found = header(path)
    order: Literal["F", "C"] = "F" if found.fortran else "C"
    stored = np.memmap(path, dtype=found.dtype, mode="r", offset=found.start, shape=found.shape, order=order)
    return np.array(stored[place_of(page, found.shape)], found.dtype.newbyteorder("="), order="C")
