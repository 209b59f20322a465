"""A second call of `new-dataset` completes both files, and leaves every character that a person wrote."""

import difflib

import numpy as np
import pytest
import tifffile

from spotcheck.cli import main
from spotcheck.dataset import folder as dataset

WAVELENGTH = "laser.wavelength_m=1064nm"
MANIFEST = (
    "# my bench\r\nfile,kind, angle_deg,exposure_s,repeat,note\r\n"
    'a_1.tif,spot,30,,0,"first, of two"\r\n'
    "\r\na_2.tif,spot,30,0.004,1,\r\nd.tif, dark ,,,0,lid on\r\n"
)


def write_frames(folder, *names):
    """Write frames with a spot, of one size."""
    folder.mkdir(parents=True, exist_ok=True)
    y, x = np.mgrid[:44, :50]
    for seed, name in enumerate(names):
        light = 900 * np.exp(-((x - 24) ** 2 + (y - 20) ** 2) / 18) + np.random.default_rng(seed).normal(80, 2, x.shape)
        tifffile.imwrite(folder / name, np.rint(light).astype(np.uint16), photometric="minisblack", metadata=None)
    return folder


def call(folder, capsys, *answers: str) -> str:
    """Return what the command prints."""
    main(["new-dataset", str(folder), *(word for answer in answers for word in ("--set", answer))])
    return capsys.readouterr().out


def changed_lines(before: str, after: str) -> list[str]:
    """Return the lines that went, with -, and those that came, with +."""
    lines = difflib.ndiff(before.splitlines(keepends=True), after.splitlines(keepends=True))
    return [line for line in lines if line[0] in "+-"]


def test_a_second_call_adds_a_key_and_nothing_else(tmp_path, capsys):
    """In place of its comment; a third call finds nothing to do."""
    folder = write_frames(tmp_path, "a_3ms.tif", "b_3ms.tif")
    call(folder, capsys)
    manifest, instrument = ((folder / name).read_text() for name in ("manifest.csv", "instrument.yaml"))
    said = call(folder, capsys, WAVELENGTH)
    assert "instrument.yaml: laser.wavelength_m is 1.064e-06 (as you said: 1064nm)\n" in said
    assert (folder / "manifest.csv").read_text() == manifest
    completed = (folder / "instrument.yaml").read_text()
    assert [line[:2] + line[2:].split("#")[0].strip() for line in changed_lines(instrument, completed)] == [
        "- ",
        "+ laser:",
        "- ",
        "+ wavelength_m: 1.064e-06",
    ]
    assert dataset.load(folder).instrument.laser.wavelength_m == 1.064e-6
    said = call(folder, capsys, WAVELENGTH)
    assert "nothing is missing" in said and "has another value" not in said
    assert (folder / "instrument.yaml").read_text() == completed


def test_what_a_person_wrote_stays(tmp_path, capsys):
    """Comments, line ends, quotes, spaces, columns and values; blank cells are filled, and it is said where."""
    folder = write_frames(tmp_path, "a_1.tif", "a_2.tif", "d.tif")
    (folder / "manifest.csv").write_bytes(b"\xef\xbb\xbf" + MANIFEST.encode())
    yaml = "sensor: # the old one\n    bit_depth: 12   # from the label\nlaser:\n    wavelength_m: 9.8e-7\ncrop_px: 40"
    (folder / "instrument.yaml").write_text(yaml)
    said = call(folder, capsys, WAVELENGTH, "exposure_s=7ms", "sensor.pixel_pitch_m=3.2um")
    wanted = MANIFEST.replace("a_1.tif,spot,30,,0", "a_1.tif,spot,30,0.007,0")
    wanted = wanted.replace("d.tif, dark ,,,", "d.tif, dark ,,0.007,")
    assert (folder / "manifest.csv").read_bytes() == b"\xef\xbb\xbf" + wanted.encode()
    added = changed_lines(yaml, (folder / "instrument.yaml").read_text().removesuffix("\n"))
    assert [line.split("#")[0].rstrip() for line in added] == ["+     pixel_pitch_m: 3.2e-06"]
    for sentence in (
        "manifest.csv: exposure_s is filled in 2 of 3 rows",
        "manifest.csv: exposure_s has another value in 1 row, which stays",
        "instrument.yaml: laser.wavelength_m has another value, which stays",
    ):
        assert sentence in said
    assert "Not found" not in said
    assert dataset.load(folder).instrument.sensor.pixel_pitch_m == 3.2e-6


def test_new_columns_stand_at_the_end(tmp_path, capsys):
    """With the condition that they make; images without a row are named."""
    folder = write_frames(tmp_path, "z4.tif", "z9.tif")
    call(folder, capsys)
    write_frames(folder, "z12.tif")
    before = (folder / "manifest.csv").read_text()
    said = call(folder, capsys, "z_m=cm")
    rows = [line for line in (folder / "manifest.csv").read_text().splitlines() if not line.startswith("#")]
    old_rows = [line for line in before.splitlines() if not line.startswith("#")]
    # Each position is a condition of its own, so that the second row is no repeat of the first.
    old_rows[-1] = old_rows[-1].removesuffix("1") + "0"
    assert rows == [f"{row},{cell}" for row, cell in zip(old_rows, ("z_m", "0.04", "0.09"), strict=True)]
    assert dataset.load(folder).instrument.conditions == ("z_m",)
    assert "manifest.csv: no row for 1 frame (z12.tif); add rows for those to be used" in said


@pytest.mark.parametrize("is_edited", [False, True])
@pytest.mark.parametrize("has_repeats", [False, True])
def test_counted_repeats_follow_the_conditions(tmp_path, capsys, has_repeats, is_edited):
    """Repeats that the program counted in one condition are numbered anew once exposures split it; others stay.

    Without two exposures of one repeat, `check` says that p1 will be skipped, and `new-dataset` says what it left.
    """
    names = [f"{letter}.tif" for letter in "abcd"]
    folder = write_frames(tmp_path, *names)
    call(folder, capsys)
    repeats = [4, 2, 2, 4] if has_repeats else [0, 1, 0, 1]
    rows = [f"{name},{ms},{repeat}" for name, ms, repeat in zip(names, (3, 3, 8, 8), repeats, strict=True)]
    (folder / "log.csv").write_text("\n".join(["file,Exposure (ms)" + ",rep" * has_repeats, *rows]) + "\n")
    if not has_repeats:
        (folder / "log.csv").write_text((folder / "log.csv").read_text().replace(",0\n", "\n").replace(",1\n", "\n"))
    path = folder / "manifest.csv"
    if is_edited:
        path.write_text(path.read_text().replace("d.tif,spot,,,3", "d.tif,spot,,,7"))
    said = call(folder, capsys)
    written = [frame.repeat for frame in dataset.load(folder).frames]
    assert written == ([0, 1, 2, 7] if is_edited else repeats)
    assert ("manifest.csv: repeat is numbered anew in" in said) != is_edited
    assert ("manifest.csv: repeat differs from the table above in" in said) == is_edited
    main(["check", str(folder)])
    assert ("no repeat in manifest.csv has two" in capsys.readouterr().out) == is_edited
    assert "nothing is missing" in call(folder, capsys)


def test_kinds_that_were_assumed_are_not_kept_in_silence(tmp_path, capsys):
    """A log that says dark afterwards differs from the written spot."""
    folder = write_frames(tmp_path, "a.tif", "b.tif")
    call(folder, capsys)
    (folder / "log.csv").write_text("file,kind\na.tif,spot\nb.tif,dark\n")
    assert "manifest.csv: kind differs from the table above in 1 row, and stays" in call(folder, capsys)


def test_the_budget_without_exposures_is_taken_back(tmp_path, capsys):
    """Where the line is the program's own; a person's choice stays."""
    for name, edit, budget in (("own", "free ", "linear"), ("chosen", "spot_area ", "spot_area")):
        folder = write_frames(tmp_path / name, "a.tif")
        call(folder, capsys)
        path = folder / "instrument.yaml"
        path.write_text(path.read_text().replace("photon_budget: free ", f"photon_budget: {edit}"))
        call(folder, capsys, "exposure_s=5ms")
        assert dataset.load(folder).instrument.model.photon_budget == budget


@pytest.mark.parametrize(
    ("yaml", "is_given"),
    [
        ("laser: {power_w: 0.01}\n", False),
        ("based_on: bench.yaml\n", True),
        ("laser:\n  wavelength_m: 1.064e-6\n", True),
    ],
)
def test_keys_without_a_place_are_named(tmp_path, capsys, yaml, is_given):
    """A section in one line stays as it is; a key of the shared file is there already."""
    folder = write_frames(tmp_path, "a_1ms.tif")
    (folder / "bench.yaml").write_text("laser: {wavelength_m: 1.064e-6}\n")
    (folder / "instrument.yaml").write_text(yaml)
    said = call(folder, capsys, WAVELENGTH)
    assert (folder / "instrument.yaml").read_text().startswith(yaml)
    assert ("instrument.yaml: laser.wavelength_m has no place there; add it with the value" in said) != is_given
    assert "wrote manifest.csv" in said


def test_an_untouched_template_is_filled(tmp_path, capsys):
    """Once there are images; a template that was edited is completed."""
    folder = tmp_path / "new"
    call(folder, capsys)
    write_frames(folder / "frames", "a_1ms.tif")
    assert "wrote manifest.csv, instrument.yaml" in call(folder, capsys)
    assert [frame.file for frame in dataset.load(folder).frames] == ["frames/a_1ms.tif"]
