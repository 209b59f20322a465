"""Tables beside images: which row describes which image, and how often a table is read."""

from pathlib import PurePath

import numpy as np
import pytest
import tifffile

from spotcheck.dataset.metadata import log_tables
from spotcheck.dataset.metadata.entry import resolve_entries
from spotcheck.dataset.metadata.readers import read_metadata
from spotcheck.dataset.scan import folder_scan

# Folders with an image of one name, rows of a table above them as (path in the row, exposure [ms]), and the exposure of
# each image [ms]: None if the table does not say it, "conflict" if its rows contradict each other.
MATCHES = {
    "folders": (("a", "b"), [("a/x.tif", 2), ("b/x.tif", 7)], (2, 7)),
    "folders by backslashes": (("a", "b"), [(r".\b\x.tif", 7), (r".\a\x.tif", 2)], (2, 7)),
    "paths on another computer": (("a", "b"), [(r"D:\day 1\a\x.tif", 2), (r"D:\day 1\b\x.tif", 7)], (2, 7)),
    "one of them only": (("a", "b"), [("b/x.tif", 7)], (None, 7)),
    "a folder that was renamed": (("a",), [("old/x.tif", 3)], (3,)),
    "two folders that were renamed": (("a",), [("old/x.tif", 3), ("new/x.tif", 4)], ("conflict",)),
    "two rows that agree": (("a",), [("old/x.tif", 3), ("new/x.tif", 3)], (3,)),
    "the folder alone is not named": (("a", "b"), [("x.tif", 2), ("x.tif", 7)], ("conflict", "conflict")),
    "an image beside the table": ((".", "a"), [("x.tif", 5), ("a/x.tif", 6)], (5, 6)),
    "a row for all folders": (("a", "b"), [("x.tif", 5)], (5, 5)),
    "another case": (("a", "b"), [("a/X.TIF", 4), ("b/x.Tif", 8)], (4, 8)),
    "folders in another case": (("Old", "New"), [("old/x.tif", 4), ("NEW/x.tif", 8)], (4, 8)),
    "no suffix": (("a", "b"), [("A/X", 4), ("b/x", 8)], (4, 8)),
    "exact names before others": ((".",), [("X.tif", 4), ("x.tif", 8), ("x", 9)], (8,)),
    "two rows of another case": ((".",), [("X.tif", 4), ("x.TIF", 8)], ("conflict",)),
}


def write_image(path, pages=1):
    """Write a dark stack."""
    path.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(path, np.zeros((pages, 16, 20), np.uint16), photometric="minisblack", metadata=None)


@pytest.mark.parametrize("case", MATCHES)
def test_a_row_describes_the_image_at_its_path(tmp_path, case):
    """By the longest common end of both paths; rows that fit equally well and differ are a conflict."""
    folders, rows, wanted = MATCHES[case]
    for folder in folders:
        write_image(tmp_path / folder / "x.tif")
    (tmp_path / "log.csv").write_text("".join(f"{a},{b}\n" for a, b in [("path", "Exposure (ms)"), *rows]))
    found = {}
    for frame in folder_scan.scan_folder(tmp_path).frames:
        agreed, conflicts = resolve_entries(frame.metadata)
        entry = agreed.get("exposure_s")
        found[frame.file] = "conflict" if conflicts else entry and entry.value
    values = (1e-3 * value if isinstance(value, int) else value for value in wanted)
    files = ((PurePath(folder) / "x.tif").as_posix() for folder in folders)
    assert found == dict(zip(files, values, strict=True))


@pytest.mark.parametrize(
    ("images", "table", "names", "remark"),
    [
        (("k1.tif", "k2.tif"), "log.csv", ("k1.tif", "k2.tif"), None),
        (("k1.tif", "K2.tif"), "log.csv", ("K1", "k2"), None),
        (("k1.tif",), "log.csv", ("k1.tif", "k2.tif"), "log.csv: 1 of 2 rows match no image (k2.tif)"),
        (("k1.tif", "broken.tif"), "log.csv", ("k1.tif", "broken.tif"), None),
        (("k1.tif",), "log.csv", ("1", "2"), "log.csv: no row matches an image (1, 2); write the file names"),
        (("k.tif", "k.png"), "log.csv", ("k",), "log.csv: no row matches an image (k); write the file names"),
        (("a/b/k1.tif",), "log.csv", ("k1.tif",), "log.csv: its images are more than one folder below it"),
        (("a/b/k1.tif",), "log.csv", ("k2.tif",), None),
    ],
)
def test_rows_without_an_image_are_named(tmp_path, images, table, names, remark):
    """In one line for each table."""
    for image in images:
        write_image(tmp_path / image)
    if "broken.tif" in images:
        (tmp_path / "broken.tif").write_bytes(b"II*\0")
    (tmp_path / table).write_text(
        "".join(f"{name},{ms}\n" for name, ms in [("file", "t_exp (ms)"), *((n, 3) for n in names)])
    )
    found = folder_scan.scan_folder(tmp_path).table_remarks
    assert len(found) == (remark is not None) and all(one.startswith(remark) for one in found)


@pytest.mark.parametrize(("pages", "is_conflict"), [(1, True), (2, True), (3, False), (4, False)])
def test_more_rows_than_pages_are_a_conflict(tmp_path, pages, is_conflict):
    """Up to that number, each row describes a page."""
    write_image(tmp_path / "x.tif", pages)
    (tmp_path / "log.csv").write_text("file,z (mm)\nx.tif,1\nx.tif,2\nx.tif,4\n")
    frames = folder_scan.scan_folder(tmp_path).frames
    resolved = [resolve_entries(frame.metadata, frame.page) for frame in frames]
    assert [bool(conflicts) for _, conflicts in resolved] == [is_conflict] * pages
    if not is_conflict:
        values = [agreed["z_m"].value if "z_m" in agreed else None for agreed, _ in resolved]
        assert values == [1e-3, 2e-3, 4e-3, None][:pages]


def test_emva_lists_name_images_by_their_folders(tmp_path):
    """As log tables do."""
    for folder in ("long", "short"):
        write_image(tmp_path / folder / "i_1.tif")
    text = "n 12 20 16\nb 3000000 90\ni long\\i_1.tif\nb 200000 6\ni short\\i_1.tif\n"
    (tmp_path / "list.txt").write_text(text)
    for folder, exposure_s in (("long", 3e-3), ("short", 2e-4)):
        agreed, conflicts = resolve_entries(read_metadata(tmp_path / folder / "i_1.tif"))
        assert agreed["exposure_s"].value == exposure_s and not conflicts


def test_each_table_is_read_once(tmp_path, monkeypatch):
    """However many images lie beside it: the work grows as the number of tables."""
    count, read = 60, []
    for number in range(count):
        write_image(tmp_path / f"s{number}.tif")
        (tmp_path / f"s{number}.csv").write_text(f"image,texp (us)\ns{number}.tif,{number + 1}\n")
    read_text = log_tables.read_text
    monkeypatch.setattr(log_tables, "read_text", lambda path: read.append(path) or read_text(path))
    scan = folder_scan.scan_folder(tmp_path)
    exposures = [resolve_entries(frame.metadata)[0]["exposure_s"].value for frame in scan.frames]
    assert exposures == pytest.approx([1e-6 * (number + 1) for number in range(count)])
    assert len(read) == len(set(read)) == count and not scan.unread_files
    sources = {entry.source_pattern for frame in scan.frames for entry in frame.metadata}
    assert sources == {"side file *.csv", "file name"}
