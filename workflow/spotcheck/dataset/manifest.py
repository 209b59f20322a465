"""manifest.csv: one row per frame, with one message for each possible mistake.

A condition is a column that instrument.yaml declares as an axis of the experiment. Siblings are frames of one condition
or neighbours in a series, which are compared with each other to find outliers.
"""

import csv
import math
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath
from typing import Any
from unicodedata import normalize

from spotcheck.dataset.conditions import EXPOSURE_TOLERANCE, merge_values
from spotcheck.errors import InputError
from spotcheck.io.formats.names import IMAGE_SUFFIXES, split_inner_path
from spotcheck.io.text import read_text

KINDS = ("spot", "dark", "flat")
REQUIRED_COLUMNS = ("file", "kind", "angle_deg", "exposure_s", "repeat")
# Column with the light on a flat [photons per pixel].
PHOTONS = "photons_per_px"
# Column that decides whether a frame is used, and its values; if it is blank, the comparison with siblings decides.
KEEP = "keep"
KEEP_VALUES = {"yes": True, "no": False, "": None}
# Column with the time of acquisition (ISO 8601), which only the comparison of datasets needs.
DATE = "date"
# Longest path of a file [characters]: operating systems refuse longer ones, some by an error even when asked whether
# the file exists.
LONGEST_PATH = 250
# Most characters of a wrong cell that a message shows, and most digits of a whole number.
LONGEST_CELL, MOST_DIGITS = 40, 9
# Line that tells Excel the separator.
SEPARATOR_LINE = re.compile('"?sep=,"?,*')


@dataclass(frozen=True)
class Frame:
    """One row of the manifest."""

    line: int  # line of the file, from 1; the header is line 1
    file: str  # path relative to the dataset folder, perhaps with a path inside an HDF5 file: `scan.h5#/entry/data`
    page: int  # page of a stack, from 0
    kind: str  # one of `KINDS`
    angle_deg: float | None  # orientation of the sample [deg]; None if blank
    exposure_s: float | None  # exposure time [s]; None if blank
    repeat: int | None  # number of the site or repetition within a condition; None if blank
    extra: dict[str, str]  # cells of all other columns, by column; "" if blank

    @property
    def path(self) -> str:
        """Path of the file relative to the dataset folder, without a path inside it."""
        return split_inner_path(self.file)[0]

    @property
    def label(self) -> str:
        """Name of the frame in messages: its file, with the page unless that is 0."""
        return f"{self.file}, page {self.page}" if self.page else self.file

    def get_coordinates(self, conditions: tuple[str, ...]) -> tuple[float | None, ...]:
        """Return angle [deg], exposure time [s], repeat and the numbers in the columns of the declared conditions.

        None stands for a blank cell.
        """
        numbers = (parse_number(self.extra[column]) for column in conditions)
        return self.angle_deg, self.exposure_s, self.repeat, *numbers

    @property
    def keep(self) -> bool | None:
        """True if the user keeps the frame, False if the user excludes it, None to compare it with its siblings."""
        return KEEP_VALUES[self.extra.get(KEEP, "").lower()]


def read_manifest(path: Path, conditions: tuple[str, ...] = ()) -> tuple[Frame, ...]:
    """Read and check manifest.csv.

    Exposure times, angles and conditions that are equal within their tolerances are replaced by their mean (see the
    module `conditions`).

    Parameters
    ----------
    path : path of manifest.csv.
    conditions : columns of the declared conditions.

    Returns
    -------
    tuple of Frame
        The rows in their order.

    Raises
    ------
    InputError
        For the first mistake, with its line.
    """
    if not path.is_file():
        raise InputError(f"{path.name}: not there; a dataset needs it ({', '.join(REQUIRED_COLUMNS)})")
    _, rows = read_rows(path, conditions)
    if not rows:
        raise InputError(f"{path.name}: no rows; it must name at least one frame")
    frames = tuple(_parse_row(path, line, row, conditions) for line, row in rows)
    frames = _merge_conditions(_spell_as_on_disk(path.parent, frames), conditions)
    _check_duplicates(path, frames, conditions)
    _check_blanks(path, frames)
    return frames


def list_lines(path: Path) -> list[tuple[int, str]]:
    """Return number and text of each line of a manifest that is neither blank nor a comment."""
    return [
        (number, line)
        for number, line in enumerate(re.split(r"\r\n|\r|\n", read_text(path)), start=1)
        if line.strip(" ,") and not (_is_comment(line, path.parent) or (number == 1 and SEPARATOR_LINE.fullmatch(line)))
    ]


def read_rows(
    path: Path, conditions: tuple[str, ...] = ()
) -> tuple[list[str], list[tuple[int, dict[str | None, Any]]]]:
    """Return the names of the columns, and for each row the number of its last line and its cells by column.

    Known columns are spelt as in this module and in `conditions`, whatever their case. As in `csv.DictReader`, surplus
    cells have the key None, and missing cells the value None. Cells are not checked. Raises `InputError` for columns
    that are missing or stand twice.
    """
    lines = list_lines(path)
    spelling_of = {name.lower(): name for name in (*REQUIRED_COLUMNS, "page", PHOTONS, DATE, KEEP, *conditions)}
    try:
        reader = csv.DictReader([line for _, line in lines], skipinitialspace=True)
        columns = [spelling_of.get(name.strip().lower(), name.strip()) for name in reader.fieldnames or ()]
        reader.fieldnames = columns
        rows = [(lines[reader.line_num - 1][0], row) for row in reader]
    except csv.Error as error:
        raise InputError(f"{path.name}: cannot be read as CSV ({error}); look for an unclosed quote") from None
    _check_columns(path, columns, conditions)
    return columns, rows


def _is_comment(line: str, folder: Path) -> bool:
    """Return whether a line starts with #, but not with the name of an image in the folder such as #1.tif."""
    name = line.split(",")[0].strip()
    may_be_image = len(name) <= LONGEST_PATH and Path(name).suffix.lower() in IMAGE_SUFFIXES
    return line.startswith("#") and not (may_be_image and (folder / name).is_file())


def _check_columns(path: Path, columns: list[str], conditions: tuple[str, ...]) -> None:
    """Raise `InputError` for a required column or condition that is missing, and for a repeated column."""
    for column in REQUIRED_COLUMNS:
        if column not in columns:
            cause = "; separate cells by commas" if len(columns) == 1 and re.search("[;\t]", columns[0]) else ""
            raise InputError(
                f"{path.name}: column {column} is missing; the header must name {','.join(REQUIRED_COLUMNS)}{cause}"
            )
    for column in columns:
        # Spreadsheets leave empty columns at the end, which are dropped.
        if column and columns.count(column) > 1:
            raise InputError(f"{path.name}: column {column[:LONGEST_CELL]} stands twice; keep one of them")
    for condition in conditions:
        if condition not in columns:
            raise InputError(
                f"instrument.yaml: key conditions names {condition}, which is no column of {path.name};"
                f" add the column or drop the name"
            )


def _spell_as_on_disk(folder: Path, frames: tuple[Frame, ...]) -> tuple[Frame, ...]:
    """Return the frames with paths in the Unicode normal form of the disk: ä may be one character or two.

    A path that is not on the disk stays as it is.
    """
    if all(frame.path.isascii() or (folder / frame.path).exists() for frame in frames):
        return frames
    paths = [path.relative_to(folder).as_posix() for path in folder.rglob("*")]
    # A path that is spelt exactly so takes precedence over one in the other normal form.
    spelling = {normalize("NFC", path): path for path in paths} | {path: path for path in paths}
    disk_paths = [spelling.get(frame.path, spelling.get(normalize("NFC", frame.path), frame.path)) for frame in frames]
    return tuple(
        replace(frame, file=path + frame.file.removeprefix(frame.path))
        for frame, path in zip(frames, disk_paths, strict=True)
    )


def _parse_row(path: Path, line: int, row: dict[str | None, Any], conditions: tuple[str, ...]) -> Frame:
    """Return the frame of a row. Raises `InputError` for a wrong cell.

    Parameters
    ----------
    path : path of manifest.csv; frames lie in its folder.
    line : number of the row's line, from 1.
    row : cells by column, as `read_rows` returns them.
    conditions : columns of the declared conditions.
    """
    location = f"{path.name} line {line}"
    if None in row or None in row.values():
        raise InputError(f"{location}: {'more' if None in row else 'fewer'} cells than the header has columns")
    cells = {name.strip(): value.strip() for name, value in row.items() if name and name.strip()}
    if any(value.strip() for name, value in row.items() if not (name or "").strip()):
        raise InputError(f"{location}: a cell stands under a column without a name; name the column in the header")
    if cells["kind"] not in KINDS:
        raise InputError(f"{location}: kind is {cells['kind'][:LONGEST_CELL]!r}; it must be one of {', '.join(KINDS)}")
    is_spot = cells["kind"] == "spot"
    exposure_s = _parse_optional_number(location, cells, "exposure_s")
    if exposure_s is not None and (exposure_s < 0 or (is_spot and exposure_s == 0)):
        raise InputError(f"{location}: exposure_s is {cells['exposure_s']}; it must be positive, in seconds")
    for condition in conditions:
        if is_spot and _parse_optional_number(location, cells, condition) is None:
            raise InputError(f"{location}: {condition} is blank; it is declared in conditions and needs a number")
    file = _parse_file(location, path.parent, cells["file"])
    if cells.get(KEEP, "").lower() not in KEEP_VALUES:
        raise InputError(f"{location}: {KEEP} is {cells[KEEP][:LONGEST_CELL]!r}; it must be yes, no or blank")
    return Frame(
        line=line,
        file=file,
        page=_parse_optional_count(location, cells, "page") or 0,
        kind=cells["kind"],
        angle_deg=_parse_optional_number(location, cells, "angle_deg"),
        exposure_s=exposure_s,
        repeat=_parse_optional_count(location, cells, "repeat"),
        extra={name: value for name, value in cells.items() if name not in (*REQUIRED_COLUMNS, "page")},
    )


def _parse_optional_number(location: str, cells: dict[str, str], column: str) -> float | None:
    """Return the number in a cell of a row (`cells` by column), None if it is blank.

    Raises `InputError` for other text. The message starts with `location`, such as "manifest.csv line 3".
    """
    text = cells[column]
    value = parse_number(text)
    if text and value is None:
        raise InputError(f"{location}: {column} is {text[:LONGEST_CELL]!r}; it must be a number or blank")
    return value


def _parse_optional_count(location: str, cells: dict[str, str], column: str) -> int | None:
    """Return the whole number in a cell of a row (`cells` by column), None if it is blank or the column is missing.

    Raises `InputError` for other text, also for signs and decimals. The message starts with `location`, such as
    "manifest.csv line 3".
    """
    text = cells.get(column, "")
    if text and not (text.isdecimal() and len(text) <= MOST_DIGITS):
        raise InputError(f"{location}: {column} is {text[:LONGEST_CELL]!r}; it must be a whole number from 0")
    return int(text) if text else None


def _parse_file(location: str, folder: Path, text: str) -> str:
    """Return the normalized path of an image, relative to the dataset's folder.

    `text` is the cell. Raises `InputError` for a path that is not allowed. The message starts with `location`, such as
    "manifest.csv line 3".
    """
    file = text.replace("\\", "/")  # Windows separates folders by a backslash
    if len(file) > LONGEST_PATH:
        raise InputError(f"{location}: file has {len(file)} characters; it must be a path of at most {LONGEST_PATH}")
    path, inner_path = split_inner_path(file)
    is_absolute = Path(file).is_absolute() or PureWindowsPath(file).is_absolute()
    if not file or "\0" in file or is_absolute or not _is_inside(folder, path):
        raise InputError(
            f"{location}: file is {file!r}; it must be a path inside the dataset folder, not a link out of it"
        )
    # Snakemake takes braces for wildcards.
    if re.search("[{}]", file):
        raise InputError(f"{location}: file is {file!r}; it must be a name without braces")
    if Path(path).suffix.lower() not in IMAGE_SUFFIXES:
        raise InputError(
            f"{location}: {file} is in no format that is read; save it as TIFF, PNG or PGM"
            f" ({', '.join(IMAGE_SUFFIXES)})"
        )
    return Path(os.path.normpath(path)).as_posix() + (f"#{inner_path}" if inner_path else "")


def _is_inside(folder: Path, file: str) -> bool:
    """Return whether a relative path, with its links followed, stays in a folder."""
    try:
        return (folder / file).resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # a link that leads to itself
        return False


def _merge_conditions(frames: tuple[Frame, ...], conditions: tuple[str, ...]) -> tuple[Frame, ...]:
    """Return the frames with angles, exposure times and conditions that agree within tolerances set to their mean."""
    angles = merge_values("angle_deg", [frame.angle_deg for frame in frames]).values
    exposures = merge_values("exposure_s", [frame.exposure_s for frame in frames]).values
    extras = [dict(frame.extra) for frame in frames]
    for column in conditions:
        values = [parse_number(frame.extra[column]) for frame in frames]
        for extra, value, mean in zip(extras, values, merge_values(column, values).values, strict=True):
            if mean != value:
                extra[column] = repr(mean)
    return tuple(
        replace(frame, angle_deg=angle, exposure_s=exposure, extra=extra)
        for frame, angle, exposure, extra in zip(frames, angles, exposures, extras, strict=True)
    )


def _check_duplicates(path: Path, frames: tuple[Frame, ...], conditions: tuple[str, ...]) -> None:
    """Raise `InputError` for two rows with the same page of a file, or with the same condition and repeat."""
    # Line of the first row with each page, and with each condition and repeat.
    lines: dict[tuple, int] = {}
    for frame in frames:
        for key, columns, advice in (
            ((frame.file, frame.page), "file and page", "every frame must be named once"),
            (
                (frame.kind, *frame.get_coordinates(conditions)),
                "kind, angle, exposure, repeat and conditions",
                "every frame must be named once, with a repeat of its own (exposures within"
                f" {100 * EXPOSURE_TOLERANCE:g} % are one)",
            ),
        ):
            if key in lines:
                raise InputError(f"{path.name} lines {lines[key]} and {frame.line} agree in {columns}; {advice}")
            lines[key] = frame.line


def _check_blanks(path: Path, frames: tuple[Frame, ...]) -> None:
    """Raise `InputError` for a column that is blank in some, but not all spot rows."""
    spots = [frame for frame in frames if frame.kind == "spot"]
    for column in ("angle_deg", "exposure_s", "repeat"):
        blank_frames = [frame for frame in spots if getattr(frame, column) is None]
        if blank_frames and len(blank_frames) < len(spots):
            raise InputError(
                f"{path.name} line {blank_frames[0].line}: {column} is blank here and given in other spot rows;"
                f" give it in all of them or in none"
            )


def parse_number(text: str) -> float | None:
    """Return the finite number in a cell; None for any other text, such as a blank one."""
    try:
        value = float(text)
    except ValueError:
        return None
    # Python reads 1_0 as 10, which no instrument writes.
    return value if "_" not in text and math.isfinite(value) else None
