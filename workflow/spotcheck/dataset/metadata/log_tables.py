"""Log tables and lists of EMVA 1288 data, which describe the images in their folder and in the folders below it.

A table has one row per image, or per page of a stack. An EMVA 1288 list describes a reference data set for the
characterization of a camera: images at several light levels.
"""

import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from itertools import takewhile
from pathlib import Path, PureWindowsPath

from spotcheck.dataset.metadata import key_values, units
from spotcheck.dataset.metadata.entry import MetadataEntry
from spotcheck.errors import InputError
from spotcheck.io.formats.names import IMAGE_SUFFIXES
from spotcheck.io.text import read_text

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


@dataclass(frozen=True)
class TableRow:
    """One row of a table, or one image of an EMVA 1288 list."""

    path: tuple[str, ...]  # parts of the path by which the row names its image; the last one is the file name
    entries: tuple[MetadataEntry, ...]  # what the row gives
    number: int  # number of the row in its table

    @property
    def name(self) -> str:
        """The path of the image in messages."""
        return "/".join(self.path)


# Rows by the file name of their image, without folders.
RowsByName = dict[str, list[TableRow]]


class TableReader:
    """Reader of the tables in folders, which reads each of them once.

    A table that changes later is not read again: each scan of a folder makes a reader of its own.
    """

    def __init__(self) -> None:
        """Start without any folder."""
        self._read_folder = cache(_read_folder)
        # Number of files of each name in the folders directly below a folder.
        self._count_names = cache(lambda folder: Counter(path.name for path in folder.glob("*/*")))
        self._count_images = cache(_count_images)
        # Rows that describe an image, as (table, number of the row).
        self._used_rows: set[tuple[Path, int]] = set()

    def find_tables(self, folder: Path) -> list[Path]:
        """Return the tables and EMVA 1288 lists in a folder that describe images, sorted by name."""
        return self._read_folder(folder)[0]

    def read_entries(self, image: Path, page_count: int | None = None) -> Iterator[MetadataEntry]:
        """Yield what the tables in the folder of an image and in the folder above it give for the image.

        A row may name the image in another case or without its suffix, if no other image fits that name. A table gives
        the row whose path has most folders in common with that of the image. Several rows of one path
        describe the pages of a stack in their order. Rows that cannot be told apart give all their entries, so that
        the values in which they differ are in conflict; the texts of these entries start with the path in the row.

        Parameters
        ----------
        image : path of the image.
        page_count : number of pages of the image; None if it is not known.
        """
        for folder in image.parents[:2]:
            for table, rows in self._find_rows(image, folder):
                # A table of this image alone is named in messages as other files beside an image are.
                is_own = table.stem == image.stem and table.parent == image.parent
                source = f"side file {table.name}" if is_own else table.name
                for entry in self._select_entries(rows, image, table, page_count):
                    yield replace(entry, source=source)

    def list_unused_rows(self, folder: Path) -> dict[Path, tuple[list[TableRow], int]]:
        """Return the rows of each table in a folder that described no image so far, and the number of all its rows.

        Tables whose rows were all used are left out.
        """
        rows_of_table: dict[Path, list[TableRow]] = {}
        for items in self._read_folder(folder)[1].values():
            for table, rows in items:
                rows_of_table.setdefault(table, []).extend(rows)
        unused = {
            table: sorted(
                (row for row in rows if (table, row.number) not in self._used_rows), key=lambda row: row.number
            )
            for table, rows in rows_of_table.items()
        }
        return {table: (rows, len(rows_of_table[table])) for table, rows in unused.items() if rows}

    def _find_rows(self, image: Path, folder: Path) -> Iterator[tuple[Path, list[TableRow]]]:
        """Yield each table in a folder with the rows that name an image; their paths end in its exact name.

        Rows with another case, or without the suffix, count if no row of the table has the exact name, and if they name
        no other image.
        """
        name, stem = image.name.casefold(), image.stem.casefold()
        rows_of_table: dict[Path, list[TableRow]] = {}
        for key in (name, stem):
            for table, rows in self._read_folder(folder)[1].get(key, ()):
                rows_of_table.setdefault(table, []).extend(rows)
        for table, rows in sorted(rows_of_table.items()):
            if exact_rows := [row for row in rows if row.path[-1] == image.name]:
                yield table, exact_rows
                continue
            key = name if any(row.path[-1].casefold() == name for row in rows) else stem
            similar_rows = [
                replace(row, path=(*row.path[:-1], image.name))
                for row in rows
                if row.path[-1].casefold() == key and not _names_another_file(row.path, 0, folder, image)
            ]
            if similar_rows and self._count_images(image.parent)[key] == 1:
                yield table, similar_rows

    def _select_entries(
        self, rows: Sequence[TableRow], image: Path, table: Path, page_count: int | None
    ) -> Iterator[MetadataEntry]:
        """Yield the entries of the rows that describe an image, among the rows of a table that have its file name.

        The other parameters are those of `read_entries`.
        """
        folder = table.parent
        relative_path, full_path = image.relative_to(folder).parts, image.absolute().parts
        common_parts = [_count_common_parts(row.path, full_path) for row in rows]
        is_exact = [row.path == relative_path for row in rows]
        # Folders in another case count where nothing else distinguishes the rows.
        similar_parts = [_count_common_parts(_fold_case(row.path), _fold_case(full_path)) for row in rows]
        ranks = list(zip(is_exact, common_parts, similar_parts, strict=True))
        best = max(ranks)
        selected = [row for row, rank in zip(rows, ranks, strict=True) if rank == best]
        paths = {row.path for row in selected}
        if len(paths) == 1 and _names_another_file(selected[0].path, best[1], folder, image):
            return
        self._used_rows.update((table, row.number) for row in selected)
        has_pages = len(paths) == 1 and (page_count is None or len(selected) <= page_count)
        # Names without folders, which repeat, may be those of images in several folders or of pages.
        may_be_namesakes = len(selected[0].path) == 1 and relative_path != selected[0].path
        if len(selected) == 1:
            yield from selected[0].entries
        elif has_pages and not (may_be_namesakes and self._count_names(folder)[image.name] > 1):
            for page, row in enumerate(selected):
                yield from (replace(entry, page=page) for entry in row.entries)
        else:
            for row in selected:
                yield from (replace(entry, text=f"{row.name}: {entry.text}") for entry in row.entries)


def _read_folder(folder: Path) -> tuple[list[Path], dict[str, list[tuple[Path, list[TableRow]]]]]:
    """Return the tables of a folder, and by file name in lower case the tables and their rows with that name."""
    tables: list[Path] = []
    rows_of_image: dict[str, list[tuple[Path, list[TableRow]]]] = {}
    for path in sorted(folder.iterdir()):
        if (path.suffix.lower() == ".txt" or _may_be_table(path)) and path.is_file():
            rows_by_name = _read_table(path)
            tables += [path] if rows_by_name else []
            for name, rows in rows_by_name.items():
                rows_of_image.setdefault(name.casefold(), []).append((path, rows))
    return tables, rows_of_image


def _count_images(folder: Path) -> Counter[str]:
    """Return the number of images in a folder by their name, and by their name without suffix, in lower case."""
    images = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
    return Counter(name.casefold() for path in images for name in (path.name, path.stem))


def _fold_case(path: Sequence[str]) -> tuple[str, ...]:
    """Return the parts of a path in lower case."""
    return tuple(part.casefold() for part in path)


def _count_common_parts(path: Sequence[str], other: Sequence[str]) -> int:
    """Return the number of parts at the end of two paths that are equal."""
    pairs = zip(reversed(path), reversed(other), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _names_another_file(path: Sequence[str], common_parts: int, folder: Path, image: Path) -> bool:
    """Return whether the path in a row leads to another file than an image, from the folder of the table.

    Folders at the start of the path are dropped one by one, as those of another computer do not exist here.
    `common_parts` is the number of parts that the path has in common with the path of the image.
    """
    for count in range(len(path), common_parts, -1):
        candidate = folder.joinpath(*path[-count:])
        # A row may hold a name that the operating system refuses, such as a very long one.
        with suppress(OSError, ValueError):
            if candidate.is_file() and not candidate.samefile(image):
                return True
    return False


def _read_table(path: Path) -> RowsByName:
    """Return the rows of a table or EMVA 1288 list by file name of the image; empty for any other file."""
    try:
        text = read_text(path) if path.stat().st_size <= key_values.LONGEST_TEXT else ""
    except InputError:
        return {}
    if _may_be_table(path):
        return parse_table(text, path.name)
    return parse_emva_list(text, path.name) if all(line.search(text) for line in _EMVA_LINES) else {}


def _may_be_table(path: Path) -> bool:
    """Return whether a file may be a table of images by its name; the manifest is an output, not a source."""
    return path.suffix.lower() in TABLE_SUFFIXES and path.name != "manifest.csv"


def _add_row(rows_by_name: RowsByName, image: str, entries: Sequence[MetadataEntry], number: int) -> None:
    """Add the row of an image; `image` is its path, with folders that are separated by either kind of slash."""
    path = PureWindowsPath(image).parts
    if path:
        rows_by_name.setdefault(path[-1], []).append(TableRow(path, tuple(entries), number))


def parse_table(text: str, source: str) -> RowsByName:
    """Return the rows of a table with one row per image, or per page of a stack.

    Parameters
    ----------
    text : content of the table; lines that start with # are comments.
    source : name of the file, the source of the entries.

    Returns
    -------
    dict
        Rows by file name of the image; empty if no column names images, or the text is not a table.
    """
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        return {}
    try:
        # The separator is the candidate that is most frequent in the header.
        cell_separator = max(SEPARATORS, key=lines[0].count)
        reader = csv.DictReader(lines[: MOST_ROWS + 1], delimiter=cell_separator)
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
        cells = units.resolve_separators([row[heading] for row in rows], cell_separator)
        for row, cell in zip(rows, cells, strict=True):
            row[heading] = cell
    rows_by_name: RowsByName = {}
    for number, row in enumerate(rows):
        image = row.pop(name_heading).strip()
        pairs = [(heading.strip(), cell.strip()) for heading, cell in row.items() if cell.strip()]
        _add_row(rows_by_name, image, list(key_values.parse_pairs(pairs, source)), number)
    return rows_by_name


def parse_emva_list(text: str, source: str) -> RowsByName:
    """Return the images of the list of an EMVA 1288 reference data set, by file name.

    Lines that are not understood are skipped. `source` is the name of the file.
    """
    rows_by_name: RowsByName = {}
    # Entries of all images of the camera, and of those of the current light level.
    camera_entries: tuple[MetadataEntry, ...] = ()
    level_entries: tuple[MetadataEntry, ...] = ()
    for number, line in enumerate(text.splitlines()):
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
                _add_row(rows_by_name, " ".join(words), (*level_entries, *camera_entries), number)
    return rows_by_name
