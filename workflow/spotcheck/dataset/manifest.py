"""manifest.csv: one row a frame, and one sentence for each thing that can be wrong with one."""

import csv
import math
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath
from typing import Any
from unicodedata import normalize

from spotcheck.dataset.conditions import EXPOSURE_PART, grouped
from spotcheck.errors import InputError
from spotcheck.io.formats.names import IMAGE_SUFFIXES, split_inner_path
from spotcheck.io.text import read_text

KINDS = ("spot", "dark", "flat")
REQUIRED_COLUMNS = ("file", "kind", "angle_deg", "exposure_s", "repeat")
# The column that gives the light of a flat.
PHOTONS = "photons_per_px"
# The column that says whether a frame is used whatever its siblings look like; blank: they decide.
KEEP = "keep"
KEEPS = {"yes": True, "no": False, "": None}
# The column that says when a frame was taken (ISO 8601); only the comparison of datasets asks for it.
DATE = "date"
ALIKE_TWICE = (
    f"every frame must be named once, with a repeat of its own (exposures within {100 * EXPOSURE_PART:g} % are one)"
)
# Longest path of a file [characters]; what is longer is no name, and systems refuse to look for it.
LONGEST_NAME = 250
# Characters of a wrong cell that a message shows.
LONGEST_CELL = 40
# The line by which Excel is told the separator.
SEPARATOR = re.compile('"?sep=,"?,*')


@dataclass(frozen=True)
class Frame:
    """One row of the manifest. `line` counts lines of the file from 1, the header being line 1. Behind the path of an
    HDF5 file, `file` may name what is inside it: `scan.h5#/entry/data`."""

    line: int
    file: str
    page: int
    kind: str
    angle_deg: float | None
    exposure_s: float | None
    repeat: int | None
    extra: dict[str, str]

    @property
    def path(self) -> str:
        """The file alone, without what is named inside it."""
        return split_inner_path(self.file)[0]

    @property
    def label(self) -> str:
        """How messages name the frame."""
        return f"{self.file}, page {self.page}" if self.page else self.file

    @property
    def keep(self) -> bool | None:
        """Whether the frame is used whatever its siblings look like, or not at all; None: they decide."""
        return KEEPS[self.extra.get(KEEP, "").lower()]


def read_manifest(path: Path, conditions: tuple[str, ...] = ()) -> tuple[Frame, ...]:
    """Rows of manifest.csv in their order, checked among themselves and against the files of the folder. Exposures,
    angles and declared conditions that are equal within their tolerances are made equal (see `conditions`)."""
    if not path.is_file():
        raise InputError(f"{path.name}: not there; a dataset needs it ({', '.join(REQUIRED_COLUMNS)})")
    columns, rows = _rows(path, conditions)
    for column in REQUIRED_COLUMNS:
        if column not in columns:
            cause = "; separate cells by commas" if len(columns) == 1 and re.search("[;\t]", columns[0]) else ""
            raise InputError(
                f"{path.name}: column {column} is missing; the header must name {','.join(REQUIRED_COLUMNS)}{cause}"
            )
    for column in columns:
        # A spreadsheet leaves empty columns at the end: they are dropped.
        if column and columns.count(column) > 1:
            raise InputError(f"{path.name}: column {column[:LONGEST_CELL]} stands twice; keep one of them")
    for condition in conditions:
        if condition not in columns:
            raise InputError(
                f"instrument.yaml: key conditions names {condition}, which is no column of {path.name};"
                f" add the column or drop the name"
            )
    if not rows:
        raise InputError(f"{path.name}: no rows; it must name at least one frame")
    frames = _as_on_disk(path.parent, tuple(_frame(path, line, row, conditions) for line, row in rows))
    frames = _with_common(frames, conditions)
    _check_rows(path, frames, conditions)
    return frames


def _rows(path: Path, conditions: tuple[str, ...]) -> tuple[list[str], list[tuple[int, dict[str | None, Any]]]]:
    """Columns as this program calls them, and every row with the number of its line. Raises `InputError`."""
    lines = [
        (number, line)
        for number, line in enumerate(re.split(r"\r\n|\r|\n", read_text(path)), start=1)
        if line.strip(" ,") and not (_is_comment(line, path.parent) or (number == 1 and SEPARATOR.fullmatch(line)))
    ]
    known = {name.lower(): name for name in (*REQUIRED_COLUMNS, "page", PHOTONS, DATE, KEEP, *conditions)}
    try:
        reader = csv.DictReader([line for _, line in lines], skipinitialspace=True)
        columns = [known.get(name.strip().lower(), name.strip()) for name in reader.fieldnames or ()]
        reader.fieldnames = columns
        return columns, [(lines[reader.line_num - 1][0], row) for row in reader]
    except csv.Error as error:
        raise InputError(f"{path.name}: cannot be read as CSV ({error}); look for an unclosed quote") from None


def _is_comment(line: str, folder: Path) -> bool:
    """Whether a line starts with #, as comments of `new-dataset` do, but not with the name of a file such as #1.tif."""
    if not line.startswith("#"):
        return False
    name = line.split(",")[0].strip()
    is_image = len(name) <= LONGEST_NAME and Path(name).suffix.lower() in IMAGE_SUFFIXES and (folder / name).is_file()
    return not is_image


def _as_on_disk(folder: Path, frames: tuple[Frame, ...]) -> tuple[Frame, ...]:
    """The frames with their files named as the disk does: ä is one letter to some systems and two to others (Unicode's
    normal forms C and D)."""
    if all(frame.path.isascii() or (folder / frame.path).exists() for frame in frames):
        return frames
    there = [own.relative_to(folder).as_posix() for own in folder.rglob("*")]
    spelt = {normalize("NFC", own): own for own in there}
    return tuple(
        frame
        if (folder / frame.path).exists()
        else replace(
            frame, file=spelt.get(normalize("NFC", frame.path), frame.path) + frame.file.removeprefix(frame.path)
        )
        for frame in frames
    )


def _frame(path: Path, line: int, row: dict[str | None, Any], conditions: tuple[str, ...]) -> Frame:
    where = f"{path.name} line {line}"
    if None in row or None in row.values():
        raise InputError(f"{where}: {'more' if None in row else 'fewer'} cells than the header has columns")
    cell = {name.strip(): value.strip() for name, value in row.items() if name and name.strip()}
    if any(value.strip() for name, value in row.items() if not (name or "").strip()):
        raise InputError(f"{where}: a cell stands under a column without a name; name the column in the header")
    if cell["kind"] not in KINDS:
        raise InputError(f"{where}: kind is {cell['kind'][:LONGEST_CELL]!r}; it must be one of {', '.join(KINDS)}")
    spot = cell["kind"] == "spot"

    def number(column: str) -> float | None:
        if not cell[column]:
            return None
        value = number_in(cell[column])
        if value is None:
            raise InputError(f"{where}: {column} is {cell[column][:LONGEST_CELL]!r}; it must be a number or blank")
        return value

    def count(column: str) -> int | None:
        text = cell.get(column, "")
        if text and not (text.isdecimal() and len(text) < 10):
            raise InputError(f"{where}: {column} is {text[:LONGEST_CELL]!r}; it must be a whole number from 0")
        return int(text) if text else None

    exposure = number("exposure_s")
    if exposure is not None and (exposure < 0 or (spot and exposure == 0)):
        raise InputError(f"{where}: exposure_s is {cell['exposure_s']}; it must be positive, in seconds")
    for condition in conditions:
        if spot and number(condition) is None:
            raise InputError(f"{where}: {condition} is blank; it is declared in conditions and needs a number")
    # Windows parts folders by a back-slash.
    file = cell["file"].replace("\\", "/")
    if len(file) > LONGEST_NAME:
        raise InputError(f"{where}: file has {len(file)} characters; it must be a path of at most {LONGEST_NAME}")
    path_alone, inside = split_inner_path(file)
    absolute = Path(file).is_absolute() or PureWindowsPath(file).is_absolute()
    if not file or "\0" in file or absolute or not _inside(path.parent, path_alone):
        raise InputError(
            f"{where}: file is {file!r}; it must be a path inside the dataset folder, not a link out of it"
        )
    if re.search("[{}]", file):
        raise InputError(f"{where}: file is {file!r}; it must be a name without braces")
    if Path(path_alone).suffix.lower() not in IMAGE_SUFFIXES:
        raise InputError(
            f"{where}: {file} is in no format that is read; save it as TIFF, PNG or PGM ({', '.join(IMAGE_SUFFIXES)})"
        )
    if cell.get(KEEP, "").lower() not in KEEPS:
        raise InputError(f"{where}: {KEEP} is {cell[KEEP][:LONGEST_CELL]!r}; it must be yes, no or blank")
    extra = {name: value for name, value in cell.items() if name not in (*REQUIRED_COLUMNS, "page")}
    return Frame(
        line=line,
        file=Path(os.path.normpath(path_alone)).as_posix() + (f"#{inside}" if inside else ""),
        page=count("page") or 0,
        kind=cell["kind"],
        angle_deg=number("angle_deg"),
        exposure_s=exposure,
        repeat=count("repeat"),
        extra=extra,
    )


def _with_common(frames: tuple[Frame, ...], conditions: tuple[str, ...]) -> tuple[Frame, ...]:
    """Frames of one condition with equal values."""
    angles, exposures = (
        grouped(column, [getattr(frame, column) for frame in frames]).values for column in ("angle_deg", "exposure_s")
    )
    frames = tuple(
        replace(frame, angle_deg=angle, exposure_s=exposure)
        for frame, angle, exposure in zip(frames, angles, exposures, strict=True)
    )
    for name in conditions:
        values = [number_in(frame.extra[name]) for frame in frames]
        own = [
            frame.extra if value == before else frame.extra | {name: repr(value)}
            for frame, before, value in zip(frames, values, grouped(name, values).values, strict=True)
        ]
        frames = tuple(replace(frame, extra=extra) for frame, extra in zip(frames, own, strict=True))
    return frames


def _inside(folder: Path, file: str) -> bool:
    try:
        return (folder / file).resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # a link that leads to itself
        return False


def _check_rows(path: Path, frames: tuple[Frame, ...], conditions: tuple[str, ...]) -> None:
    by_page: dict[tuple, Frame] = {}
    by_cell: dict[tuple, Frame] = {}
    for frame in frames:
        at = tuple(number_in(frame.extra[name]) for name in conditions)
        cell = (frame.kind, frame.angle_deg, frame.exposure_s, frame.repeat, at)
        for seen, key, what, right in (
            (by_page, (frame.file, frame.page), "file and page", "every frame must be named once"),
            (by_cell, cell, "kind, angle, exposure, repeat and conditions", ALIKE_TWICE),
        ):
            if key in seen:
                raise InputError(f"{path.name} lines {seen[key].line} and {frame.line} agree in {what}; {right}")
            seen[key] = frame
    spots = [frame for frame in frames if frame.kind == "spot"]
    for column in ("angle_deg", "exposure_s", "repeat"):
        blank = [frame for frame in spots if getattr(frame, column) is None]
        if blank and len(blank) < len(spots):
            raise InputError(
                f"{path.name} line {blank[0].line}: {column} is blank here and given in other spot rows;"
                f" give it in all of them or in none"
            )


def number_in(text: str) -> float | None:
    """The finite number that a cell holds, or None."""
    try:
        value = float(text)
    except ValueError:
        return None
    # Python's own 1_0 for 10 is nobody's number.
    return value if "_" not in text and math.isfinite(value) else None
