"""Frames in an array of numbers: its last two axes are rows and columns, those before count pages."""

import math

import numpy as np

from spotcheck.io.formats.page import GREY, ONE_CHANNEL, RGB, Page, Refused, check_size

# An array whose last axis is this long holds colours, since no frame is as narrow.
COLOURS = 3
# More pages than a manifest has rows for.
MOST_PAGES = 10_000_000


def are_readings(dtype: np.dtype) -> bool:
    """Whether numbers are readings: unsigned, of 8 or 16 bits, in any order of bytes."""
    return dtype.kind == "u" and dtype.itemsize <= 2


def bits_of(dtype: np.dtype) -> int:
    """Bits of a stored pixel, 0 for a floating-point number. Raises `Refused` for numbers of any other kind."""
    if not are_readings(dtype) and not (dtype.kind == "f" and dtype.itemsize in (4, 8)):
        raise Refused(f"holds {dtype} pixels; {ONE_CHANNEL}")
    return 8 * dtype.itemsize if are_readings(dtype) else 0


def pages_of(shape: tuple[int, ...], dtype: np.dtype) -> list[Page]:
    """Pages of an array. Raises `Refused`."""
    bits = bits_of(dtype)
    colours = RGB if len(shape) > 2 and shape[-1] == COLOURS else GREY
    inner = shape[:-1] if colours else shape
    if len(inner) < 2:
        raise Refused(f"has {len(inner)} dimension{'s' if len(inner) > 1 else ''}; it must have rows and columns")
    rows, columns = inner[-2:]
    check_size(rows, columns)
    count = math.prod(inner[:-2])
    if not count:
        raise Refused("has no pages; copy the file again")
    if count > MOST_PAGES:
        raise Refused(f"claims {count} pages, more than {MOST_PAGES}; copy the file again")
    return [Page((rows, columns), bits, colours=colours)] * count


def place_of(page: int, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Index of a page along the axes before rows and columns; the last of them runs fastest."""
    before = shape[: -3 if len(shape) > 2 and shape[-1] == COLOURS else -2]
    return tuple(int(k) for k in np.unravel_index(page, before)) if before else ()
