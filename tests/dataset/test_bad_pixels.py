"""Pixels that instrument.yaml names as bad: measured nowhere, in any of three forms, or refused."""

import numpy as np
import pytest
import tifffile

from spotcheck.characterization import frame_pairs, levels
from spotcheck.crops import spotfinding
from spotcheck.crops.cropping import crop_spots
from spotcheck.crops.ingest import check_dataset, ingest_frames
from spotcheck.dataset import folder as dataset
from spotcheck.dataset import frames
from spotcheck.errors import InputError
from spotcheck.fitting.crop_fits import fit_crops
from spotcheck.io import store
from tests.samples.small_datasets import SENSOR, gaussian, loaded, noisy

SIDE, X, Y, SIGMA, COLUMN, ROW = 150, 70.3, 81.6, 6.0, 73, 85
YAML = "crop_px: 80\nsensor: {bit_depth: 10}\n"
FORMS = {
    "lines": f"bad_pixels: {{columns: [{COLUMN}], rows: [{ROW}]}}",
    "mask": "bad_pixels: {mask: masks/bad.tif}",
    "pixels": "bad_pixels:\n  pixels: " + str([[COLUMN, y] for y in range(SIDE)] + [[x, ROW] for x in range(SIDE)]),
}
BAD = np.zeros((SIDE, SIDE), bool)
BAD[:, COLUMN] = BAD[ROW] = True


def spoilt(seed: int, value: int) -> np.ndarray:
    """A spot on a sensor whose column and row are stuck."""
    pixels = noisy(gaussian(SIDE, 500.0, X, Y, SIGMA), seed)
    pixels[BAD] = value
    return pixels


def folder(tmp_path, images, form, instrument=YAML):
    """A loaded dataset whose instrument.yaml names the bad pixels."""
    (tmp_path / "data/masks").mkdir(parents=True)
    tifffile.imwrite(tmp_path / "data/masks/bad.tif", 7 * BAD.astype(np.uint8))
    return loaded(tmp_path / "data", images, f"{instrument}{FORMS.get(form, form)}\n")


def cropped(found, path):
    """Its table of frames and its crops."""
    table = ingest_frames(found)
    crop_spots(found, table, path / "crops.nc", code="c", inputs=[])
    return table, store.read_whole(path / "crops.nc")


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("value", [0, 1023])
def test_a_bad_pixel_enters_nothing(tmp_path, form, value):
    """Table, crops, means and fit are those of the other pixels; the truth within 4.5 errors, false alarm 7e-6 each."""
    images = [spoilt(seed, value) for seed in range(3)]
    found = folder(tmp_path, images, form)
    table, ds = cropped(found, tmp_path)
    good = [np.where(BAD, np.nan, image) for image in images]
    np.testing.assert_array_equal(table["maximum"], np.nanmax(good, axis=(1, 2)))
    np.testing.assert_array_equal(table["minimum"], np.nanmin(good, axis=(1, 2)))
    np.testing.assert_allclose(table["mean"], np.nanmean(good, axis=(1, 2)), rtol=1e-12)
    assert int(table["at_full_scale"].sum()) == 0 and not ds["status"].values.any()
    own = ds.sel(centring="light").isel(angle=0, exposure=0)
    np.testing.assert_allclose(own["column_mean"][0], np.nanmean(np.where(BAD.all(axis=0), 0, good[0]), axis=0)
                               * np.where(BAD.all(axis=0), np.nan, 1), rtol=1e-6)  # fmt: skip
    for k, image in enumerate(good):
        top, left = int(own["top"][k]), int(own["left"][k])
        np.testing.assert_array_equal(own["image"][k], image[top : top + 80, left : left + 80])
        block = np.nanmean(image[64:128, 64:128])
        assert float(own["block_mean"][k, 1, 1]) == pytest.approx(block, rel=1e-6)
    fits = fit_crops(ds, SENSOR).sel(centring="light", fit="likelihood")
    for name, truth in (("x_centre", X), ("y_centre", Y), ("sigma_mean", SIGMA), ("amplitude", 500.0)):
        assert (abs(fits[name] - truth) < 4.5 * fits[f"{name}_stderr"]).all(), name


@pytest.mark.parametrize(("sigma", "over_noise"), [(0.8, 60), (3.0, 15), (20.0, 10)])
def test_the_spot_is_found_beside_bad_pixels(sigma, over_noise):
    """Five columns at full scale, wherever the spot is, and on top of it."""
    noise_dn = np.hypot(SENSOR.gain_dn_per_e * SENSOR.read_noise_e, np.sqrt(1 / 12))
    for seed, x in enumerate((40.0, 70.0, 76.2)):
        image = noisy(gaussian(SIDE, over_noise * noise_dn, x, 80.0, sigma), seed).astype(np.float32)
        image[:, 72:75] = np.nan
        spot = spotfinding.find_light_centroid(image, 60)
        assert spot.exists and abs(spot.column - x) < max(1.5, sigma / 3) and abs(spot.row - 80) < max(1.5, sigma / 3)
        assert not np.isnan(image[spotfinding.find_brightest_pixel(image)[:2]])


def test_levels_of_flats_are_those_of_the_good_pixels():
    """Mean, noise in time and pattern against plain numpy on the columns that are left."""
    rng = np.random.default_rng(4)
    pattern = rng.normal(0, 3, (60, 50)) + rng.normal(0, 2, 50)
    images = [400 + pattern + rng.normal(0, 5, (60, 50)) for _ in range(4)]
    spoilt = [image.copy() for image in images]
    for image in spoilt:
        image[:, 13] = np.nan
    want, got = (
        levels.measure_level(own, "flat", 1e-3, np.nan, 4095.0)
        for own in ([np.delete(i, 13, 1) for i in images], spoilt)
    )
    assert (got.mean, got.variance, got.at_full) == pytest.approx((want.mean, want.variance, want.at_full), rel=1e-12)
    # The split into columns counts one column more than there is, which is a fiftieth of what columns hold.
    np.testing.assert_allclose(got.pattern, want.pattern, atol=0.02 * want.pattern.total)


def test_a_gap_costs_pairs_of_frames_no_more_than_its_blocks():
    """Levels and squares of two frames of a site, with a pixel missing, against those with its blocks cut away."""
    one, two = (noisy(gaussian(100, 500.0, 50, 50, 20.0), seed).astype(float) for seed in (1, 2))
    whole = frame_pairs.tally_differences(one, two, 40.0, 1023.0)[0].sum()
    one[44, 57] = np.nan
    left = frame_pairs.tally_differences(one, two, 40.0, 1023.0)[0].sum()
    assert whole - left == frame_pairs.SIDE**2


WRONG = {
    "bad_pixels: {columns: [150]}": "key bad_pixels.columns names x = 150, but the frames have 150 × 150 px",
    "bad_pixels: {rows: [3, 151]}": "key bad_pixels.rows names y = 151, but the frames have 150 × 150 px",
    "bad_pixels: {pixels: [[3, 4], [2, 150]]}": "key bad_pixels.pixels names y = 150",
    "bad_pixels: {pixels: [3, 4]}": "key bad_pixels.pixels",
    "bad_pixels: {columns: [-1]}": "key bad_pixels.columns",
    "bad_pixels: {mask: nothing.tif}": "key bad_pixels.mask names 'nothing.tif', which is not there; it must be the",
    "bad_pixels: {mask: masks/small.tif}": "'small.tif', which has 20 × 10 px, but the frames have 150 × 150 px",
    "bad_pixels: {mask: manifest.csv}": "manifest.csv: cannot be read as an image",
}


@pytest.mark.parametrize(("yaml", "words"), WRONG.items())
def test_bad_pixels_that_cannot_be_are_refused_before_a_frame_is_decoded(tmp_path, yaml, words):
    (tmp_path / "data/masks").mkdir(parents=True)
    tifffile.imwrite(tmp_path / "data/masks/small.tif", np.zeros((10, 20), np.uint8))
    with pytest.raises(InputError) as raised:
        check_dataset(loaded(tmp_path / "data", [spoilt(0, 0)], f"{YAML}{yaml}\n"))
    assert words in str(raised.value) and str(raised.value).count("\n") == 0


@pytest.mark.parametrize("key", ["mask", "pixels"])
@pytest.mark.parametrize("good", ["a pixel", "a line", "one in a hundred", "no pixel", "a disk", "every third column"])
def test_a_mask_of_nearly_everything_is_refused(tmp_path, key, good):
    """Such as an inverted one, whatever the defects; a disk around the spot, or a third of the pixels, is enough."""
    y, x = np.indices((SIDE, SIDE))
    is_good = {
        "a pixel": (x == 20) & (y == 30),
        "a line": x == 20,
        "one in a hundred": np.random.default_rng(3).random((SIDE, SIDE)) < 0.01,
        "no pixel": x < 0,
        "a disk": np.hypot(x - X, y - Y) < 16,
        "every third column": x % 3 == 0,
    }[good]
    (tmp_path / "data/masks").mkdir(parents=True)
    tifffile.imwrite(tmp_path / "data/masks/inverted.tif", 255 * (~is_good).astype(np.uint8))
    value = "masks/inverted.tif" if key == "mask" else np.argwhere(~is_good)[:, ::-1].tolist()
    found = loaded(tmp_path / "data", [spoilt(0, 0)], f"{YAML}bad_pixels: {{{key}: {value}}}\n")
    if good in ("a disk", "every third column"):
        check_dataset(found)
        return
    with pytest.raises(InputError) as raised:
        check_dataset(found)
    assert ("invert the mask" in str(raised.value)) == (key == "mask")
    assert "every pixel" in str(raised.value) or f"leaves {is_good.sum()} of {SIDE**2} pixels" in str(raised.value)


def test_no_bad_pixels_leave_frames_as_they_are(tmp_path):
    """Unsigned integers, as stored."""
    image = spoilt(1, 3)
    found = loaded(tmp_path / "data", [image], YAML)
    np.testing.assert_array_equal(frames.read_masked_image(found, found.spots[0]), image)
    assert frames.read_masked_image(found, found.spots[0]).dtype == np.uint16
    assert dataset.load(found.folder).instrument.bad_pixels == type(found.instrument.bad_pixels)()
