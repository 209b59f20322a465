"""One colour plane of a frame with colours: a channel of RGB, or the pixels behind one filter of a raw Bayer frame.

Nothing is interpolated. A plane of a Bayer frame holds every second row and column of the file, so its pixel pitch is
twice that of the sensor. Pixel (x, y) of the plane is pixel (2x + c, 2y + r) of the file, where (r, c) is the row and
column of the filter in the upper left of the frame. The two greens are two planes: their pixels have different
neighbours and, in many sensors, different gains.
"""

from typing import NamedTuple

import numpy as np

from spotcheck.io.formats.page import CFA, GREY, RGB, ImageError, Page

CHANNELS = ("red", "green", "blue")
# Planes of a Bayer frame: a green is named after the colour that shares its rows.
FILTERS = ("red", "green_r", "green_b", "blue")


class Colour(NamedTuple):
    """Colour plane that is read from the frames of a dataset."""

    channel: str | None = None  # one of `CHANNELS` or, with `bayer`, of `FILTERS`; None: frames without colours
    bayer: str | None = None  # filters of the upper left 2 × 2 pixels, row by row, such as "RGGB"; None: not Bayer

    @property
    def offset(self) -> tuple[int, int]:
        """Row and column, 0 or 1, of the filter in the upper left 2 × 2 pixels of a Bayer frame."""
        assert self.bayer is not None and self.channel is not None
        letter, row_letter = self.channel[0].upper(), self.channel[-1].upper()
        # Indices of the filters of this colour, which count row by row.
        indices = [index for index in range(4) if self.bayer[index] == letter]
        if letter == "G":
            # green_r and green_b differ in the other filter of their row, whose index is index ^ 1.
            indices = [index for index in indices if self.bayer[index ^ 1] == row_letter]
        return divmod(indices[0], 2)

    @property
    def step(self) -> int:
        """Distance between neighbouring pixels of the plane, in pixels of the file."""
        return 2 if self.bayer else 1


MONOCHROME = Colour()


def select_plane(page: Page, colour: Colour) -> Page:
    """Return the header of one colour plane of a page; that of a preview is unchanged.

    Parameters
    ----------
    page : header of the page as it is stored.
    colour : colour plane that instrument.yaml selects.

    Raises
    ------
    ImageError
        If the colours of the page are not those that `sensor` in instrument.yaml states.
    """
    if page.preview:
        return page
    if page.colours == RGB and (colour.bayer or not colour.channel):
        advice = "without sensor.bayer, which raw frames have" if colour.bayer else "which one to take"
        raise ImageError(f"has red, green and blue; sensor.channel in instrument.yaml must say {advice}")
    if page.colours == GREY and colour.channel and not colour.bayer:
        raise ImageError("has one channel; sensor.channel in instrument.yaml needs red, green and blue or sensor.bayer")
    if page.colours not in (GREY, RGB) and not colour.bayer:
        raise ImageError("is a raw frame behind colour filters; name them by sensor.bayer and sensor.channel")
    if page.colours not in (GREY, RGB, CFA) and page.colours != colour.bayer:
        raise ImageError(f"says that its filters are {page.colours}, and sensor.bayer is {colour.bayer}; correct it")
    if not colour.bayer:
        return page
    rows, columns = page.shape
    if rows % 2 or columns % 2:
        raise ImageError(f"has {columns} × {rows} px; a Bayer frame must have even numbers of both")
    return page._replace(shape=(rows // 2, columns // 2))


def extract_plane(pixels: np.ndarray, colour: Colour) -> np.ndarray:
    """Return one colour plane [row, column] of an image [row, column] or [row, column, channel].

    The image must have the colours that `select_plane` checks; one without colours is returned unchanged.
    """
    if pixels.ndim == 3:
        return np.ascontiguousarray(pixels[..., CHANNELS.index(colour.channel or "")])
    if not colour.bayer:
        return pixels
    row, column = colour.offset
    return np.ascontiguousarray(pixels[row::2, column::2])
