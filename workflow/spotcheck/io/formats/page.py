"""What every format says of a page, and what no file is believed."""

from typing import NamedTuple

# Largest frame that is decoded [px]: twice the largest sensor on sale (some 250 Mpx), so that a broken or hostile
# header that claims more is refused before memory is asked for.
MOST_PIXELS = 500_000_000
# Bytes that deflate makes of one at most (RFC 1951: runs of 258 bytes in two bits): no honest file promises more.
DEFLATE_RATIO = 1032
PREVIEW = "is but a preview or mask of another image (NewSubfileType); name the page that holds the image"
ONE_CHANNEL = "it must be one channel of 8 to 16 bit unsigned integers"


# Colours of a page: one channel, three, or a raw frame behind filters, whose letters a file may name instead.
GREY, RGB, CFA = "", "RGB", "CFA"


class Page(NamedTuple):
    """One page: rows and columns [px], bits of a stored pixel (0: a floating-point number), whether it is but a
    preview of another, and its colours: none, `RGB`, `CFA` or the letters of its filters such as `RGGB`."""

    shape: tuple[int, int]
    bits: int
    preview: bool = False
    colours: str = GREY


class Refused(ValueError):
    """A page that is not read; the text says why and what would be right, to stand behind the file's name."""


def check_size(rows: int, columns: int) -> None:
    """Raise `Refused` for a page without pixels, or with more than are decoded."""
    if rows < 1 or columns < 1:
        raise Refused("has no pixels; copy the file again")
    if rows * columns > MOST_PIXELS:
        raise Refused(f"claims {columns} × {rows} px, more than {MOST_PIXELS} pixels in all; copy the file again")


def check_length(needed: int, length: int) -> None:
    """Raise `Refused` where a file of `length` bytes cannot hold the `needed` bytes of its pixels."""
    if length < needed:
        raise Refused(f"is cut short: its pixels need {needed} bytes and it has {length}; copy the file again")
