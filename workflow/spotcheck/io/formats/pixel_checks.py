"""Checks of decoded pixels that are no readings: swapped bytes, and a scale of colours in place of brightness."""

import numpy as np

from spotcheck.io.formats.page import ImageError

# Largest high byte of a reading of 14 bits: cameras of 16 bits leave no trace when their bytes are swapped.
LARGEST_HIGH_BYTE = 63
# Least number of different values of 16 bits in an image of swapped bytes, and of different values of their high byte.
# By chance, all low bytes are at most 63 in one image of 4^64.
FEWEST_VALUES, FEWEST_HIGH_BYTES = 64, 16
# Pixels that are looked at first [px], since they nearly always show that a check does not apply.
FIRST_PIXELS = 4096
# Most colours of an image in false colours: 256 of the scale, and some of marks. Noise gives an RGB image more.
MOST_COLOURS = 320
# Least number of pixels per colour in such an image: in a smaller one, noise has not shown all its colours.
FEWEST_PIXELS_PER_COLOUR = 16
# Least number of colours by which such an image is recognized, and least share of them that is far from a straight line
# through all: marks in other colours are fewer.
FEWEST_COLOURS, OFF_LINE_SHARE = 32, 0.1
# Distance from the line that is far: as a part of the range of the channels, and in steps of a channel. A tint and
# crosstalk give lines. Where noise leaves no more than MOST_COLOURS, its standard deviation is below one step if the
# range has 30 steps, and lower if it has more.
FAR_FROM_LINE, FAR_STEPS = 0.05, 8


def check_byte_order(pixels: np.ndarray) -> None:
    """Raise `ImageError` if the two bytes of each pixel are swapped.

    The low bytes are then the high bytes of readings, which are small if the camera has fewer than 16 bits.

    Parameters
    ----------
    pixels : image [row, column] or [row, column, channel]; types other than uint16 pass.
    """
    if pixels.dtype != np.uint16 or np.any(pixels.ravel()[:FIRST_PIXELS] & 255 > LARGEST_HIGH_BYTE):
        return
    # Whether a pair of bytes occurs [high byte, low byte].
    occurs = np.zeros((256, 256), bool)
    for row in pixels:
        occurs.reshape(-1)[row] = True
    high_bytes = occurs.any(axis=1)
    if (
        occurs[:, LARGEST_HIGH_BYTE + 1 :].any()
        or np.count_nonzero(occurs) < FEWEST_VALUES
        or np.count_nonzero(high_bytes) < FEWEST_HIGH_BYTES
    ):
        return
    lowest = occurs[high_bytes].argmax(axis=1)
    highest = 255 - occurs[high_bytes, ::-1].argmax(axis=1)
    # Readings of 8 bits times 256 or 257 have small low bytes too; these never fall as the high byte rises.
    if np.any(np.maximum.accumulate(highest)[:-1] > lowest[1:]):
        raise ImageError(
            f"has its high and low bytes swapped: no low byte is above {highest.max()}; save it in the other byte order"
        )


def check_colours(pixels: np.ndarray) -> None:
    """Raise `ImageError` if colours stand for brightness, as after a colour map: no channel is a reading.

    The colours of such an image form a curve, and few different ones occur. They form a straight line along which all
    channels rise if grey was saved as RGB or tinted, which is not refused.

    Parameters
    ----------
    pixels : image [row, column, channel] of unsigned integers.
    """
    flat = pixels.reshape(-1, pixels.shape[-1])
    # A sample over the whole image, as its border may be dark.
    sample = flat[:: max(1, len(flat) // (16 * FIRST_PIXELS))]
    if len(_list_colours(sample)) > MOST_COLOURS:
        return
    colours = _list_colours(flat)
    if not FEWEST_COLOURS <= len(colours) <= min(MOST_COLOURS, len(flat) // FEWEST_PIXELS_PER_COLOUR):
        return
    tolerance = max(FAR_FROM_LINE * np.ptp(colours, axis=0).max(), FAR_STEPS)
    # The channel with most levels follows the line best.
    reference = max(colours.T, key=lambda channel: len(np.unique(channel)))
    design = np.stack([reference, np.ones_like(reference)], axis=1)
    coefficients = np.linalg.lstsq(design, colours, rcond=None)[0]
    is_off_line = np.any(np.abs(colours - design @ coefficients) > tolerance, axis=1)
    # More light never lowers a channel.
    has_falling_channel = np.any(coefficients[0] * np.ptp(reference) < -tolerance)
    if has_falling_channel or np.mean(is_off_line) >= OFF_LINE_SHARE:
        raise ImageError(
            f"is in false colours: its {len(colours)} colours are a scale of brightness, and no channel is a reading;"
            " save the image of the camera without a colour map"
        )


def _list_colours(flat: np.ndarray) -> np.ndarray:
    """Return the different colours among pixels [pixel, channel] as float64 [colour, channel]."""
    # The channels of a pixel and zeros fill an integer of 8 bytes, which is sorted much faster than rows of an array.
    padded = np.zeros((len(flat), 8 // flat.dtype.itemsize), flat.dtype)
    padded[:, : flat.shape[1]] = flat
    colours = np.unique(padded.view(np.uint64)).view(flat.dtype).reshape(-1, padded.shape[1])
    return colours[:, : flat.shape[1]].astype(float)
