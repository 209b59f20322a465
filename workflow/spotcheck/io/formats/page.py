"""Header of a page of an image file, the error for images that cannot be used, and checks of stated sizes.

A page is one image of a file; a file with several pages is a stack.
"""

from typing import NamedTuple

# Largest frame that is decoded [px]: twice the largest sensor on sale (some 250 Mpx). A broken or hostile header that
# claims more is refused before memory is allocated.
MAX_PIXELS = 500_000_000
# Largest ratio of unpacked to packed bytes of deflate (RFC 1951: runs of 258 bytes in two bits).
DEFLATE_RATIO = 1032
# Parts of messages of several readers.
PREVIEW_MESSAGE = "is a preview or mask of another image (NewSubfileType); name the page that holds the image"
ONE_CHANNEL = "it must be one channel of 8 to 16 bit unsigned integers"

# Colours of a page: one channel, three channels, or a raw frame behind a colour filter array of unknown layout.
GREY, RGB, CFA = "", "RGB", "CFA"


class Page(NamedTuple):
    """Header of one page."""

    shape: tuple[int, int]  # rows and columns [px]
    bits: int  # bits of a stored pixel; 0 for floating-point numbers
    preview: bool = False  # whether the page is only a preview or mask of another page
    colours: str = GREY  # GREY, RGB, CFA, or the filters of the upper left 2 × 2 pixels, such as "RGGB"


class ImageError(ValueError):
    """The image cannot be used; the text says why and what to do, and follows the name of the file."""


def check_size(rows: int, columns: int) -> None:
    """Raise `ImageError` for a page [px] with no pixels or with more than `MAX_PIXELS`."""
    if rows < 1 or columns < 1:
        raise ImageError("has no pixels; copy the file again")
    if rows * columns > MAX_PIXELS:
        raise ImageError(f"claims {columns} × {rows} px, more than {MAX_PIXELS} pixels in all; copy the file again")


def check_length(needed: int, length: int) -> None:
    """Raise `ImageError` if a file of `length` bytes is too short for the `needed` bytes of its pixels."""
    if length < needed:
        raise ImageError(f"is cut short: its pixels need {needed} bytes and it has {length}; copy the file again")
