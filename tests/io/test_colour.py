"""Planes of frames with colours: RGB and raw Bayer."""

import imagecodecs
import numpy as np
import pytest
import tifffile
from PIL import Image

from spotcheck.dataset import folder as dataset
from spotcheck.dataset import frames
from spotcheck.dataset.instrument import Sensor
from spotcheck.errors import InputError
from spotcheck.io.formats import files
from spotcheck.io.formats.colour import CHANNELS, FILTERS, Colour
from tests.samples.small_datasets import folder

ROWS, COLUMNS = 20, 32
RGB = (np.arange(ROWS * COLUMNS * 3, dtype=np.uint16) * 31).reshape(ROWS, COLUMNS, 3)
RAW = (np.arange(ROWS * COLUMNS, dtype=np.uint16) * 6).reshape(ROWS, COLUMNS)
# Places of the filters as the standard names of the patterns have them, row by row from the upper left.
PLACES = {
    "RGGB": {"red": (0, 0), "green_r": (0, 1), "green_b": (1, 0), "blue": (1, 1)},
    "BGGR": {"blue": (0, 0), "green_b": (0, 1), "green_r": (1, 0), "red": (1, 1)},
    "GRBG": {"green_r": (0, 0), "red": (0, 1), "blue": (1, 0), "green_b": (1, 1)},
    "GBRG": {"green_b": (0, 0), "blue": (0, 1), "red": (1, 0), "green_r": (1, 1)},
}


WRITERS = {
    "interleaved TIFF": lambda path: tifffile.imwrite(path, RGB, photometric="rgb"),
    "TIFF in planes": lambda path: tifffile.imwrite(path, np.moveaxis(RGB, -1, 0).copy(), photometric="rgb"),
    "packed TIFF": lambda path: tifffile.imwrite(path, RGB, photometric="rgb", compression="zlib", predictor=True),
    "PNG": lambda path: path.write_bytes(imagecodecs.png_encode(RGB)),
    "NumPy": lambda path: np.save(path.open("wb"), RGB),
}


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("channel", CHANNELS)
def test_a_channel_of_rgb(tmp_path, kind, channel):
    """All sixteen bits of it, and the size of the frame."""
    WRITERS[kind](tmp_path / "a.tif")
    taken = Colour(channel)
    assert [page.shape for page in files.list_pages(tmp_path / "a.tif", "a", taken)] == [(ROWS, COLUMNS)]
    read = files.read_pixels(tmp_path / "a.tif", 0, "a", taken)
    np.testing.assert_array_equal(read, RGB[..., CHANNELS.index(channel)])


def test_a_channel_of_eight_bits(tmp_path):
    """As most cameras save colours."""
    Image.fromarray(RGB.astype(np.uint8)).save(tmp_path / "a.png")
    np.testing.assert_array_equal(
        files.read_pixels(tmp_path / "a.png", 0, "a", Colour("green")), RGB[..., 1].astype(np.uint8)
    )


@pytest.mark.parametrize("pattern", PLACES)
@pytest.mark.parametrize("channel", FILTERS)
def test_a_plane_of_bayer(tmp_path, pattern, channel):
    """Pixel (x, y) is that at (2x + c, 2y + r); the greens are told apart by the colour of their rows."""
    tifffile.imwrite(tmp_path / "a.tif", RAW, photometric="minisblack")
    taken, (row, column) = Colour(channel, pattern), PLACES[pattern][channel]
    assert files.list_pages(tmp_path / "a.tif", "a", taken)[0].shape == (ROWS // 2, COLUMNS // 2)
    read = files.read_pixels(tmp_path / "a.tif", 0, "a", taken)
    assert all(read[y, x] == RAW[2 * y + row, 2 * x + column] for y in range(ROWS // 2) for x in range(COLUMNS // 2))


def test_tiff_that_names_its_filters(tmp_path):
    """PhotometricInterpretation CFA with CFAPattern: it must be what the data sheet says."""
    tags = [(33421, 3, 2, (2, 2), True), (33422, 1, 4, (1, 0, 2, 1), True)]
    tifffile.imwrite(tmp_path / "a.tif", RAW, photometric="cfa", extratags=tags)
    read = files.read_pixels(tmp_path / "a.tif", 0, "a", Colour("red", "GRBG"))
    np.testing.assert_array_equal(read, RAW[0::2, 1::2])
    with pytest.raises(InputError, match=r"a: says that its filters are GRBG, and sensor\.bayer is RGGB"):
        files.list_pages(tmp_path / "a.tif", "a", Colour("red", "RGGB"))


@pytest.mark.parametrize(
    ("image", "taken", "words"),
    [
        (RGB, Colour(), "has red, green and blue; sensor.channel in instrument.yaml must say which"),
        (RGB, Colour("red", "RGGB"), "without sensor.bayer"),
        (RAW, Colour("red"), "has one channel"),
        (RAW[1:], Colour("red", "RGGB"), "32 × 19 px; a Bayer frame must have even numbers of both"),
    ],
)
def test_colours_that_are_not_there(tmp_path, image, taken, words):
    """Frames and data sheet contradict each other."""
    tifffile.imwrite(tmp_path / "a.tif", image, photometric="rgb" if image.ndim == 3 else "minisblack")
    with pytest.raises(InputError, match=words):
        files.list_pages(tmp_path / "a.tif", "a", taken)


def bayer(base, more: str = "", **mask):
    """A dataset of a raw Bayer frame."""
    rows = ["frames/a.tif,spot,0,1e-4,0"]
    found = folder(base, rows, f"crop_px: 8\nsensor: {{channel: green_b, bayer: RGGB, pixel_pitch_m: 2e-6}}\n{more}")
    tifffile.imwrite(base / "frames" / "a.tif", RAW, photometric="minisblack")
    return dataset.load(found)


def test_the_pitch_is_that_of_the_plane(tmp_path):
    """Two pixels of the sensor."""
    found = bayer(tmp_path)
    assert found.instrument.sensor == Sensor(pixel_pitch_m=4e-6, channel="green_b", bayer="RGGB")
    assert frames.check_formats(found).shape == (ROWS // 2, COLUMNS // 2)


def test_bad_pixels_are_those_of_the_sensor(tmp_path):
    """Columns, rows and pixels count on the whole frame; those behind other filters are not read."""
    found = bayer(tmp_path, "bad_pixels: {columns: [4], rows: [8], pixels: [[6, 3], [7, 5]]}")
    wanted = np.zeros((ROWS, COLUMNS), bool)
    wanted[:, 4], wanted[8], wanted[3, 6], wanted[5, 7] = True, True, True, True
    bad = np.isnan(frames.read_masked_image(found, found.frames[0]))
    np.testing.assert_array_equal(bad, wanted[1::2, 0::2])
    assert bad.sum() == ROWS // 2 + 1


def test_a_mask_of_bad_pixels_has_the_size_of_the_sensor(tmp_path):
    """So that it is made of the same frames."""
    mask = np.zeros((ROWS, COLUMNS), np.uint8)
    mask[3, 6] = mask[4, 6] = 1
    (tmp_path / "frames").mkdir()
    Image.fromarray(mask).save(tmp_path / "mask.png")
    found = bayer(tmp_path, "bad_pixels: {mask: mask.png}")
    assert np.argwhere(np.isnan(frames.read_masked_image(found, found.frames[0]))).tolist() == [[1, 3]]
