"""Metadata in sidecar files: texts with the name of an image, tables of a folder, and lists of EMVA 1288 data.

An EMVA 1288 list describes a reference data set for the characterization of a camera: images at several light levels.
"""

import csv
import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path, PureWindowsPath

from spotcheck.dataset.metadata import key_values, units
from spotcheck.dataset.metadata.entry import MetadataEntry
from spotcheck.errors import InputError
from spotcheck.io import schema
from spotcheck.io.text import read_text

TEXT_SUFFIXES = (".txt", ".json", ".yaml", ".yml", ".xml")
TABLE_SUFFIXES = (".csv", ".tsv")
# Headings of the column that names the images, as `key_values.normalize_key` spells them.
NAME_HEADINGS = ("file", "filename", "filepath", "image", "imagename", "imagefile", "frame", "framename", "path")
# Separators of cells.
SEPARATORS = (",", ";", "\t")
# Most rows of a table that are read.
MOST_ROWS = 100_000
# Lines that an EMVA 1288 list must have: n with bits, columns and rows; b (bright) or d (dark) with exposure [ns] and
# photons per pixel of a light level; i with the path of an image of the level above it.
_EMVA_LINES = tuple(re.compile(rf"(?m)^{line}") for line in (r"n\s+\d+\s+\d+\s+\d+", r"[bd]\s+\d", r"i\s+\S"))

# Entries of each image, by its file name without folders.
EntriesByImage = dict[str, tuple[MetadataEntry, ...]]


def find_sidecars(image: Path) -> list[Path]:
    """Return the text files with the name of an image: a.json and a.tif.json for a.tif."""
    paths = [image.with_suffix(suffix) for suffix in TEXT_SUFFIXES]
    paths += [image.with_name(image.name + suffix) for suffix in TEXT_SUFFIXES]
    return [path for path in paths if path.is_file()]


def find_tables(folder: Path) -> list[Path]:
    """Return the tables and EMVA 1288 lists in a folder that describe images."""
    return list(_find_tables(folder, folder.stat().st_mtime_ns))


@lru_cache(maxsize=64)
def _find_tables(folder: Path, _mtime_ns: int) -> tuple[Path, ...]:
    """Return the tables of a folder, found once for all its images; the time of the folder is a key of the cache."""
    paths = [path for path in folder.iterdir() if path.suffix.lower() == ".txt" or _may_be_table(path)]
    return tuple(sorted(path for path in paths if path.is_file() and _read_table(path)))


def read_sidecars(image: Path) -> Iterator[MetadataEntry]:
    """Yield the metadata that sidecar files, and tables in the folder and its parent, give for an image.

    Raises
    ------
    InputError
        If a sidecar file cannot be read.
    """
    for path in find_sidecars(image):
        source = f"side file {path.name}"
        size = path.stat().st_size
        if size > key_values.LONGEST_TEXT:
            raise InputError(
                f"{path.name}: has {size} bytes, but a text beside an image has at most {key_values.LONGEST_TEXT};"
                " move it away"
            )
        if path.suffix.lower() in (".yaml", ".yml"):
            yield from key_values.parse_pairs(key_values.flatten_keys(schema.read_keys(path)), source)
        else:
            yield from key_values.parse_text(read_text(path), source)
    for folder in image.parents[:2]:
        for path in find_tables(folder):
            yield from _read_table(path).get(image.name, ())


def _read_table(path: Path) -> EntriesByImage:
    """Return the entries of each image in a table or EMVA 1288 list; empty for any other file."""
    status = path.stat()
    return _parse_file(path, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=32)
def _parse_file(path: Path, size: int, _mtime_ns: int) -> EntriesByImage:
    """Return the entries of each image in a table or list of `size` bytes; empty for any other file.

    Size and time of the file are keys of the cache, so that a changed file is read again.
    """
    try:
        text = read_text(path) if size <= key_values.LONGEST_TEXT else ""
    except InputError:
        return {}
    if _may_be_table(path):
        return parse_table(text, path.name)
    return _parse_emva_list(text, path.name) if all(line.search(text) for line in _EMVA_LINES) else {}


def _may_be_table(path: Path) -> bool:
    """Return whether a file may be a table of images by its name; the manifest is an output, not a source."""
    return path.suffix.lower() in TABLE_SUFFIXES and path.name != "manifest.csv"


def parse_table(text: str, source: str) -> EntriesByImage:
    """Return the entries of each image in a table with one row per image, or per page of a stack.

    Parameters
    ----------
    text : content of the table; lines that start with # are comments.
    source : name of the file, the source of the entries.

    Returns
    -------
    dict
        Entries by file name of the image; empty if no column names images, or the text is not a table.
    """
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        return {}
    try:
        # The separator is the candidate that is most frequent in the header.
        reader = csv.DictReader(lines[: MOST_ROWS + 1], delimiter=max(SEPARATORS, key=lines[0].count))
        heading_of = {key_values.normalize_key(heading): heading for heading in reversed(reader.fieldnames or ())}
        # Rows with surplus cells (key None) or missing ones (value None) are dropped.
        rows = [row for row in reader if None not in row and None not in row.values()]
    except csv.Error:
        return {}
    name_heading = next((heading_of[name] for name in NAME_HEADINGS if name in heading_of), None)
    if name_heading is None:
        return {}
    # Only columns of quantities: a comma in a remark is no part of a number.
    for heading in filter(key_values.is_quantity, heading_of.values()):
        for row, cell in zip(rows, units.resolve_commas([row[heading] for row in rows]), strict=True):
            row[heading] = cell
    rows_by_image: dict[str, list[list[tuple[str, str]]]] = {}
    for row in rows:
        image = PureWindowsPath(row.pop(name_heading).strip()).name
        pairs = [(heading.strip(), cell.strip()) for heading, cell in row.items() if cell.strip()]
        rows_by_image.setdefault(image, []).append(pairs)
    # Several rows of one image describe the pages of its stack.
    return {
        image: tuple(
            entry
            for page, pairs in enumerate(image_rows)
            for entry in key_values.parse_pairs(pairs, source, page if len(image_rows) > 1 else None)
        )
        for image, image_rows in rows_by_image.items()
    }


def _parse_emva_list(text: str, source: str) -> EntriesByImage:
    """Return the entries of each image in the list of an EMVA 1288 reference data set.

    Lines that are not understood are skipped. `source` is the name of the file.
    """
    entries_by_image: EntriesByImage = {}
    # Entries of all images of the camera, and of those of the current light level.
    camera_entries: tuple[MetadataEntry, ...] = ()
    level_entries: tuple[MetadataEntry, ...] = ()
    for line in text.splitlines():
        cells = line.split()
        match cells[:1], cells[1:]:
            case ["n"], [bits, *_] if bits.isdecimal():
                camera_entries = (MetadataEntry("sensor.bit_depth", int(bits), line, source),)
            case ["b" | "d" as letter], [exposure, *photons]:
                values: dict[str, float | int | str | None] = {
                    "kind": "flat" if letter == "b" else "dark",
                    "exposure_s": key_values.parse_value(exposure, "ns", "s"),
                }
                if letter == "b":
                    # A plain number is read as one in seconds, whose factor is 1.
                    values["photons_per_px"] = key_values.parse_value((photons or [""])[0], "s", "s")
                level_entries = tuple(MetadataEntry(*item, line, source) for item in values.items())
            case ["i"], [*words]:
                entries_by_image[PureWindowsPath(" ".join(words)).name] = (*level_entries, *camera_entries)
    return entries_by_image
