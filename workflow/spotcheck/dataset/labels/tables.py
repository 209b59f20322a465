"""Tables that have a row for each image of a folder, or each page of a stack, as programs of measurement keep them."""

import csv
from collections.abc import Iterator
from pathlib import Path, PureWindowsPath

from spotcheck.dataset.labels import words
from spotcheck.dataset.labels.label import Label

ENDINGS = (".csv", ".tsv")
# Headings of the column that names the images, without spaces, signs and capitals.
NAMES = ("file", "filename", "filepath", "image", "imagename", "imagefile", "frame", "framename", "path")
# What parts cells, and rows that are looked at.
MARKS, MOST_ROWS = (",", ";", "\t"), 100_000


def labels_in(text: str, where: str) -> dict[str, tuple[Label, ...]]:
    """Labels by an image's name; empty where no column names images, and for what is no table."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        return {}
    mark = max(MARKS, key=lines[0].count)
    try:
        heading, *rows = csv.reader(lines[: MOST_ROWS + 1], delimiter=mark)
    except csv.Error:
        return {}
    keys = [words.plain(name) for name in heading]
    at = next((keys.index(name) for name in NAMES if name in keys), None)
    if at is None:
        return {}
    by_name: dict[str, list[list[tuple[str, str]]]] = {}
    for row in rows:
        if len(row) == len(heading):
            cells = [(key.strip(), cell.strip()) for key, cell in zip(heading, row, strict=True)]
            said = [own for k, own in enumerate(cells) if k != at and own[1]]
            by_name.setdefault(PureWindowsPath(cells[at][1]).name, []).append(said)
    return {name: tuple(_labels(own, where)) for name, own in by_name.items()}


def _labels(rows: list[list[tuple[str, str]]], where: str) -> Iterator[Label]:
    """Labels of the rows of one image: of several each is a page of its stack."""
    for page, said in enumerate(rows):
        yield from words.of_keys(said, where, page if len(rows) > 1 else None)


def may_be(path: Path) -> bool:
    """Whether a file may be such a table; a manifest is what is to be written."""
    return path.suffix.lower() in ENDINGS and path.name != "manifest.csv"
