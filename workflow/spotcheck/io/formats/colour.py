"""Of frames with colours the plane of one: a channel of RGB, or the pixels behind one filter of a raw Bayer frame.

Nothing is interpolated. Of a Bayer frame every second row and column is left, so that a pixel of what is read is two
pixels of the sensor wide, and pixel (x, y) lies at (2x + c, 2y + r) of the file, where (r, c) is the filter's place in
the upper left of the frame. The two greens are two planes: their pixels have different neighbours and, in many
sensors, different gains.
"""

from typing import NamedTuple

import numpy as np

from spotcheck.io.formats.page import CFA, GREY, RGB, Page, Refused

CHANNELS = ("red", "green", "blue")
# Planes of a Bayer frame: a green is called by the colour that it shares its rows with.
FILTERS = ("red", "green_r", "green_b", "blue")


class Colour(NamedTuple):
    """Which plane of its frames a dataset takes: `channel`, and in `bayer` the filters of the upper left four pixels,
    row by row, such as RGGB; None for frames without colours."""

    channel: str | None = None
    bayer: str | None = None

    @property
    def place(self) -> tuple[int, int]:
        """Row and column of the filter in the upper left of a Bayer frame."""
        assert self.bayer is not None and self.channel is not None
        letter = self.channel[0].upper()
        places = [divmod(k, 2) for k in range(4) if self.bayer[k] == letter]
        if letter == "G":
            beside = self.channel[-1].upper()
            places = [(row, column) for row, column in places if self.bayer[2 * row + 1 - column] == beside]
        return places[0]

    @property
    def step(self) -> int:
        """Pixels of the file from one pixel of the plane to the next."""
        return 2 if self.bayer else 1


NONE = Colour()


def plane_of(page: Page, colour: Colour) -> Page:
    """What is read of a page. Raises `Refused` where its colours are not those that the data sheet states."""
    if page.preview:
        return page
    if page.colours == RGB and (colour.bayer or not colour.channel):
        more = "without sensor.bayer, which raw frames have" if colour.bayer else "which one to take"
        raise Refused(f"has red, green and blue; sensor.channel in instrument.yaml must say {more}")
    if page.colours == GREY and colour.channel and not colour.bayer:
        raise Refused("has one channel; sensor.channel in instrument.yaml needs red, green and blue, or sensor.bayer")
    if page.colours not in (GREY, RGB) and not colour.bayer:
        raise Refused("is a raw frame behind colour filters; name them by sensor.bayer and sensor.channel")
    if page.colours not in (GREY, RGB, CFA) and page.colours != colour.bayer:
        raise Refused(f"says that its filters are {page.colours}, and sensor.bayer is {colour.bayer}; correct the key")
    if not colour.bayer:
        return page
    rows, columns = page.shape
    if rows % 2 or columns % 2:
        raise Refused(f"has {columns} × {rows} px; a Bayer frame must have even numbers of both")
    return page._replace(shape=(rows // 2, columns // 2))


def plane(pixels: np.ndarray, colour: Colour) -> np.ndarray:
    """The plane [rows, columns] of an image [rows, columns] or [rows, columns, colours]."""
    if pixels.ndim == 3:
        return np.ascontiguousarray(pixels[..., CHANNELS.index(colour.channel or "")])
    if not colour.bayer:
        return pixels
    row, column = colour.place
    return np.ascontiguousarray(pixels[row::2, column::2])
