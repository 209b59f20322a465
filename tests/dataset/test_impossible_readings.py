"""Impossible readings are masked in frames and in a first look, with a remark; sound frames keep all pixels."""

import numpy as np
import pytest
import tifffile

import spotcheck
from spotcheck.characterization.dataset_sensor import choose_dataset_sensor
from spotcheck.characterization.sensor_choice import read_sensor_model
from spotcheck.crops.ingest import ingest_frames
from spotcheck.dataset import frames
from spotcheck.dataset.impossible_readings import (
    CONSTANT_LINES,
    CONSTANT_REGIONS,
    CUT,
    DRAWN_LINES,
    SEPARATED,
    find_impossible_readings,
)
from spotcheck.fitting.crop_fits import fit_crops, select_preferred_fits
from spotcheck.io import store
from spotcheck.quicklook.text_report import list_cautions
from tests.samples.small_datasets import crops_of, loaded

Y, X = np.mgrid[:200, :260].astype(float)
DISTANCE = np.hypot(X - 128.4, Y - 99.2)
GAUSSIAN = np.exp(-(DISTANCE**2) / 2 / 9**2)
GAIN, FULL_SCALE = 0.3, 4095


def frame(seed=5, light=500 * GAUSSIAN, black=60.0, noise=1.5, full_scale=FULL_SCALE):
    """Readings of a camera of 0.3 DN/e-."""
    rng = np.random.default_rng(seed)
    readings = GAIN * rng.poisson(light / GAIN) + black + rng.normal(0, noise, light.shape)
    return np.clip(np.rint(readings), 0, full_scale).astype(np.uint16)


def replaced(where, value, **camera):
    """A frame with other readings at an index or mask."""
    image = frame(**camera)
    image[where] = value
    return image


LOW_PIXELS = frame() < 75
OUTLINE = (np.maximum(abs(X - 130), abs(Y - 100)) < 41) & (np.maximum(abs(X - 130), abs(Y - 100)) >= 39)
FAULTS = {
    "lost rows": (np.s_[96:101], 0, 60, SEPARATED),
    "half of the rows lost": (np.s_[90:98, 100:], 0, 60, SEPARATED),
    "zeros outside a circle": (DISTANCE > 35, 0, 60, SEPARATED),
    "cut at a threshold": (LOW_PIXELS, 0, 60, CUT),
    "cut to the black level": (LOW_PIXELS, 60, 60, CUT),
    "lost columns, no black level": (np.s_[:, 120:128], 0, 0, CONSTANT_LINES),
    "rows of the black level": (np.s_[96:101], 60, 60, CONSTANT_LINES),
    "a block lost in the spot": (np.s_[94:110, 124:142], 0, 0, CONSTANT_REGIONS),
    "an ellipse": (abs(np.hypot((X - 128) / 1.5, Y - 99) - 30) < 0.6, FULL_SCALE, 60, DRAWN_LINES),
    "a crosshair": ((Y == 100) | (X == 130), FULL_SCALE, 60, DRAWN_LINES),
    "a frame": (OUTLINE, FULL_SCALE, 0, DRAWN_LINES),
}


@pytest.mark.parametrize(("where", "value", "black", "reason"), FAULTS.values(), ids=FAULTS)
def test_readings_that_no_exposure_gives_are_masked(where, value, black, reason):
    image = replaced(where, value, black=black)
    impossible = find_impossible_readings(image)
    assert list(impossible.counts) == [reason]
    mask = impossible.is_cut if reason == CUT else impossible.mask
    assert mask[where].all()
    # Pixels beside the fault are masked only if they are connected with it and have its reading.
    assert (image[impossible.mask | impossible.is_cut] == value).all()


LOST = {"rows": np.s_[96:101], "columns": np.s_[:, 120:128], "block": np.s_[90:98, 100:140], "circle": DISTANCE > 26}


@pytest.mark.parametrize("noise", [0.1, 0.4, 1.0, 3.0])
@pytest.mark.parametrize("where", LOST.values(), ids=LOST)
def test_lost_pixels_below_the_black_level_are_masked_at_any_noise(where, noise):
    impossible = find_impossible_readings(replaced(where, 0, noise=noise, light=2000 * GAUSSIAN))
    assert impossible.mask[where].all()
    assert not impossible.is_cut.any()


def test_sound_frames_keep_all_pixels():
    top_hat = np.clip(2000 * (18 - DISTANCE) / 2, 0, 2000)
    sound = {
        "spot": frame(),
        "dark": frame(light=0 * X),
        "black level 0": frame(black=0.0),
        "clipped at black": frame(black=-4.0),
        "saturated": frame(light=20000 * GAUSSIAN),
        "8 bit": frame(light=200 * GAUSSIAN, black=4, noise=0.3, full_scale=255),
        "gamma": np.rint(255 * (frame(black=0.0) / 600.0) ** (1 / 2.2)).clip(0, 255).astype(np.uint16),
        "top hat": frame(light=top_hat, black=0.0),
        "binned": frame().reshape(100, 2, 130, 2).sum(axis=(1, 3)).astype(np.uint16),
        "left-aligned": frame() << 4,
        "saturated flat": frame(light=np.full(X.shape, 4000.0), noise=3.0),
        # Defects of the sensor, which the search for outlier pixels treats.
        "dead row": replaced(np.s_[105], 0),
        "dead column and row": replaced((X == 120) | (Y == 105), 3),
        "hot column": replaced(np.s_[:, 131], FULL_SCALE),
        "hot pixels": replaced(np.random.default_rng(1).random(X.shape) < 0.01, 900),
    }
    assert {name: counts for name, image in sound.items() if (counts := find_impossible_readings(image).counts)} == {}


def test_a_dataset_masks_them_in_frames_of_every_kind_and_says_so(tmp_path):
    images = [frame(seed) for seed in range(4)]
    images[3][90:97] = 0
    found = loaded(tmp_path, images, "crop_px: 120\nsensor: {bit_depth: 12}\n")
    masked_images = [np.isnan(frames.read_masked_image(found, spot).astype(float)) for spot in found.spots]
    assert [np.flatnonzero(mask.all(axis=1)).tolist() for mask in masked_images] == [[], [], [], list(range(90, 97))]
    assert sum(map(np.count_nonzero, masked_images)) == 7 * 260
    table = ingest_frames(found)
    assert store.remarks_of(table) == [f"{found.spots[3].label}: {7 * 260} {SEPARATED}"]
    # Extremes are those of measured pixels.
    assert table["minimum"].values.min() > 40


@pytest.mark.parametrize(("threshold", "black"), [(75, 60), (12, 0)])
def test_fits_leave_out_what_a_threshold_cut_off_and_say_so(tmp_path, threshold, black):
    images = [frame(seed, black=black, noise=1.2) for seed in range(2)]
    images = [np.where(image < threshold, 0, image).astype(np.uint16) for image in images]
    sensor = f"{{bit_depth: 12, gain_dn_per_e: {GAIN}, read_noise_e: 4, black_level_dn: {black}}}"
    found = loaded(tmp_path, images, f"crop_px: 120\nsensor: {sensor}\n")
    crops = crops_of(found)
    sheet = choose_dataset_sensor(found, crops, ingest_frames(found), {})
    # The frames do not contradict the stated black level, though most pixels read 0.
    assert float(sheet["black_level_dn"]) == black
    assert not any("black_level" in remark for remark in store.remarks_of(sheet))
    fits = select_preferred_fits(fit_crops(crops, read_sensor_model(sheet)))
    assert set(store.status_names(fits["status"].values.ravel())) == {"cut_off"}
    assert (abs(fits["sigma_mean"] - 9) < 0.25).all()
    assert (fits["chi2_reduced"] < 1.2).all()


def test_a_dataset_keeps_what_a_threshold_cut_off(tmp_path):
    """The verdict recognises a camera's dead zone by it; the remark stands in the results all the same."""
    images = [np.where(frame(seed) < 75, 0, frame(seed)).astype(np.uint16) for seed in range(2)]
    found = loaded(tmp_path, images, "crop_px: 120\nsensor: {bit_depth: 12}\n")
    assert not any(np.isnan(frames.read_masked_image(found, spot).astype(float)).any() for spot in found.spots)
    assert [CUT in remark for remark in store.remarks_of(ingest_frames(found))] == [True]


def test_an_empty_frame_does_not_change_the_black_level(tmp_path):
    """All its pixels read 0; neither a dataset nor a first look estimates anything from it."""
    images = [frame(seed) for seed in range(4)]
    images[2][:] = 0
    found = loaded(tmp_path, images, "crop_px: 120\nsensor: {bit_depth: 12}\n")
    sheet = choose_dataset_sensor(found, crops_of(found), ingest_frames(found), {})
    assert abs(float(sheet["black_level_dn"]) - 60) < 0.5
    assert abs(spotcheck.look(tmp_path / "frames").cameras[0].black_level_dn - 60) < 1


def test_a_first_look_leaves_them_out_and_says_so(tmp_path):
    image = frame(light=150 * GAUSSIAN, black=12, noise=1.2, full_scale=255).astype(np.uint8)
    image[abs(np.hypot(X - 125, Y - 103) - 28) < 0.7] = 255
    tifffile.imwrite(tmp_path / "ring.tif", image)
    tifffile.imwrite(tmp_path / "circle.tif", replaced(DISTANCE > 70, 0))
    by_name = {result.name: result for result in spotcheck.look(tmp_path).images}
    for name, reason in (("ring.tif", DRAWN_LINES), ("circle.tif", SEPARATED)):
        result = by_name[name]
        for (width, stderr), tolerance in ((result.fit_widths[0], 4), (result.moment_widths[0], 4)):
            assert abs(width - 36) < tolerance * stderr < 3
        assert any(reason in text for text in spotcheck.look(tmp_path / name).to_dict()["images"][0]["beware"])


def test_moments_of_a_spot_with_lost_pixels_are_unknown(tmp_path):
    tifffile.imwrite(tmp_path / "rows.tif", replaced(np.s_[92:100], 0))
    tifffile.imwrite(tmp_path / "corner.tif", replaced(np.s_[:30, :50], 0))
    rows, corner = (spotcheck.look(tmp_path / name).images[0] for name in ("rows.tif", "corner.tif"))
    assert np.isnan(rows.moment_widths).all()
    assert abs(rows.fit_widths[0][0] - 36) < 0.5
    cautions = " ".join(list_cautions(rows))
    assert "D4σ is unknown: a part of the spot was not measured" in cautions
    assert "second spot" not in cautions and "flanks" not in cautions
    assert abs(corner.moment_widths[0][0] - 36) < 1
