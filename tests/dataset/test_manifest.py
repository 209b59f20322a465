"""manifest.csv as spreadsheets, editors and other systems write it: read, or refused with the true cause."""

import os
import subprocess
import sys

import numpy as np
import pytest
import tifffile

from spotcheck.characterization.characterise import characterise_dataset
from spotcheck.cli import main
from spotcheck.crops.cropping import crop_spots, is_usable
from spotcheck.crops.ingest import MAX_NAMED, ingest_frames
from spotcheck.dataset import folder as dataset
from spotcheck.dataset import frames
from spotcheck.errors import InputError
from spotcheck.io import store
from tests.samples.small_datasets import HEADER, folder, gaussian, loaded, noisy

GOOD = "frames/a.tif,spot,0,1e-4,0"
RAMP = np.arange(40 * 50, dtype=np.uint16).reshape(40, 50)


def image(base, name: str = "frames/a.tif", pixels: np.ndarray = RAMP):
    """An image in a dataset folder."""
    path = base / name
    path.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(path, pixels, photometric="minisblack")
    return path


def files_of(base, rows: list[str], header: str = HEADER) -> list[str]:
    """Files that a manifest names, all of them there."""
    found = dataset.load(folder(base, rows, "crop_px: 8", header))
    dataset.check_files(found)
    return [frame.file for frame in found.frames]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("name", ["manifest.csv", "instrument.yaml"])
def test_encodings(tmp_path, encoding, name):
    """UTF-8 and UTF-16, with and without a byte order mark."""
    folder(tmp_path, ["frames/größe.tif,spot,0,1e-4,0"], "name: Größe")
    (tmp_path / name).write_bytes((tmp_path / name).read_text("utf-8").encode(encoding))
    found = dataset.load(tmp_path)
    assert (found.frames[0].file, found.title) == ("frames/größe.tif", "Größe")


@pytest.mark.parametrize("first", ["sep=,", '"sep=,"', "sep=,,,,"])
def test_the_separator_that_excel_is_told(tmp_path, first):
    """The first line is no header, and lines keep their numbers."""
    (tmp_path / "manifest.csv").write_text(f"{first}\n{HEADER}\n{GOOD}\n")
    assert [frame.line for frame in dataset.load(tmp_path).frames] == [3]


def test_capitals_of_a_header(tmp_path):
    """Columns that the program knows go by any capitals; others keep theirs."""
    header = "File,KIND,Angle_deg,Exposure_s,Repeat,Page,Photons_per_px,Z_m,Note"
    row = "frames/a.tif,flat,,1e-4,0,2,500,0.1,x"
    frame = dataset.load(folder(tmp_path, [row], "conditions: [z_m]", header)).frames[0]
    assert (frame.page, frame.extra) == (2, {"photons_per_px": "500", "z_m": "0.1", "Note": "x"})


def test_back_slashes(tmp_path):
    """Windows parts folders by them."""
    image(tmp_path, "frames/day 1/a.tif")
    assert files_of(tmp_path, [GOOD.replace("frames/", "frames\\day 1\\")]) == ["frames/day 1/a.tif"]


def test_a_file_whose_name_starts_like_a_comment(tmp_path):
    """#1.tif is a row where there is such a file, and a comment where there is none."""
    image(tmp_path, "#1.tif")
    rows = ["#1.tif,spot,0,1e-4,0", "#2.tif,spot,0,1e-4,1", "# frames/x.tif,spot,0,1e-4,2", f"#{'x' * 999}.tif"]
    assert files_of(tmp_path, rows) == ["#1.tif"]


@pytest.mark.parametrize(("listed", "stored"), [("\u00e4", "a\u0308"), ("a\u0308", "\u00e4")])
def test_umlauts_of_one_letter_and_of_two(tmp_path, listed, stored):
    """Composed in the manifest and decomposed on the disk, or the other way round; also in a folder's name."""
    image(tmp_path, f"frames/{stored}/{stored}.tif")
    assert files_of(tmp_path, [GOOD.replace("a.tif", f"{listed}/{listed}.tif")]) == [f"frames/{stored}/{stored}.tif"]


def test_where_a_missing_file_is(tmp_path):
    """Beside frames/, or in other capitals; of an HDF5 file, what should be in it is not named."""
    with pytest.raises(InputError, match=r"line 2: frames/x\.h5 is not there"):
        files_of(tmp_path, ["frames/x.h5#/d,spot,0,1e-4,0"])
    image(tmp_path, "a.tif")
    with pytest.raises(InputError, match=r"line 2: frames/a\.tif is not there, but a\.tif is; correct the row"):
        files_of(tmp_path, [GOOD])
    assert files_of(tmp_path, ["a.tif,spot,0,1e-4,0"]) == ["a.tif"]
    image(tmp_path, "frames/B.TIF")
    with pytest.raises(InputError, match=r"line 3: frames/b\.tif is not there, but frames/B\.TIF is"):
        files_of(tmp_path, ["a.tif,spot,0,1e-4,0", "frames/b.tif,spot,0,1e-4,1"])


STACK = np.stack([RAMP + k for k in range(12)])


@pytest.mark.parametrize(
    ("pages", "unnamed"),
    [("", "pages 1 to 11 are"), ("0", "pages 1 to 11 are"), ("7", None), ("0 1 2 4 5 6 7 8 9 10 11", None)],
)
def test_pages_that_no_row_names(tmp_path, pages, unnamed):
    """A stack of which nobody says that it is one is refused; else a remark says which pages are left out."""
    image(tmp_path, pixels=STACK)
    rows = [f"frames/a.tif,spot,0,1e-4,{k},{page}" for k, page in enumerate(pages.split() or [""])]
    found = dataset.load(folder(tmp_path, rows, "crop_px: 8", HEADER + ",page"))
    if unnamed:
        with pytest.raises(InputError, match=rf"^frames/a\.tif: {unnamed} named by no row of manifest\.csv; add a row"):
            frames.check_formats(found)
    else:
        said = "pages 0 to 6, 8 to 11 are" if pages == "7" else "page 3 is"
        assert frames.check_formats(found).remarks == (f"frames/a.tif: {said} named by no row of manifest.csv",)


def test_stacks_beside_frames_may_be_named_in_part(tmp_path):
    """As single images there may go unnamed."""
    image(tmp_path, "scan.tif", STACK)
    found = dataset.load(folder(tmp_path, ["scan.tif,spot,0,1e-4,0"], "crop_px: 8"))
    assert frames.check_formats(found).remarks == ()


@pytest.mark.parametrize("beside", ["frames/", ""])
def test_a_new_manifest_has_a_row_a_page(tmp_path, beside, capsys):
    """Of stacks, beside single images with commas and umlauts in their names, in frames/ or, where it is empty, beside
    it; `check` finds them in order. Files of other formats are spoken of."""
    image(tmp_path, f"{beside}b.TIF", STACK[:3])
    image(tmp_path, f"{beside}a, ä.png.tif")
    (tmp_path / f"{beside}c.bmp").touch()
    main(["new-dataset", str(tmp_path)])
    assert ".bmp" in capsys.readouterr().out
    (tmp_path / "instrument.yaml").write_text("crop_px: 8")
    found = dataset.load(tmp_path)
    assert [(frame.file, frame.page) for frame in found.frames] == [
        (f"{beside}a, ä.png.tif", 0),
        *((f"{beside}b.TIF", page) for page in range(3)),
    ]
    main(["check", str(tmp_path)])
    assert "4 spot, 0 dark, 0 flat frames of 50 × 40 px, 16 bit: in order" in capsys.readouterr().out


def test_a_manifest_without_stacks_has_no_column_for_pages(tmp_path):
    """The five that every dataset needs."""
    image(tmp_path)
    main(["new-dataset", str(tmp_path)])
    assert HEADER in (tmp_path / "manifest.csv").read_text().splitlines()


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_terminals_of_other_encodings(tmp_path, encoding):
    """Every sentence is printed, with a number for each sign that the terminal does not know."""
    image(tmp_path, "frames/µ°.tif")
    folder(tmp_path, [GOOD.replace("a.tif", "µ°.tif")], "crop_px: 8")
    words = [sys.executable, "-c", "from spotcheck.cli import main; main()", "check", str(tmp_path)]
    environment = os.environ | {"PYTHONIOENCODING": encoding, "LC_ALL": "C"}
    done = subprocess.run(words, env=environment, capture_output=True, check=True)
    times = "\\xd7" if encoding == "ascii" else "×"
    assert f"frames of 50 {times} 40 px, 16 bit: in order\n" in done.stdout.decode(encoding)
    image(tmp_path, "frames/µ°.tif", RAMP.astype(np.int16))
    done = subprocess.run(words, env=environment, capture_output=True, check=False)
    assert done.returncode == 2 and b"int16 pixels" in done.stderr and b"Traceback" not in done.stderr


def test_copies_are_no_repeats(tmp_path, capsys):
    """A frame with the pixels of an earlier one is flagged and left out, under whatever name, format or page it comes;
    black frames may be equal."""
    spots = [noisy(gaussian(60, 500.0, 30, 30, 4.0), seed) for seed in range(3)]
    black = np.zeros_like(spots[0])
    text = "crop_px: 40\nsensor: {bit_depth: 10}"
    found = loaded(tmp_path, [spots[0], spots[1], spots[0], black, black, spots[2], spots[0]], text)
    table = ingest_frames(found)
    assert table["copy_of"].values.tolist() == [-1, -1, 0, -1, -1, -1, 0]
    assert store.remarks_of(table) == [
        f"frames/f{k}.tif holds the same pixels as frames/f0.tif, so that it is left out as a copy" for k in (2, 6)
    ]
    crop_spots(found, table, tmp_path / "crops.nc", code="c", inputs=[])
    with store.read(tmp_path / "crops.nc") as own:
        status = own["status"].sel(centring="light").values.ravel()
    assert [is_usable(one) for one in status] == [True, True, False, False, False, True, False]
    assert store.status_names(status[2]) == "copy"
    main(["ingest", str(tmp_path), "--output", str(tmp_path / "frames.nc")])
    assert "frames/f6.tif holds the same pixels as frames/f0.tif" in capsys.readouterr().out


def test_many_copies_are_counted(tmp_path):
    """A remark that nobody reads says nothing."""
    found = loaded(tmp_path, [RAMP] * 9, "crop_px: 8")
    assert len(store.remarks_of(ingest_frames(found))) == MAX_NAMED + 1
    assert store.remarks_of(ingest_frames(found))[-1] == "3 more frames are copies"


def test_copies_of_flats_and_darks_give_no_noise(tmp_path):
    """A pair of copies has no difference: it would pass for a sensor without noise."""
    rng = np.random.default_rng(1)
    rows, light = [], {"dark": [0.0], "flat": [100.0, 200.0, 300.0]}
    (tmp_path / "frames").mkdir()
    for kind, levels in light.items():
        for level in levels:
            pair = [np.rint(rng.normal(50 + level, 3 + 0.1 * level**0.5, (40, 50))).astype(np.uint16) for _ in range(2)]
            pair[1] = pair[0] if level == 200 else pair[1]
            for k, pixels in enumerate(pair):
                name = f"frames/{kind}{level:g}_{k}.tif"
                tifffile.imwrite(tmp_path / name, pixels)
                rows.append(f"{name},{kind},,{(1 + level) * 1e-4:g},{k}")
    found = characterise_dataset(folder(tmp_path, rows, "sensor: {bit_depth: 12}"))
    assert "frames/flat200_1.tif holds the same pixels as frames/flat200_0.tif" in str(found)
    assert "1 flat level has a single frame" in str(found)


def test_a_reader_that_has_seen_enough(tmp_path):
    """`spotcheck check … | head -0` ends as other programs do, without a word."""
    image(tmp_path)
    folder(tmp_path, [GOOD], "crop_px: 8")
    words = [sys.executable, "-c", "from spotcheck.cli import main; main()", "check", str(tmp_path)]
    run = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    run.stdout.close()
    assert (run.stderr.read(), run.wait()) == (b"", 141)
