"""Where the spot is, and the crop around it."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from spotcheck.crops import spotfinding
from spotcheck.crops.cropping import CENTRINGS, is_usable
from spotcheck.crops.ingest import ingest_frames
from spotcheck.crops.spotfinding import Spot
from spotcheck.io import store
from tests.samples.small_datasets import SENSOR, crops_of, gaussian, loaded, noisy

SIDE = 300


def flags(status) -> set[str]:
    """Names of the flags that are set."""
    return {name for bit, (name, _) in store.STATUS.items() if int(status) & bit}


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("sigma", [3.0, 12.0])
def test_hot_pixels_brighter_than_the_spot(seed, sigma):
    """One pixel in a thousand reads full scale: the centroid stays, the brightest pixel goes astray."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(60, SIDE - 60, 2)
    pixels = noisy(gaussian(SIDE, 300.0, x, y, sigma), seed)
    hot = rng.random(pixels.shape) < 1e-3
    pixels[hot] = 1023
    spot = spotfinding.find_light_centroid(pixels, 120)
    # Half a pixel of rounding, and half a pixel for hot pixels on the flank that shift the region's border.
    assert spot.exists and abs(spot.column - x) < 1.0 and abs(spot.row - y) < 1.0
    first = spotfinding.find_brightest_pixel(pixels)
    columns = np.nonzero(pixels.max(axis=0) == 1023)[0]
    assert first.column == columns[0] and pixels[first.row, first.column] == 1023


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (31, 40)])
def test_median_of_nine(shape):
    """As scipy has it, ties and borders included."""
    image = np.random.default_rng(3).integers(0, 9, shape).astype(np.float32)
    np.testing.assert_array_equal(spotfinding.median_filter_3x3(image), ndimage.median_filter(image, 3, mode="nearest"))


BORDERS = [
    (side, gap, sigma)
    for side in ("left", "right", "top", "bottom")
    for gap in (0.0, 4.0, 8.0, 20.0)
    for sigma in (2.0, 10.0)
]


@pytest.mark.parametrize(("corner", "gap", "sigma"), BORDERS)
def test_a_spot_at_the_border_is_masked_and_not_shifted(corner, gap, sigma):
    """The crop keeps the spot at its middle; beyond the frame it is NaN."""
    far = SIDE - 1 - gap
    x, y = {"left": (gap, 150.0), "right": (far, 150.0), "top": (150.0, gap), "bottom": (150.0, far)}[corner]
    pixels = noisy(gaussian(SIDE, 600.0, x, y, sigma), 5)
    spot = spotfinding.find_light_centroid(pixels, 120)
    # A spot that is cut by the border has its centroid inside: by σ times the mean of a half normal, and 1 px.
    slack = 1.0 + sigma * np.sqrt(2 / np.pi) * (gap < 2 * sigma)
    assert spot.exists and abs(spot.column - x) <= slack and abs(spot.row - y) <= slack
    crop = spotfinding.cut_crop(pixels, spot, 120)
    assert crop[60, 60] == pixels[spot.row, spot.column]
    row, column = np.mgrid[:120, :120] + np.array([spot.row - 60, spot.column - 60])[:, None, None]
    inside = (row >= 0) & (row < SIDE) & (column >= 0) & (column < SIDE)
    np.testing.assert_array_equal(np.isfinite(crop), inside)
    np.testing.assert_array_equal(crop[inside], pixels[row[inside], column[inside]])


def test_of_several_equal_maxima_the_left_most_then_the_top_most():
    """Section 3.1.1's rule on a plateau with a dent at its upper left corner."""
    pixels = np.zeros((50, 60), np.uint16)
    pixels[20:30, 31:40] = 800
    pixels[22:30, 30] = 800
    assert spotfinding.find_brightest_pixel(pixels) == Spot(22, 30, True)


NOISES = [(level, dn) for level in (40.0, 0.0) for dn in (0.3, 0.6, 0.9, 1.2, 1.43, 2.5, 8.0)]


@pytest.mark.parametrize(("level", "noise_dn"), NOISES)
def test_a_frame_without_light_has_no_spot(level, noise_dn):
    """Read noise alone, with the converter's zero far away and at its middle: none of six frames; nor equal pixels.

    The largest of 14,400 medians of nine is 1.9 noises above their middle; a spot starts at 5.
    """
    own = replace(SENSOR, black_level_dn=level, read_noise_e=noise_dn / 0.11)
    dark = [noisy(np.zeros((SIDE, SIDE)), seed, own) for seed in range(6)]
    flat = [np.full((SIDE, SIDE), value, np.uint16) for value in (0, 40, 1023)]
    assert not any(spotfinding.find_light_centroid(pixels, 120).exists for pixels in (*dark, *flat))


# Width [px], and the peak over the noise of a pixel from which on every spot is found: a narrow one has few pixels to
# tell it from a hot pixel by.
CLEAR = [(0.7, 60), (0.85, 32), (1.0, 22), (1.5, 13), (2.0, 12), (3.0, 11), (5.0, 10), (12.0, 9), (40.0, 9)]


@pytest.mark.parametrize(("sigma", "over_noise"), CLEAR)
@pytest.mark.parametrize("place", ["anywhere", "between blocks"])
def test_a_spot_of_any_width_is_found_with_a_crop_of_ten_widths(sigma, over_noise, place):
    """Thirty spots each, or three of the widest, at random and where four blocks of the search meet."""
    rng, side, crop = np.random.default_rng(int(10 * sigma)), 640 if sigma > 20 else SIDE, max(8, int(10 * sigma))
    noise_dn = np.hypot(SENSOR.gain_dn_per_e * SENSOR.read_noise_e, np.sqrt(1 / 12))
    for seed in range(3 if sigma > 20 else 30):
        x, y = rng.uniform(5 * sigma + 1, side - 5 * sigma - 1, 2)
        if place == "between blocks":
            x, y = 16 * np.clip(np.round(np.array([x, y]) / 16), 1, side // 16 - 1) - 0.5
        spot = spotfinding.find_light_centroid(noisy(gaussian(side, over_noise * noise_dn, x, y, sigma), seed), crop)
        # Noise shifts the region's border: by less than a pixel, or a third of the width.
        slack = max(1.5, sigma / 3)
        assert spot.exists and abs(spot.column - x) < slack and abs(spot.row - y) < slack


@pytest.mark.parametrize("sigma", [0.8, 2.0])
def test_a_narrow_spot_on_uneven_light(sigma):
    """Light that rises by 28 noises across the frame holds more of it in every block than the spot does."""
    rise = 40.0 * np.arange(SIDE) / SIDE
    for seed in range(6):
        x, y = np.random.default_rng(seed).uniform(30, 200, 2)
        spot = spotfinding.find_light_centroid(noisy(gaussian(SIDE, 400.0, x, y, sigma) + rise, seed), 30)
        assert spot.exists and abs(spot.column - x) < 1.5 and abs(spot.row - y) < 1.5


@pytest.mark.parametrize("value", [0, 1023])
@pytest.mark.parametrize("line", [np.s_[:, 93], np.s_[170]], ids=["column", "row"])
def test_a_stuck_line_and_hot_pixels_are_no_spot(line, value):
    """One pixel in 2000 at full scale and a line at either end, in frames without light."""
    for seed in range(6):
        pixels = noisy(np.zeros((SIDE, SIDE)), seed)
        pixels[np.random.default_rng(seed).random(pixels.shape) < 5e-4] = 1023
        pixels[line] = value
        assert not spotfinding.find_light_centroid(pixels, 24).exists


@pytest.mark.parametrize("shape", [(40, 300), (300, 40), (24, 24)])
def test_frames_that_are_sub_windows(shape):
    """Narrow read-out windows: the spot is found where it is."""
    light = gaussian(300, 500.0, shape[1] * 0.5, shape[0] * 0.5, 4.0)[: shape[0], : shape[1]]
    spot = spotfinding.find_light_centroid(noisy(light, 3), min(shape))
    assert spot.exists and abs(spot.column - shape[1] / 2) <= 1 and abs(spot.row - shape[0] / 2) <= 1


@pytest.fixture
def cropped(tmp_path):
    """Crops of five frames: a spot, one at the border, no light, overexposed throughout, overexposed in its middle."""
    images = [
        noisy(gaussian(SIDE, 500.0, 150.3, 140.0, 8.0), 1),
        noisy(gaussian(SIDE, 500.0, 20.0, 140.0, 8.0), 2),
        noisy(np.zeros((SIDE, SIDE)), 3),
        np.full((SIDE, SIDE), 1023, np.uint16),
        noisy(gaussian(SIDE, 3000.0, 150.0, 150.0, 8.0), 4),
    ]
    ds = loaded(tmp_path / "data", images, "crop_px: 100\nsensor: {bit_depth: 10}")
    return ds, images, ingest_frames(ds), crops_of(ds)


def test_status_of_a_crop(cropped):
    """Each frame's flags, and none else."""
    *_, ds = cropped
    got = [flags(s) for s in ds["status"].sel(centring="light").values.ravel()]
    got[2:4] = [g - {"masked"} for g in got[2:4]]  # where there is no spot, its place is anyone's guess
    assert got == [set(), {"masked"}, {"black"}, {"saturated"}, {"clipped"}]
    assert [is_usable(s) for s in ds["status"].sel(centring="light").values.ravel()] == [True, True, 0, 0, True]


def test_a_crop_is_the_frame_at_top_and_left(cropped):
    """Both centrings; the coordinates lead back to the frame."""
    ds_in, images, _, ds = cropped
    for centring in CENTRINGS:
        own = ds.sel(centring=centring).isel(angle=0, exposure=0, repeat=0)
        top, left = int(own["top"]), int(own["left"])
        np.testing.assert_array_equal(own["image"], images[0][top : top + 100, left : left + 100])
    own = ds.sel(centring="maximum").isel(angle=0, exposure=0, repeat=0)["image"]
    assert float(own[50, 50]) == images[0].max()
    assert ds_in.shape == (1, 1, 5) and ds["image"].dims[:3] == ("angle", "exposure", "repeat")


def test_the_table_of_frames(cropped):
    """Extremes, clipped and zero pixels by direct count; the digest is that of the file."""
    ds_in, images, table, _ = cropped
    assert table["maximum"].values.tolist() == [int(p.max()) for p in images]
    assert table["minimum"].values.tolist() == [int(p.min()) for p in images]
    assert table["at_full_scale"].values.tolist() == [int((p == 1023).sum()) for p in images]
    assert table["at_zero"].values.tolist() == [int((p == 0).sum()) for p in images]
    want = hashlib.sha256((ds_in.folder / "frames/f0.tif").read_bytes()).hexdigest()
    assert table["sha256"].values[0] == want
    assert (int(table["rows"]), int(table["columns"]), int(table["full_scale"])) == (SIDE, SIDE, 1023)
