"""Images in an array: its last two axes are rows and columns, and the axes before them (leading axes) count pages.

The last leading axis runs fastest. Behind rows and columns there may be an axis of red, green and blue.
"""

import math

import numpy as np

from spotcheck.io.formats.page import GREY, ONE_CHANNEL, RGB, ImageError, Page, check_size

# An array of three or more axes whose last axis has this length holds RGB images: no frame is that narrow.
RGB_CHANNELS = 3
# Most pages of a file; no manifest has so many rows.
MAX_PAGES = 10_000_000


def is_reading_type(dtype: np.dtype) -> bool:
    """Return whether a type can hold camera readings: unsigned integers of 8 or 16 bits, in any byte order."""
    return dtype.kind == "u" and dtype.itemsize <= 2


def make_pages(shape: tuple[int, ...], dtype: np.dtype) -> list[Page]:
    """Return the header of each page of an array. Raises `ImageError` if it does not hold images.

    Floating-point numbers of 32 and 64 bits are accepted; their pages have 0 bits.
    """
    if not is_reading_type(dtype) and not (dtype.kind == "f" and dtype.itemsize in (4, 8)):
        raise ImageError(f"holds {dtype} pixels; {ONE_CHANNEL}")
    is_rgb = _is_rgb(shape)
    axes = shape[:-1] if is_rgb else shape
    if len(axes) < 2:
        raise ImageError(f"has {len(axes)} dimension{'s' if len(axes) > 1 else ''}; it must have rows and columns")
    *leading, rows, columns = axes
    check_size(rows, columns)
    count = math.prod(leading)
    if not count:
        raise ImageError("has no pages; copy the file again")
    if count > MAX_PAGES:
        raise ImageError(f"claims {count} pages, more than {MAX_PAGES}; copy the file again")
    bits = 8 * dtype.itemsize if is_reading_type(dtype) else 0
    return [Page((rows, columns), bits, colours=RGB if is_rgb else GREY)] * count


def find_page_index(page: int, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the index of a page along the leading axes of an array; () if it has none."""
    leading = shape[: -3 if _is_rgb(shape) else -2]
    return tuple(int(index) for index in np.unravel_index(page, leading)) if leading else ()


def _is_rgb(shape: tuple[int, ...]) -> bool:
    """Return whether the last axis of an array of this shape is that of red, green and blue."""
    return len(shape) > 2 and shape[-1] == RGB_CHANNELS
