"""The dataset contract: what is accepted, and what each breach says."""

import math

import pytest

from spotcheck.dataset import folder as dataset
from spotcheck.dataset.instrument import Instrument
from spotcheck.errors import InputError
from tests.samples.small_datasets import HEADER, folder

GOOD = "frames/a.tif,spot,0,1e-4,0"
SECOND = "frames/b.tif,spot,0,1e-4,1"


def assert_refused(base, words, rows, instrument=None, header=HEADER) -> None:
    """Loading ends in one bearable sentence with these words."""
    with pytest.raises(InputError) as caught:
        dataset.load(folder(base, rows, instrument, header))
    text = str(caught.value)
    assert [word for word in words if word not in text] == [], text
    assert "\n" not in text and len(text) < 400


BAD_ROWS = {
    "kind": (["frames/a.tif,sopt,0,1e-4,0"], ["line 2", "kind", "'sopt'", "spot, dark, flat"]),
    "angle": (["frames/a.tif,spot,north,1e-4,0"], ["line 2", "angle_deg", "'north'", "a number"]),
    "infinite angle": (["frames/a.tif,spot,inf,1e-4,0"], ["line 2", "angle_deg", "'inf'", "a number"]),
    "exposure with a unit": (["frames/a.tif,spot,0,0.1ms,0"], ["line 2", "exposure_s", "'0.1ms'", "a number"]),
    "exposure of Python": (["frames/a.tif,spot,0,1_0,0"], ["line 2", "1_0", "a number"]),
    "nan exposure": (["frames/a.tif,spot,0,nan,0"], ["line 2", "exposure_s", "'nan'", "a number"]),
    "exposure below zero": (["frames/a.tif,dark,,-1e-4,0"], ["line 2", "exposure_s", "-1e-4", "positive"]),
    "spot without time": (["frames/a.tif,spot,0,0,0"], ["line 2", "exposure_s", "positive"]),
    "repeat below zero": (["frames/a.tif,spot,0,1e-4,-1"], ["line 2", "repeat", "'-1'", "whole number"]),
    "half repeat": (["frames/a.tif,spot,0,1e-4,0.5"], ["line 2", "repeat", "'0.5'", "whole number"]),
    "endless repeat": ([GOOD[:-1] + "9" * 5000], ["line 2", "repeat", "whole number"]),
    "no file": ([",spot,0,1e-4,0"], ["line 2", "file", "inside the dataset folder"]),
    "outside": (["../a.tif,spot,0,1e-4,0"], ["line 2", "'../a.tif'", "inside the dataset folder"]),
    "absolute": (["/tmp/a.tif,spot,0,1e-4,0"], ["line 2", "'/tmp/a.tif'", "inside the dataset folder"]),
    "drive": (["C:\\data\\a.tif,spot,0,1e-4,0"], ["line 2", "inside the dataset folder"]),
    "server": (["\\\\server\\a.tif,spot,0,1e-4,0"], ["line 2", "inside the dataset folder"]),
    "long name": ([f"frames/{'a' * 1000}.tif,spot,0,1e-4,0"], ["line 2: file has 1011 characters"]),
    "NUL": (["frames/a\0.tif,spot,0,1e-4,0"], ["line 2", "inside the dataset folder"]),
    "braces": (["frames/a{1}.tif,spot,0,1e-4,0"], ["line 2", "braces"]),
    "no image": (["frames/a.jpg,spot,0,1e-4,0"], ["line 2: frames/a.jpg is in no format", "TIFF, PNG or PGM (.tif"]),
    "too few cells": ([GOOD, "frames/b.tif,spot,0,1e-4"], ["line 3", "fewer cells"]),
    "too many cells": ([GOOD, SECOND + ",9"], ["line 3", "more cells"]),
    "open quote": (['"' + GOOD * 9000], ["unclosed quote"]),
    "same file": ([GOOD, "frames/../frames/a.tif,spot,0,1e-4,1"], ["lines 2 and 3", "file and page", "once"]),
    "same cell": ([GOOD, "frames/b.tif,spot,0,0.0001,0"], ["lines 2 and 3", "kind, angle, exposure, repeat", "once"]),
    "nearly equal exposures": (
        ["frames/a.tif,spot,0,0.004,0", "frames/b.tif,spot,0,0.0040008,0"],
        ["lines 2 and 3 agree", "with a repeat of its own (exposures within 0.1 %"],
    ),
    "two blank darks": (["frames/a.tif,dark,,,", "frames/b.tif,dark,,,"], ["lines 2 and 3", "once"]),
    "half blank": ([GOOD, "frames/b.tif,spot,0,,1"], ["line 3", "exposure_s is blank", "all of them or in none"]),
    "half blank angle": (["frames/a.tif,spot,,1e-4,0", SECOND], ["line 2", "angle_deg is blank", "in none"]),
    "no rows": ([], ["no rows", "at least one"]),
}


@pytest.mark.parametrize(("rows", "words"), BAD_ROWS.values(), ids=BAD_ROWS)
def test_a_bad_row_is_named(tmp_path, rows, words):
    """File, line, what is wrong and what would be right."""
    assert_refused(tmp_path, ["manifest.csv", *words], rows)


BAD_HEADERS = {
    **{
        f"no {column}": (HEADER.replace(column, "x"), GOOD, [f"column {column} is missing", HEADER])
        for column in HEADER.split(",")
    },
    "semicolons": (HEADER.replace(",", ";"), GOOD, ["column file is missing", "commas"]),
    "no name": (f"{HEADER},", f"{GOOD},5", ["line 2", "column without a name"]),
    "twice": (f"{HEADER},exposure_s", f"{GOOD},5", ["column exposure_s stands twice"]),
    "twice, in other capitals": (f"{HEADER},Kind", f"{GOOD},5", ["column kind stands twice"]),
}


@pytest.mark.parametrize(("header", "row", "words"), BAD_HEADERS.values(), ids=BAD_HEADERS)
def test_a_bad_header_is_named(tmp_path, header, row, words):
    """With the columns that it must have."""
    assert_refused(tmp_path, ["manifest.csv", *words], [row], header=header)


# Ten lists, each ten times the one before: 10^10 values, once somebody writes them out.
LAUGHS = "name:\n- &a0 [x, x]\n" + "".join(f"- &a{k + 1} [{', '.join([f'*a{k}'] * 10)}]\n" for k in range(10))
PLANE = "sensor: {bayer: RGGB, channel: red}\n"
BAD_KEYS = {
    "unknown": ("croppx: 240", ["unknown key croppx", "crop_px"]),
    "unknown in a section": ("sensor: {gain: 1}", ["unknown key sensor.gain", "gain_dn_per_e"]),
    "unknown, with line ends": ("'a\\n': 1\n\"b\\n\": 2", ["unknown key 'a", "known keys"]),
    "outside its section": ("f_number: 11", ["f_number", "`optics:`"]),
    "text for a number": ("sensor: {bit_depth: ten}", ["sensor.bit_depth", "'ten'", "a whole number"]),
    "fraction": ("sensor: {bit_depth: 10.5}", ["sensor.bit_depth", "10.5", "a whole number"]),
    "octal": ("crop_px: 0100", ["0100", "decimal"]),
    "sexagesimal": ("crop_px: 1:40", ["1:40", "decimal"]),
    "not finite": ("sensor: {gain_dn_per_e: .nan}", [".nan is not a finite number"]),
    "no date": ("name: 2020-13-45", ["cannot be read"]),
    "yes for a number": ("laser: {power_w: yes}", ["laser.power_w", "True", "a number"]),
    "long list for text": (f"name: [{'x, ' * 999}x]", ["key name is ['x', 'x'", "…; it must be text"]),
    "above": ("sensor: {bit_depth: 17}", ["sensor.bit_depth", "17", "at most 16"]),
    "far above": ("sensor: {black_level_dn: 1.0e+300}", ["black_level_dn", "at most"]),
    "below": ("crop_px: 4", ["crop_px", "4", "at least 8"]),
    "zero": ("sensor: {gain_dn_per_e: 0}", ["gain_dn_per_e", "at least 1e-06"]),
    "pitch in µm": ("sensor: {pixel_pitch_m: 4.8}", ["is 4.8; it must be at most", "4.8 µm would be 4.8e-06"]),
    "wavelength in nm": ("laser: {wavelength_m: 405}", ["is 405; it must be at most", "405 nm would be 4.05e-07"]),
    "no channel": ("sensor: {bayer: RGGB}", ["sensor.channel is missing; it must be red, green_r"]),
    "no such plane": ("sensor: {bayer: RGGB, channel: green}", ["sensor.channel is green; it must be red, green_r"]),
    "plane without filters": ("sensor: {channel: green_r}", ["it must be green without sensor.bayer"]),
    "no such filters": ("sensor: {bayer: RGBG, channel: red}", ["sensor.bayer is 'RGBG'; it must be one of"]),
    "integration": (f"{PLANE}optics: {{pixel_integration: true}}", ["cover a quarter of the frame"]),
    "transmission": ("optics: {filter_transmission: 91.9}", ["filter_transmission", "at most 1"]),
    "budget": ("model: {photon_budget: square}", ["photon_budget", "'square'", "spot_area, linear, free"]),
    "section": ("sensor: 5", ["sensor", "a section with keys"]),
    "list": ("conditions: z_m", ["conditions", "'z_m'", "a list"]),
    "no column": ("conditions: [z_m]", ["conditions", "z_m", "manifest.csv", "add the column"]),
    "no word": ("conditions: ['a/b']", ["a/b", "a word"]),
    "name of a variable": ("conditions: [image]", ["image", "meaning of its own"]),
    "standard column": ("conditions: [exposure_s]", ["exposure_s", "meaning of its own"]),
    "twice": ("laser:\n  power_w: 1\n  power_w: 2", ["line 3", "power_w", "twice"]),
    "list as key": ("? [a]\n: 1", ["not a word"]),
    "aliases": (LAUGHS, ["line 3", "*a0 is an alias"]),
    "no YAML": ("sensor: [1, 2", ["line", "key: value"]),
    "tab": ("sensor:\n\tbit_depth: 10", ["line 2", "key: value"]),
    "a sentence": ("hello", ["holds no keys", "key: value"]),
}


@pytest.mark.parametrize(("text", "words"), BAD_KEYS.values(), ids=BAD_KEYS)
def test_a_bad_key_is_named(tmp_path, text, words):
    """File, key, what is wrong and what would be right."""
    assert_refused(tmp_path, ["instrument.yaml", *words], [f"{GOOD},1,1"], text, f"{HEADER},image,a/b")


def test_missing_instrument_file_takes_every_default(tmp_path):
    """The defaults of the contract's table, read from nothing."""
    given = dataset.load(folder(tmp_path, [GOOD])).instrument
    sensor = given.sensor
    assert (given.order_known, given.conditions, given.crop_px) == (True, (), 240)
    assert (given.model.photon_budget, given.model.top_hat) == ("linear", False)
    assert (sensor.dark_current_e_per_s, sensor.quantum_efficiency) == (0, 1)
    assert (sensor.black_level_dn, sensor.value_shift_bits, sensor.full_well_e) == (0, 0, None)
    assert sensor.gain_dn_per_e is None and given.laser_sigma_m is None


def test_an_empty_section_is_no_error(tmp_path):
    """`sensor:` with every key under it commented out counts as missing."""
    assert dataset.load(folder(tmp_path, [GOOD], "sensor:\noptics:\n")).instrument == Instrument()


@pytest.mark.parametrize(("text", "value"), [("5e-6", 5e-6), ("5.5e-06", 5.5e-6), ("5E-6", 5e-6), ("1", 1.0)])
def test_numbers_as_people_write_them(tmp_path, text, value):
    """YAML 1.1 would read 5e-6 as text; a side of 240.0 px is the integer 240."""
    given = dataset.load(folder(tmp_path, [GOOD], f"sensor: {{pixel_pitch_m: {text}}}\ncrop_px: 240.0")).instrument
    assert given.sensor.pixel_pitch_m == value and isinstance(given.crop_px, int)


def test_laser_sigma_is_the_mean_fwhm_over_its_factor(instrument):
    """Eq. 10 on the mean of both widths of Table 3: a Gaussian is halved at half its FWHM from the centre."""
    half = (72.8e-6 + 80.4e-6) / 4
    # The definition of the FWHM, exact up to rounding.
    assert math.exp(-(half**2) / (2 * instrument.laser_sigma_m**2)) == pytest.approx(0.5, rel=1e-12)


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
@pytest.mark.parametrize("start", ["", "\ufeff"])
def test_comments_endings_and_byte_order_mark(tmp_path, ending, start):
    """Lines that start with # do not count as rows, and line numbers stay those of the file."""
    lines = ["# made by hand", HEADER, "# first site", GOOD, "", "frames/b.tif, spot ,0, 5E-4,0"]
    (tmp_path / "manifest.csv").write_bytes((start + ending.join(lines)).encode("utf-8"))
    frames = dataset.load(tmp_path).frames
    assert [(f.line, f.file, f.kind, f.exposure_s) for f in frames] == [
        (4, "frames/a.tif", "spot", 1e-4),
        (6, "frames/b.tif", "spot", 5e-4),
    ]


@pytest.mark.parametrize("end", [",", ",,"])
def test_empty_columns_of_a_spreadsheet_are_dropped(tmp_path, end):
    """Header, rows and a row of commas alone."""
    ds = dataset.load(folder(tmp_path, [GOOD + end, ",,,,,," + end], header=HEADER + end))
    assert len(ds.frames) == 1 and ds.frames[0].extra == {}


def test_text_that_is_not_utf8(tmp_path):
    """A Latin-1 manifest is refused with the remedy, not with a traceback."""
    (tmp_path / "manifest.csv").write_bytes("file,kind\nframes/größe.tif,spot".encode("latin-1"))
    with pytest.raises(InputError, match=r"manifest\.csv: not UTF-8.*save it as UTF-8"):
        dataset.load(tmp_path)


def test_blank_exposures_make_an_axis_that_was_not_recorded(tmp_path):
    """Length 1 and no values."""
    ds = dataset.load(folder(tmp_path, ["frames/a.tif,spot,0,,0", "frames/b.tif,spot,0,,1"]))
    exposure = ds.axes[1]
    assert exposure.values is None and ds.shape == (1, 1, 2)
    assert [index for index, _ in ds.cells()] == [(0, 0, 0), (0, 0, 1)]


def test_an_incomplete_grid_keeps_each_frame_in_its_cell(tmp_path):
    """Axes are sorted values; a frame's index points at its own values, whatever the order of rows."""
    rows = ["frames/a.tif,spot,90,9e-4,1", "frames/b.tif,spot,0,1e-4,0", "frames/c.tif,spot,90,1e-4,0"]
    ds = dataset.load(folder(tmp_path, [*rows, "frames/d.tif,dark,,9e-4,"]))
    assert ds.shape == (2, 2, 2)
    for index, frame in ds.cells():
        found = [axis.values[k] for axis, k in zip(ds.axes, index, strict=True)]
        assert found == [frame.angle_deg, frame.exposure_s, frame.repeat]
    assert len(list(ds.cells())) == 3


def test_conditions_are_axes_with_the_unit_of_their_suffix(tmp_path):
    """`_m`, `_k`, `_deg`, `_s` give units, else 1; undeclared columns are carried along; equal numbers are one."""
    header = HEADER + ",z_m,temperature_k,note"
    rows = [GOOD + ",0.20,300,x", GOOD.replace("a.tif", "c.tif") + ",0.2,310,", SECOND + ",0.1,300,y"]
    ds = dataset.load(folder(tmp_path, rows, "conditions: [z_m, temperature_k]", header))
    assert [(a.name, a.values, a.units) for a in ds.axes[3:]] == [
        ("z_m", (0.1, 0.2), "m"),
        ("temperature_k", (300.0, 310.0), "K"),
    ]
    assert ds.frames[0].extra["note"] == "x"
    assert [dataset.get_column_unit(c) for c in ("tilt_deg", "delay_s", "photons_per_px")] == ["degree", "s", "1"]


def test_a_blank_condition_of_a_spot_is_named(tmp_path):
    """A declared condition needs a number in every spot row, and in no dark one."""
    header = HEADER + ",z_m"
    rows = [GOOD + ",", "frames/d.tif,dark,,1e-4,0,"]
    assert_refused(tmp_path, ["line 2: z_m is blank"], rows, "conditions: [z_m]", header)
    dataset.load(folder(tmp_path, [GOOD + ",0.1", rows[1]], "conditions: [z_m]", header))


def test_pages_of_a_stack(tmp_path):
    """One file may serve several rows when their pages differ."""
    header = HEADER + ",page"
    ds = dataset.load(folder(tmp_path, [GOOD + ",", GOOD[:-1] + "1,1"], header=header))
    assert [(f.page, f.label) for f in ds.frames] == [(0, "frames/a.tif"), (1, "frames/a.tif, page 1")]


def test_files_there_and_named(tmp_path):
    """A named file that is not there, and an image that no row names, are refused; other files are not."""
    ds = dataset.load(folder(tmp_path, [GOOD]))
    with pytest.raises(InputError, match=r"line 2: frames/a\.tif is not there"):
        dataset.check_files(ds)
    # macOS leaves ._a.tif beside a.tif.
    for name in ("a.tif", "._a.tif", "notes.txt"):
        (tmp_path / "frames" / name).touch()
    dataset.check_files(ds)
    (tmp_path / "frames" / "b.PNG").touch()
    with pytest.raises(InputError, match=r"frames/b\.PNG.*does not name"):
        dataset.check_files(ds)


def test_find_by_path_and_by_name(tmp_path):
    """A path goes before a name on the shelf; neither is an error."""
    own = folder(tmp_path / "shelf" / "mine", [GOOD])
    assert dataset.find_dataset(str(own), tmp_path) == dataset.find_dataset("mine", tmp_path / "shelf") == own
    with pytest.raises(InputError, match="theirs: no folder"):
        dataset.find_dataset("theirs", tmp_path / "shelf")
    with pytest.raises(InputError, match="no such folder"):
        dataset.load(tmp_path / "nowhere")
