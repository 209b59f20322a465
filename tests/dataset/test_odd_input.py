"""Odd inputs that an attack on the contract found: each is refused in one sentence, or read as what it says."""

import numpy as np
import pytest

from spotcheck.crops.cropping import crop_spots
from spotcheck.crops.ingest import check_dataset, ingest_frames
from spotcheck.dataset import folder as dataset
from spotcheck.dataset import frames
from spotcheck.errors import InputError
from spotcheck.fitting.calibration import calibrate
from spotcheck.fitting.crop_fits import fit_crops
from spotcheck.io.formats import pgm
from spotcheck.io.store import read
from spotcheck.sensor import ReadingDistribution
from tests.samples.small_datasets import HEADER, SENSOR, folder, gaussian, loaded, noisy

GOOD = "frames/a.tif,spot,0,1e-4,0"
# Ten lists, each ten times the one before: 10^10 values, once somebody writes them out.
LAUGHS = "name:\n- &a0 [x, x]\n" + "".join(f"- &a{k + 1} [{', '.join([f'*a{k}'] * 10)}]\n" for k in range(10))


@pytest.mark.parametrize(
    ("header", "row", "words"),
    [
        (HEADER.replace(",", ";"), GOOD, ["column file is missing", "commas"]),
        (HEADER, GOOD.replace("1e-4", "1_0"), ["line 2", "1_0", "a number"]),
        (HEADER, GOOD[:-1] + "9" * 5000, ["line 2", "repeat", "whole number"]),
        (HEADER, GOOD.replace("a.tif", "a{1}.tif"), ["line 2", "braces"]),
        (HEADER, GOOD + ",5", ["line 2", "more cells"]),
        (HEADER + ",", GOOD + ",5", ["line 2", "column without a name"]),
        (HEADER, '"' + GOOD * 9000, ["manifest.csv", "unclosed quote"]),
    ],
)
def test_manifest(tmp_path, header, row, words):
    """File and line, what is wrong, what would be right."""
    with pytest.raises(InputError) as error:
        dataset.load(folder(tmp_path, [row], header=header))
    assert all(word in str(error.value) for word in words), error.value


@pytest.mark.parametrize("end", [",", ",,"])
def test_empty_columns_of_a_spreadsheet_are_dropped(tmp_path, end):
    """Header, rows and a row of commas alone."""
    ds = dataset.load(folder(tmp_path, [GOOD + end, ",,,,,," + end], header=HEADER + end))
    assert len(ds.frames) == 1 and ds.frames[0].extra == {}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("crop_px: 0100", ["0100", "decimal"]),
        ("crop_px: 1:40", ["1:40", "decimal"]),
        ("0", ["holds no keys"]),
        ("conditions: ['a/b']", ["a/b", "a word"]),
        ("conditions: [image]", ["image", "meaning of its own"]),
        ("name: 2020-13-45", ["instrument.yaml", "cannot be read"]),
        ("sensor: {gain_dn_per_e: 1.0e+300}", ["gain_dn_per_e", "at most"]),
        ("sensor: {black_level_dn: 1.0e+300}", ["black_level_dn", "at most"]),
        (LAUGHS, ["line 3", "*a0 is an alias"]),
        (f"name: [{'x, ' * 999}x]", ["key name is ['x', 'x'", "…; it must be text"]),
        ("'a\\n': 1\n\"b\\n\": 2", ["unknown key 'a", "known keys"]),
    ],
)
def test_instrument(tmp_path, text, words):
    """File and key, what is wrong, what would be right."""
    header = HEADER + ",image,a/b"
    with pytest.raises(InputError) as error:
        dataset.load(folder(tmp_path, [GOOD + ",1,1"], text, header))
    assert all(word in str(error.value) for word in words), error.value
    assert "\n" not in str(error.value) and len(str(error.value)) < 300


@pytest.mark.parametrize("text", ["{value_shift_bits: 15, bit_depth: 2}", "{bit_depth: 10, value_shift_bits: 7}"])
def test_more_bits_than_the_frames_hold(tmp_path, text):
    """Bit depth and shift together exceed the container."""
    ds = loaded(tmp_path, [np.zeros((40, 40), np.uint16)], f"crop_px: 24\nsensor: {text}")
    with pytest.raises(InputError, match="17 bits, but the frames hold 16"):
        check_dataset(ds)


def test_a_wrong_key_is_named_with_its_file(tmp_path):
    """The shared sheet, where the dataset's own has no such key."""
    (tmp_path / "camera.yaml").write_text("sensor: {bit_depth: 12}", encoding="utf-8")
    ds = loaded(tmp_path / "own", [np.zeros((40, 40), np.uint8)], "{crop_px: 24, based_on: ../camera.yaml}")
    with pytest.raises(InputError, match=r"^camera\.yaml: sensor\.bit_depth .* but the frames hold 8"):
        check_dataset(ds)


def test_values_that_are_not_left_aligned(tmp_path):
    """A shift that would drop bits which are set."""
    ds = loaded(tmp_path, [np.full((40, 40), 5, np.uint16)], "crop_px: 24\nsensor: {value_shift_bits: 4}")
    with pytest.raises(InputError, match="low bits set"):
        frames.read_image(ds, ds.frames[0])


@pytest.mark.parametrize("pixels", [b"-5 1", b"300 1", b"9999999999999999999999 1", b"1"])
def test_text_graymaps_do_not_wrap(tmp_path, pixels):
    """Values outside 0 … white, and too few of them."""
    (tmp_path / "a.pgm").write_bytes(b"P2\n2 1\n255\n" + pixels)
    with pytest.raises(ValueError, match=r"whole number|above its own white|cut short"):
        pgm.read_pixels(tmp_path / "a.pgm", 0)


def test_comments_between_pixels_of_a_text_graymap(tmp_path):
    """Skipped, as the format says."""
    (tmp_path / "a.pgm").write_bytes(b"P2\n2 1\n255\n7 # seven\n9\n")
    assert pgm.read_pixels(tmp_path / "a.pgm", 0).tolist() == [[7, 9]]


def test_hidden_files_are_no_unnamed_images(tmp_path):
    """macOS leaves ._a.tif beside a.tif."""
    ds = loaded(tmp_path, [np.zeros((40, 40), np.uint16)], "crop_px: 24")
    (tmp_path / "frames" / "._f0.tif").write_bytes(b"")
    check_dataset(ds)


def test_extra_columns_may_be_called_anything(tmp_path):
    """Names that netCDF refuses or that the table uses itself."""
    ds = loaded(tmp_path, [np.zeros((40, 40), np.uint16)], "crop_px: 24")
    names = ("maximum", "a/b", "frame", "my temp", "9", "x" * 400)
    own = ds.frames[0]
    ds = dataset.Dataset(
        ds.folder, ds.instrument, (own.__class__(**{**own.__dict__, "extra": dict.fromkeys(names, "q")}),)
    )
    table = ingest_frames(ds)
    assert int(table["maximum"][0]) == 0
    assert sum(v.attrs["long_name"].startswith("column ") for v in table.coords.values()) == len(names)


def test_expected_maximum_of_a_saturated_frame():
    """Full scale, although no pixel has any variance left."""
    assert ReadingDistribution(SENSOR, 1e-4).expected_maximum(np.full((9, 9), 1e5)) == pytest.approx(
        SENSOR.full_scale_dn, abs=1
    )


def test_no_site_at_two_exposures(tmp_path):
    """Three exposures, each at a site of its own: no law can be fitted, and the reason is given."""
    light = gaussian(60, 500.0, 30, 30, 4.0)
    ds = loaded(tmp_path, [noisy(light, k) for k in range(2)], "crop_px: 40\nsensor: {bit_depth: 10}", [1e-4, 5e-4])
    moved = [f.__class__(**{**f.__dict__, "repeat": k}) for k, f in enumerate(ds.frames)]
    ds = dataset.Dataset(ds.folder, ds.instrument, tuple(moved))
    crop_spots(ds, ingest_frames(ds), tmp_path / "crops.nc", code="c", inputs=[])
    own = read(tmp_path / "crops.nc").load()
    found = calibrate(own, fit_crops(own, SENSOR), ds.instrument, SENSOR)
    assert "one site at two exposures" in found.attrs["skipped"]
