"""Completion of the manifest.csv and instrument.yaml of a dataset with what its images, or the user, state.

Only blank cells, missing columns and missing keys are filled. What was written before stays as it is.
"""

import codecs
import csv
import io
import posixpath
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from spotcheck.dataset import template
from spotcheck.dataset.instrument import read_instrument
from spotcheck.dataset.manifest import list_lines, parse_number, read_rows
from spotcheck.dataset.metadata.entry import ROUNDING_TOLERANCE
from spotcheck.dataset.scan.draft import CONDITION_COLUMNS, METADATA_COLUMNS, POSITION, ManifestDraft
from spotcheck.errors import InputError
from spotcheck.io import store
from spotcheck.io.formats.names import split_inner_path
from spotcheck.io.number_text import count_text
from spotcheck.io.schema import parse_keys, read_schema
from spotcheck.io.text import join_first, read_text

MANIFEST, INSTRUMENT = "manifest.csv", "instrument.yaml"
# Columns in which blanks are never filled: they say which frame a row is, and a blank repeat means that repeats are not
# known.
KEPT_COLUMNS = ("file", "page", "repeat")
# Most names that a message lists.
MOST_LISTED = 5


@dataclass(frozen=True)
class Completion:
    """The new text of a file and what has changed in it."""

    text: str  # content of the file
    changes: tuple[str, ...]  # one sentence for each change
    remarks: tuple[str, ...] = ()  # one sentence for each value or frame that was found and is not written
    columns: tuple[str, ...] = ()  # columns of the manifest in which cells are filled


class FileChanges(NamedTuple):
    """What was done to the two files of a dataset."""

    written: list[str]  # names of the files that are new
    changes: list[str]  # one sentence for each change in a file that was there
    remarks: list[str]  # one sentence for each value or frame that was found and is not written


def list_written_names(folder: Path) -> set[str]:
    """Return the columns of the manifest and the keys of the instrument file of a folder that have a value.

    Files that do not exist have none. Raises `InputError` for a file that cannot be read.
    """
    names = set(read_instrument(folder / INSTRUMENT).given_keys)
    if not _is_unwritten(folder / MANIFEST, template.format_manifest(None)):
        _, rows = read_rows(folder / MANIFEST)
        names |= {column for _, row in rows for column, value in row.items() if column and (value or "").strip()}
    return names


def write_or_complete(folder: Path, draft: ManifestDraft, crop_px: int | None, answers: Collection[str]) -> FileChanges:
    """Write manifest.csv and instrument.yaml of a folder of images, or complete them if they exist.

    A template that nobody has filled in counts as missing.

    Parameters
    ----------
    folder : folder of the dataset.
    draft : rows and keys that were found in the images.
    crop_px : side of the crops [px]; None for the default.
    answers : columns and keys for which the user gave a value.

    Raises
    ------
    InputError
        If an existing file cannot be read; then neither is written.
    """
    manifest_path, instrument_path = folder / MANIFEST, folder / INSTRUMENT
    keys = template.collect_known_keys(draft, crop_px)
    written = []
    if is_new := _is_unwritten(manifest_path, template.format_manifest(None)):
        written.append(MANIFEST)
        manifest = Completion(template.format_manifest(draft), (), (), draft.columns)
    else:
        manifest = complete_manifest(manifest_path, draft, answers)
    if _is_unwritten(instrument_path, template.format_instrument(None, None)):
        written.append(INSTRUMENT)
        instrument = Completion(template.format_instrument(draft, crop_px), ())
    else:
        # The order of the rows, conditions and crops may have been decided by hand if the rows were.
        free_keys = {"conditions"} if POSITION in manifest.columns else set()
        wanted = {key: keys[key] for key in keys if is_new or key in draft.instrument_keys or key in free_keys}
        instrument = complete_instrument(instrument_path, wanted, answers)
        if "exposure_s" in manifest.columns and template.FREE_BUDGET not in keys:
            instrument = _take_back_budget(instrument)
    for path, completion in ((manifest_path, manifest), (instrument_path, instrument)):
        if completion.changes or path.name in written:
            store.write_text(path, completion.text)
    return FileChanges(written, [*manifest.changes, *instrument.changes], [*manifest.remarks, *instrument.remarks])


def _is_unwritten(path: Path, template_text: str) -> bool:
    """Return whether a file does not exist or is the template as the program wrote it."""
    return not path.exists() or path.read_bytes() == template_text.encode()


def complete_manifest(path: Path, draft: ManifestDraft, answers: Collection[str]) -> Completion:
    """Return the text of a manifest with its blank cells and missing columns filled.

    Parameters
    ----------
    path : path of manifest.csv.
    draft : rows that were found in the images.
    answers : columns for which the user gave a value.

    Returns
    -------
    Completion
        Its remarks name answers that differ from what is written, and images without a row.

    Raises
    ------
    InputError
        If the file is no manifest, or its rows cannot be matched to the lines of the file.
    """
    columns, rows = read_rows(path)
    drafted = {(frame.file, str(frame.page)): row for frame, row in zip(draft.frames, draft.rows, strict=True)}
    completed_columns = [column for column in draft.columns if column not in KEPT_COLUMNS]
    # New cells of each line by column, and the rows as they are and as they were found, by line.
    cells_of_line: dict[int, dict[str, str]] = {}
    written_rows: dict[int, dict[str, str]] = {}
    found_rows: dict[int, dict[str, str]] = {}
    filled = Counter[str]()
    missing = dict(drafted)
    for line, row in rows:
        cells = {column: (value or "").strip() for column, value in row.items() if column}
        key = _normalize_file(cells.get("file", "")), cells.get("page") or "0"
        found = drafted.get(key, {})
        missing.pop(key, None)
        written_rows[line], found_rows[line] = cells, found
        new_cells = {name: found[name] for name in completed_columns if found.get(name) and not cells.get(name)}
        # Darks and flats have no angle, whatever the images of other kinds state.
        if cells.get("kind") not in ("", "spot"):
            new_cells.pop("angle_deg", None)
        filled.update(new_cells.keys())
        cells_of_line[line] = new_cells
    is_template = read_text(path).startswith(template.format_comments("manifest"))
    repeats = _renew_repeats(written_rows, cells_of_line, found_rows) if is_template else {}
    for line, repeat in repeats.items():
        cells_of_line[line]["repeat"] = written_rows[line]["repeat"] = repeat
    filled_columns = [column for column in draft.columns if filled[column]]
    new_columns = [column for column in filled_columns if column not in columns]
    text = _edit_lines(path, columns, new_columns, cells_of_line)
    row_count = count_text(len(rows), "row")
    changes = [f"manifest.csv: {column} is filled in {filled[column]} of {row_count}" for column in filled_columns]
    if repeats:
        changes.append(
            f"manifest.csv: repeat is numbered anew in {count_text(len(repeats), 'row')}, since it was counted without"
            " these values"
        )
    remarks = list(_list_differences(written_rows, found_rows, answers))
    if missing:
        remarks.append(_name_missing(missing))
    return Completion(text, tuple(changes), tuple(remarks), tuple(filled_columns))


def _name_missing(frames: Collection[tuple[str, str]]) -> str:
    """Return the remark on frames (file, page) without a row."""
    names = list(dict.fromkeys(file for file, _ in frames))
    listed = join_first(names, MOST_LISTED)
    return f"manifest.csv: no row for {count_text(len(frames), 'frame')} ({listed}); add rows for those to be used"


def _renew_repeats(
    written_rows: Mapping[int, Mapping[str, str]],
    new_cells: Mapping[int, Mapping[str, str]],
    found_rows: Mapping[int, Mapping[str, str]],
) -> dict[int, str]:
    """Return the repeats that change since new cells split conditions, by line; {} if a person may have chosen them.

    Repeats that number the rows of each condition in their order are those that the program counted. The new ones are
    those of the images, or counts if these are missing or not unique.

    Parameters
    ----------
    written_rows : cells of each row by column, by line.
    new_cells : cells that are filled now, by line and column.
    found_rows : cells of each row as the images give them, by line; empty for other rows.
    """
    before = [tuple(row.get(column, "") for column in CONDITION_COLUMNS) for row in written_rows.values()]
    after = [
        tuple(new_cells[line].get(column, row.get(column, "")) for column in CONDITION_COLUMNS)
        for line, row in written_rows.items()
    ]
    repeats = [row.get("repeat", "") for row in written_rows.values()]
    # New cells that are equal in all rows of a condition leave its repeats as they are.
    if repeats != _count_repeats(before) or len(set(after)) == len(set(before)):
        return {}
    new_repeats = [found_rows[line].get("repeat", "") for line in written_rows]
    if "" in new_repeats or len(set(zip(after, new_repeats, strict=True))) < len(after):
        new_repeats = _count_repeats(after)
    pairs = zip(written_rows, repeats, new_repeats, strict=True)
    return {line: new_repeat for line, repeat, new_repeat in pairs if new_repeat != repeat}


def _count_repeats(conditions: Sequence[tuple[str, ...]]) -> list[str]:
    """Return the number of each row within its condition, from 0, as text."""
    counts = Counter[tuple[str, ...]]()
    repeats = []
    for condition in conditions:
        repeats.append(str(counts[condition]))
        counts[condition] += 1
    return repeats


def _list_differences(
    written_rows: Mapping[int, Mapping[str, str]], found_rows: Mapping[int, Mapping[str, str]], answers: Collection[str]
) -> Iterator[str]:
    """Yield a remark for each column with cells that differ from an answer, or from what was found.

    `written_rows` and `found_rows` are those of `_renew_repeats`, and `answers` the columns that the user gave.
    """
    for column in METADATA_COLUMNS:
        differing = 0
        for line, row in written_rows.items():
            found = found_rows[line].get(column, "")
            # A kind of spot may only be assumed.
            is_stated = column in answers or (column, found) != ("kind", "spot")
            differing += is_stated and _differs(row.get(column, ""), found)
        rows = count_text(differing, "row")
        difference = (
            f"has another value in {rows}, which stays"
            if column in answers
            else f"differs from the table above in {rows}, and stays"
        )
        if differing:
            yield f"manifest.csv: {column} {difference}; change it there if it is wrong"


def _normalize_file(text: str) -> str:
    """Return the path of a frame as a scan names it, with single slashes."""
    path, inner_path = split_inner_path(text.replace("\\", "/"))
    return posixpath.normpath(path) + (f"#{inner_path}" if inner_path else "")


def _differs(written: str, found: str) -> bool:
    """Return whether a cell that is not blank differs from what was found, numbers by more than their rounding."""
    if not written or not found:
        return False
    numbers = parse_number(written), parse_number(found)
    if numbers[0] is None or numbers[1] is None:
        return written != found
    return abs(numbers[0] - numbers[1]) > ROUNDING_TOLERANCE * abs(numbers[1])


def _edit_lines(
    path: Path, columns: Sequence[str], new_columns: Sequence[str], cells_of_line: Mapping[int, Mapping[str, str]]
) -> str:
    """Return the text of a manifest with new cells, and with new columns at the end of its lines.

    `cells_of_line` has the new cells by the number of the line and by column. Raises `InputError` if a row does not
    have one line.
    """
    # Lines and line ends alternate.
    parts = re.split(r"(\r\n|\r|\n)", read_text(path))
    lines = list_lines(path)
    header_number = lines[0][0]
    for number, line in lines:
        new_cells = cells_of_line.get(number, {})
        appended = new_columns if number == header_number else [new_cells.get(column, "") for column in new_columns]
        cells = _split_cells(line)
        if len(cells) != len(columns) or (number != header_number and number not in cells_of_line):
            raise InputError(f"{path.name} line {number}: a row goes over several lines; write each row in one line")
        if new_cells.keys() - set(new_columns):
            line = ",".join(new_cells.get(column, cell) for column, cell in zip(columns, cells, strict=True))
        parts[2 * (number - 1)] = ",".join([line, *appended])
    # The byte order mark, by which some programs recognize UTF-8, is no part of the first line.
    mark = "\ufeff" if path.read_bytes().startswith(codecs.BOM_UTF8) else ""
    return mark + "".join(parts)


def _split_cells(line: str) -> list[str]:
    """Return the cells of a line of CSV, in quotes where they need them, so that commas can join them again."""
    if '"' not in line:
        return line.split(",")
    cells = []
    for cell in next(csv.reader([line], skipinitialspace=True)):
        written = io.StringIO()
        csv.writer(written, lineterminator="").writerow([cell])
        # The writer quotes a row of one blank cell.
        cells.append(written.getvalue() if cell else "")
    return cells


def complete_instrument(path: Path, keys: template.KnownKeys, answers: Collection[str]) -> Completion:
    """Return the text of an instrument file with the keys that it lacks.

    Parameters
    ----------
    path : path of instrument.yaml.
    keys : value and source of each key that is known.
    answers : keys for which the user gave a value.

    Returns
    -------
    Completion
        Its remarks name answers that differ from what is written, and keys for which the file has no place.

    Raises
    ------
    InputError
        If the file is not a valid instrument file.
    """
    # Also those of the file on which it is based.
    given_keys = read_instrument(path).given_keys
    text = read_text(path)
    changes, remarks = [], []
    for key, (value, source) in keys.items():
        if key in given_keys:
            # With the same text twice, this compares the written value with the answer.
            if key in answers and not _sets_only(key, value, text, text):
                remarks.append(f"instrument.yaml: {key} has another value, which stays; change it there if it is wrong")
            continue
        new_text = _insert_key(text, key, value, source)
        if _sets_only(key, value, text, new_text):
            text = new_text
            changes.append(f"instrument.yaml: {key} is {value} ({source})")
        else:
            remarks.append(f"instrument.yaml: {key} has no place there; add it with the value {value}")
    return Completion(text, tuple(changes), tuple(remarks))


def _take_back_budget(completion: Completion) -> Completion:
    """Return an instrument file without the photon budget that was written because exposure times were missing.

    A line that differs from the one that the program writes stays as it is.
    """
    section, name = template.FREE_BUDGET.split(".")
    key_schema = read_schema("instrument")["properties"][section]["properties"][name]
    line = template.format_key(template.FREE_BUDGET, key_schema, {template.FREE_BUDGET: template.FREE_BUDGET_VALUE})
    comment = template.format_key(template.FREE_BUDGET, key_schema, {})
    text = re.sub(rf"(?m)^{re.escape(line)}(?=\r?$)", lambda _: comment, completion.text)
    if text == completion.text:
        return completion
    change = f"instrument.yaml: {template.FREE_BUDGET} is a comment again, since exposure times are known"
    return replace(completion, text=text, changes=(*completion.changes, change))


def _insert_key(text: str, key: str, value: object, source: str) -> str:
    """Return the text of an instrument file with a new line for a key, in place of its comment if there is one.

    Parameters
    ----------
    text : content of the file.
    key : "section.name", or the name of a key of the top level.
    value : value of the key.
    source : where the value was found, which becomes a comment behind it.
    """
    section, _, name = key.rpartition(".")
    line_end = "\r\n" if "\r\n" in text else "\n"
    lines = text.splitlines()
    start, end, indent = 0, len(lines), ""
    if section:
        # The line that opens the section, perhaps as a comment, and the one that opens the next section.
        header = next((i for i, line in enumerate(lines) if re.match(rf"(?:# ?)?{section}:\s*(?:#.*)?$", line)), None)
        if header is None:
            lines.append(f"{section}:")
            header = len(lines) - 1
        lines[header] = re.sub(r"^# ?", "", lines[header])
        start = header + 1
        end = next((i for i in range(start, len(lines)) if re.match(r"(?:# ?)?\w+:", lines[i])), len(lines))
        indents = (match[0] for line in lines[start:end] if (match := re.match(r" +(?=\w)", line)))
        indent = next(indents, "  ")
    new_line = template.format_key(name, {}, {name: (value, source)})
    pattern = rf"# +{name}:" if section else rf"# ?{name}:"
    place = next((i for i in range(start, end) if re.match(pattern, lines[i])), None)
    if place is None:
        place = start if section else end
        lines.insert(place, "")
    lines[place] = indent + new_line
    return line_end.join(lines) + line_end


def _sets_only(key: str, value: object, text: str, new_text: str) -> bool:
    """Return whether a new text of an instrument file has the keys of the old one, and one key with this value.

    Parameters
    ----------
    key : "section.name", or the name of a key of the top level.
    value : value that the key must have in the new text; the old one may lack the key or have another value.
    text : content of the old file, which is valid.
    new_text : content of the new file; if it is not valid, the result is False.
    """
    content = parse_keys(text, "instrument.yaml")
    section, _, name = key.rpartition(".")
    new_key = parse_keys(f"{name}: {value}", "instrument.yaml")
    expected = content | ({section: (content.get(section) or {}) | new_key} if section else new_key)
    try:
        return parse_keys(new_text, "instrument.yaml") == expected
    except InputError:
        return False
