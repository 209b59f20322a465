"""`new-dataset` of a folder of images as it is: rows, keys, what is asked for, and what is said."""

import csv
import io

import numpy as np
import pytest
import tifffile
import yaml

from spotcheck.cli import main
from spotcheck.dataset import folder as dataset
from spotcheck.dataset.frames import check_formats, read_image
from spotcheck.dataset.instrument import Sensor
from spotcheck.errors import InputError

SIDE = 40


def spot(seed: int = 0, sigma: float = 3.0) -> np.ndarray:
    """A frame with a spot: a Gaussian of 2000 DN on 100 DN with noise of 3 DN."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    light = 2000 * np.exp(-(x**2 + y**2) / (2 * sigma**2))
    return np.rint(100 + light + rng.normal(0, 3, light.shape)).astype(np.uint16)


def saved(folder, *names: str, **options):
    """Frames of these names, no two alike."""
    for seed, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        tifffile.imwrite(folder / name, spot(seed), photometric="minisblack", metadata=None, **options)
    return folder


def new(folder, *words: str, capsys) -> tuple[dataset.Dataset, str]:
    """The dataset that the command makes anew of a folder, and what it says; `check` passes."""
    for name in ("manifest.csv", "instrument.yaml"):
        (folder / name).unlink(missing_ok=True)
    main(["new-dataset", str(folder), *words])
    said = capsys.readouterr().out
    found = dataset.load(folder)
    dataset.check_files(found)
    check_formats(found)
    main(["check", str(folder)])
    assert "in order" in capsys.readouterr().out
    return found, said


def test_a_scan_by_its_names(tmp_path, capsys):
    """A position in each name: a condition, in the order in which people count."""
    found, said = new(saved(tmp_path, *(f"z_{z}mm.tif" for z in (176, 20, 100))), capsys=capsys)
    assert [frame.file for frame in found.frames] == ["z_20mm.tif", "z_100mm.tif", "z_176mm.tif"]
    assert [frame.extra["z_m"] for frame in found.frames] == ["0.02", "0.1", "0.176"]
    assert {frame.repeat for frame in found.frames} == {0}
    assert found.instrument.conditions == ("z_m",) and not found.instrument.order_known
    assert (found.instrument.crop_px, found.instrument.model.photon_budget) == (SIDE, "free")
    assert "file name (z_20mm, …)" in said and "Not found: exposure_s, sensor.pixel_pitch_m" in said
    assert not (tmp_path / "frames").exists()


@pytest.mark.parametrize(
    ("cells", "exposures_s"),
    [
        (("500", "1,500", "1,500"), None),
        (("500", "1,500", "1,500,000"), {0.0005, 0.0015, 1.5}),
        (("500", "500", "1,5"), {0.0005, 0.0000015}),
    ],
)
def test_commas_of_a_log_table_are_decided_or_asked_for(tmp_path, capsys, cells, exposures_s):
    """One cell that can be read in one way decides for its column; without one, the column stays empty."""
    saved(tmp_path, "a.tif", "b.tif", "c.tif")
    table = ["File name,Exposure (us)", *(f'{name}.tif,"{cell}"' for name, cell in zip("abc", cells, strict=True))]
    (tmp_path / "log.csv").write_text("\n".join(table) + "\n", encoding="utf-8")
    main(["new-dataset", str(tmp_path)])
    said = capsys.readouterr().out
    lines = [line for line in (tmp_path / "manifest.csv").read_text().splitlines() if not line.startswith("#")]
    written = {row["exposure_s"] for row in csv.DictReader(lines)}
    assert written == {""} if exposures_s is None else set(map(float, written)) == exposures_s
    is_asked_for = "commas or points may separate thousands or decimals; write the column without them" in said
    assert is_asked_for == (exposures_s is None)
    assert said.count("Exposure (us) = 1,500 (log.csv, and 2 like it)") == said.count("Exposure (us)") or exposures_s


def test_apostrophes_and_spaces_separate_thousands(tmp_path, capsys):
    """Nothing else is separated by them, so that nothing is asked."""
    saved(tmp_path, "a.tif", "b.tif", "c.tif")
    (tmp_path / "log.csv").write_text("file;texp (us)\na.tif;750\nb.tif;3'000\nc.tif;1 250 000\n", encoding="utf-8")
    found, said = new(tmp_path, capsys=capsys)
    assert [frame.exposure_s for frame in found.frames] == [0.00075, 0.003, 1.25]
    assert "unit that is known" not in said


def test_frames_that_cannot_be_measured_are_named(tmp_path, capsys):
    """They have no row; without any other, nothing is written."""
    for name in ("a.npy", "b.npy"):
        np.save(tmp_path / name, spot().byteswap())
    with pytest.raises(SystemExit):
        main(["new-dataset", str(tmp_path)])
    assert "swapped" in capsys.readouterr().err and not (tmp_path / "manifest.csv").exists()
    np.save(tmp_path / "c.npy", spot())
    main(["new-dataset", str(tmp_path)])
    said = capsys.readouterr().out
    assert all(f"{name}: has its high and low bytes swapped" in said for name in ("a.npy", "b.npy"))
    assert "No spot stands out" not in said


def test_the_table_shows_what_is_left_blank(tmp_path, capsys):
    """In the row of its column or key, with the reason."""
    for name, text in (("2ms_z7.tif", "exposure: 3 ms; wavelength: 633 nm"), ("z8.tif", "wavelength: 532 nm")):
        saved(tmp_path, name, description=text)
    main(["new-dataset", str(tmp_path)])
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line.startswith("  ")}
    assert rows["exposure_s"].endswith("contradictory in 1 frame")
    assert rows["z_m"].endswith("unclear in 2 frames")
    assert "left blank" in rows["laser.wavelength_m"]
    assert rows["laser.wavelength_m"].endswith("differs between frames or is out of range")


def test_check_names_what_a_run_will_skip(tmp_path, capsys):
    """And the key that would change it, one after the other; nothing once all are given."""
    new(saved(tmp_path, *(f"z_{z}mm.tif" for z in (176, 20, 100))), capsys=capsys)
    given = "{bit_depth: 16}", "{bit_depth: 16, pixel_pitch_m: 5.0e-6}"
    for sensor, laser, missing in (
        (given[0], "{}", "sensor.pixel_pitch_m"),
        (given[1], "{}", "laser.wavelength_m"),
        (given[1], "{wavelength_m: 6.328e-7}", None),
    ):
        text = f"{{conditions: [z_m], crop_px: 20, sensor: {sensor}, laser: {laser}}}"
        (tmp_path / "instrument.yaml").write_text(text, encoding="utf-8")
        main(["check", str(tmp_path)])
        skipped = [line for line in capsys.readouterr().out.splitlines() if line.startswith("will be skipped: ")]
        assert "p1 and p2 need exposure times" in skipped[0]
        assert [missing in line for line in skipped[1:]] == [True] if missing else skipped[1:] == []


# Names of files without suffix, and what the rows of some of them must hold.
ROWS_OF_NAMES = {
    "hyphens are signs where there are both": (
        ["z-5mm", "z0mm", "z+5mm"],
        {"z-5mm": {"z_m": "-0.005"}, "z0mm": {"z_m": "0.0"}, "z+5mm": {"z_m": "0.005"}},
    ),
    "folders, and numbers that start anew in each condition": (
        [f"{angle}deg/{t}us_{n:03}" for angle in (0, 90) for t in (100, 200) for n in (1, 2)]
        + ["dark/100us_001", "dark/100us_002"],
        {
            "90deg/200us_002": {"kind": "spot", "angle_deg": 90.0, "exposure_s": 2e-4, "repeat": 1},
            "dark/100us_001": {"kind": "dark", "angle_deg": None, "exposure_s": 1e-4, "repeat": 0},
        },
    ),
    "numbers that run on tell the order, not the repeat": (
        ["100us_0", "100us_1", "200us_2", "200us_3"],
        {"100us_1": {"repeat": 1}, "200us_2": {"repeat": 0}, "200us_3": {"repeat": 1}},
    ),
}


@pytest.mark.parametrize(("names", "rows"), ROWS_OF_NAMES.values(), ids=ROWS_OF_NAMES)
def test_rows_of_names(tmp_path, capsys, names, rows):
    """Positions, angles, kinds, exposures and repeats."""
    found, said = new(saved(tmp_path, *(f"{name}.tif" for name in names)), capsys=capsys)
    cells_of = {frame.file.removesuffix(".tif"): vars(frame) | frame.extra for frame in found.frames}
    assert {name: {column: cells_of[name][column] for column in row} for name, row in rows.items()} == rows
    runs_on = "100us_0" in names
    assert found.instrument.order_known == runs_on
    assert "counted within each condition" in said or not runs_on


def test_a_row_a_page(tmp_path, capsys):
    """With the exposure of its own page."""
    with tifffile.TiffWriter(tmp_path / "a.tif") as out:
        for k in range(3):
            tag = (33434, 5, 1, (k + 1, 1000), True)
            out.write(spot(k), photometric="minisblack", metadata=None, extratags=[tag])
    found, _ = new(tmp_path, capsys=capsys)
    assert [(frame.page, frame.exposure_s) for frame in found.frames] == [(0, 1e-3), (1, 2e-3), (2, 3e-3)]


def test_contradictions_are_left_blank_until_they_are_settled(tmp_path, capsys):
    """A name and a tag: nothing is taken, and the sentence says how to say which is right."""
    tag = (33434, 5, 1, (1, 1000), True)
    saved(tmp_path, "100us_1.tif", "100us_2.tif", extratags=[tag])
    main(["new-dataset", str(tmp_path)])
    said = capsys.readouterr().out
    assert (
        "exposure_s: TIFF tag 33434 ExposureTime says '0.001 s', but file name says '100us' (2 frames); left blank: say"
        ' which is right by --set "exposure_s=TIFF tag 33434 ExposureTime" or --set "exposure_s=file name"' in said
    )
    assert {frame.exposure_s for frame in dataset.load(tmp_path).frames} == {None}
    for answer, wanted in (("file name", 1e-4), ("TIFF tag 33434 ExposureTime", 1e-3), ("3 ms", 3e-3)):
        found, said = new(tmp_path, "--set", f"exposure_s={answer}", capsys=capsys)
        assert {frame.exposure_s for frame in found.frames} == {wanted} and "left blank" not in said


def test_numbers_without_a_unit(tmp_path, capsys):
    """They say so, and take the unit that is given."""
    saved(tmp_path, "z13.tif", "z18.tif")
    found, said = new(tmp_path, capsys=capsys)
    assert "z_m: z13 (file name, and 1 like it) has no unit that is known; give it by --set z_m=mm" in said
    assert "z_m" not in found.frames[0].extra
    found, _ = new(tmp_path, "--set", "z_m=mm", capsys=capsys)
    assert [frame.extra["z_m"] for frame in found.frames] == ["0.013", "0.018"]


@pytest.mark.parametrize(
    ("names", "text", "answer", "values"),
    [
        (["exp_3_5ms", "exp_4_5ms"], "", "exposure_s=ms", [None, None]),
        (["exp_3_5", "exp_4_5"], "", "exposure_s=ms", [None, None]),
        (["exp_3p5", "exp_4p5"], "", "exposure_s=ms", [0.0035, 0.0045]),
        (["a", "b"], "Exposure = 1/250", "exposure_s=s", [0.004, 0.004]),
        (["a", "b"], "Exposure = 2,500", "exposure_s=us", [None, None]),
    ],
)
def test_a_unit_decides_nothing_but_the_unit(tmp_path, capsys, names, text, answer, values):
    """A number with several readings stays blank, and the readings are named, once for all frames."""
    saved(tmp_path, *(f"{name}.tif" for name in names), **({"description": text} if text else {}))
    found, said = new(tmp_path, "--set", answer, capsys=capsys)
    assert [frame.exposure_s for frame in found.frames] == values
    assert ("? Left blank; write the value into column exposure_s of manifest.csv" in said) == (None in values)
    assert said.count("unclear in") == (None in values) and "has no unit that is known" not in said


def test_hyphens_of_numbers_without_a_unit_are_signs(tmp_path, capsys):
    """Where other names have that word without one."""
    found, _ = new(saved(tmp_path, "z-5.tif", "z0.tif", "z+5.tif"), "--set", "z_m=mm", capsys=capsys)
    positions = {frame.file: float(frame.extra["z_m"]) for frame in found.frames}
    assert positions == {"z-5.tif": -0.005, "z0.tif": 0.0, "z+5.tif": 0.005}


def test_keys_and_what_else_is_said(tmp_path, capsys):
    """Keys with their origin, the rest as comments."""
    saved(tmp_path, "a.tif", description="pixel size: 3.45 um\nGain = 12 dB\nbit depth = 12")
    found, _ = new(tmp_path, "--set", "laser.wavelength_m=632.8nm", capsys=capsys)
    text = (tmp_path / "instrument.yaml").read_text()
    assert found.instrument.sensor.pixel_pitch_m == 3.45e-6 and found.instrument.sensor.bit_depth == 12
    assert found.instrument.laser.wavelength_m == 6.328e-7
    assert "# TIFF tag 270 ImageDescription: pixel size = 3.45 um" in text and "# as you said: 632.8nm" in text
    assert "#   Gain = 12 dB (TIFF tag 270 ImageDescription)" in text
    assert set(yaml.safe_load(text)) == {"crop_px", "sensor", "laser", "model"}


@pytest.mark.parametrize("text", ["bit depth = 99", "bit depth = 12", "pixel size = 3 m", "exposure = 0 ms"])
def test_values_that_cannot_be_are_left_out(tmp_path, text, capsys):
    """A depth of more bits than are stored, a pitch of metres, a spot without exposure: `check` passes without them."""
    tifffile.imwrite(tmp_path / "a.tif", (spot() // 16).astype(np.uint8), photometric="minisblack", description=text)
    found, _ = new(tmp_path, capsys=capsys)
    assert found.instrument.sensor == Sensor() and found.frames[0].exposure_s is None


def test_links_out_of_the_folder_are_not_followed(tmp_path, capsys):
    """A manifest names nothing there."""
    saved(tmp_path / "out", "b.tif")
    saved(tmp_path / "in", "a.tif")
    (tmp_path / "in" / "c.tif").symlink_to(tmp_path / "out" / "b.tif")
    found, said = new(tmp_path / "in", capsys=capsys)
    assert [frame.file for frame in found.frames] == ["a.tif"] and "Not read: c.tif" in said


def test_a_terminal_is_asked(tmp_path, monkeypatch, capsys):
    """Only for what is missing, again where the answer is none (metres, seconds); Enter leaves it out."""
    saved(tmp_path, "2ms.tif")
    answers, asked = iter(["3.45", "3.45 s", "3.45 um", ""]), []
    monkeypatch.setattr("sys.stdin", type("Terminal", (io.StringIO,), {"isatty": lambda self: True})())
    monkeypatch.setattr("builtins.input", lambda question: (asked.append(question.partition(":")[0]), next(answers))[1])
    found, said = new(tmp_path, capsys=capsys)
    assert "sensor.pixel_pitch_m=3.45 s: must be a length such as 3.45um" in said
    assert asked == ["sensor.pixel_pitch_m"] * 3 + ["laser.wavelength_m"]
    assert (found.instrument.sensor.pixel_pitch_m, found.instrument.laser.wavelength_m) == (3.45e-6, None)


def test_what_is_not_read_is_said(tmp_path, capsys):
    """Other files, broken images, frames of another size; a text beside an image is read."""
    saved(tmp_path, "a.tif", "b.tif")
    (tmp_path / "a.txt").write_text("exposure: 2 ms\n")
    (tmp_path / "notes.docx").touch()
    (tmp_path / "c.tif").write_bytes(b"II*\0")
    main(["new-dataset", str(tmp_path)])
    said = capsys.readouterr().out
    assert "Not read: notes.docx\n" in said and "c.tif: the TIFF is cut short" in said
    assert "exposure_s: not found for 1 of 2 frames (b.tif)" in said and "side file *.txt (exposure = 2 ms)" in said


def test_flat_frames_without_a_word(tmp_path, capsys):
    """No spot stands out of them: then it is said how darks and flats are told."""
    rng = np.random.default_rng(1)
    for k in range(2):
        pixels = rng.poisson(500, (SIDE, SIDE)).astype(np.uint16)
        tifffile.imwrite(tmp_path / f"{k}.tif", pixels, photometric="minisblack", metadata=None)
    main(["new-dataset", str(tmp_path)])
    assert "No spot stands out in these frames." in capsys.readouterr().out


def test_the_crop_holds_ten_standard_deviations(tmp_path, capsys):
    """Of the widest spot, 30 px here: 300 px, to a step of 20 px and the roughness of a half maximum, some 7 %."""
    y, x = np.mgrid[:500, :500] - 249.5
    pixels = np.rint(50 + 1000 * np.exp(-(x**2 + y**2) / (2 * 30**2))).astype(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="minisblack", metadata=None)
    found, _ = new(tmp_path, capsys=capsys)
    assert 280 <= found.instrument.crop_px <= 340


@pytest.mark.parametrize("name", ["manifest.csv", "instrument.yaml"])
def test_nothing_is_overwritten(tmp_path, name):
    """Nor is the other file written."""
    saved(tmp_path, "a.tif")
    (tmp_path / name).write_text("mine")
    with pytest.raises(SystemExit):
        main(["new-dataset", str(tmp_path)])
    assert (tmp_path / name).read_text() == "mine" and len(list(tmp_path.iterdir())) == 2


NO_PAIR = "must be KEY=VALUE, with a KEY of kind, "


@pytest.mark.parametrize(
    ("word", "right"),
    [
        *((word, NO_PAIR) for word in ("exposure_s", "croppx=3", "exposure_s=", "sensor.pitch=3um")),
        ("exposure_s=abc", "must be a time such as 2ms, or which source is right: file name\n"),
        ("sensor.pixel_pitch_m=3kg", "must be a length such as 3.45um\n"),
        ("sensor.channel=pink", "must be one of red, green, blue, green_r, green_b\n"),
        ("sensor.bit_depth=99", "key sensor.bit_depth is 99; it must be at most 16\n"),
        ("kind=spt", "must be spot, dark or flat\n"),
        ("date=Monday", "must be a date such as 2026-01-31 or 2026-01-31T09:30:00\n"),
    ],
)
def test_answers_that_are_none(tmp_path, word, right, capsys):
    """One sentence that says what would be right; they are not left out without a word."""
    with pytest.raises(SystemExit):
        main(["new-dataset", str(saved(tmp_path, "2ms.tif")), "--set", word])
    assert capsys.readouterr().err.startswith(f"spotcheck: --set {word}: {right}")
    assert not (tmp_path / "manifest.csv").exists()


def test_colours(tmp_path, capsys):
    """A channel is asked for, and taken."""
    tifffile.imwrite(tmp_path / "a.tif", np.stack([spot(0), spot(1), spot(2)], -1), photometric="rgb")
    with pytest.raises(SystemExit):
        main(["new-dataset", str(tmp_path)])
    assert "must say which one to take, such as by --set sensor.channel=red" in capsys.readouterr().err
    found, _ = new(tmp_path, "--set", "sensor.channel=green", capsys=capsys)
    np.testing.assert_array_equal(read_image(found, found.frames[0]), spot(1))


def test_an_empty_folder_gets_a_template(tmp_path, capsys):
    """With an example row, and frames/ to fill."""
    main(["new-dataset", str(tmp_path / "new")])
    assert "fill in the blanks" in capsys.readouterr().out and (tmp_path / "new" / "frames").is_dir()
    with pytest.raises(InputError, match=r"frames/first\.tif is not there"):
        dataset.check_files(dataset.load(tmp_path / "new"))


@pytest.mark.parametrize(("binning", "pitch_m"), [("2x2", 9.6e-6), ("2x1", None)])
def test_binning_changes_the_pixel_pitch(tmp_path, capsys, binning, pitch_m):
    """Multiplied by an equal binning; by an unequal one left blank, until the pitch of the frames is given."""
    saved(tmp_path, "a.tif", "b.tif", description=f"Pixel size = 4.8 um\nBinning = {binning}")
    found, said = new(tmp_path, capsys=capsys)
    assert found.instrument.sensor.pixel_pitch_m == (pitch_m and pytest.approx(pitch_m))
    assert ("rows and columns are binned differently" in said) is (pitch_m is None)
    found, said = new(tmp_path, "--set", "sensor.pixel_pitch_m=4.8um", capsys=capsys)
    assert found.instrument.sensor.pixel_pitch_m == pytest.approx(4.8e-6)
    assert "binned differently" not in said
