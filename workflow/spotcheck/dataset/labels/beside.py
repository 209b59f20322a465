"""Texts beside an image: a file of its own name, a table of a folder's images, and the list of an EMVA 1288
measurement."""

import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path, PureWindowsPath

from spotcheck.dataset.labels import tables, words
from spotcheck.dataset.labels.label import Label
from spotcheck.errors import InputError
from spotcheck.io import schema
from spotcheck.io.text import read_text

ENDINGS = (".txt", ".json", ".yaml", ".yml", ".xml")
# Lines of the list of an EMVA 1288 reference data set: n with bits, columns and rows; b (bright) or d (dark) with
# exposure [ns] and photons a pixel, then i with a path for each of its images.
_LISTS = tuple(re.compile(rf"(?m)^{line}") for line in (r"n\s+\d+\s+\d+\s+\d+", r"[bd]\s+\d", r"i\s+\S"))


def files_of(path: Path) -> list[Path]:
    """Files of an image's name that may speak of it: a.json and a.tif.json of a.tif."""
    named = (path.with_suffix(end) for end in ENDINGS), (path.with_name(path.name + end) for end in ENDINGS)
    return [own for names in named for own in names if own.is_file()]


def lists_in(folder: Path) -> list[Path]:
    """Tables and lists that speak of the images of a folder."""
    return list(_lists_in(folder, folder.stat().st_mtime_ns))


@lru_cache(maxsize=64)
def _lists_in(folder: Path, _changed_ns: int) -> tuple[Path, ...]:
    """Looked up once for all images of a folder."""
    may_be = (own for own in folder.iterdir() if own.suffix.lower() == ".txt" or tables.may_be(own))
    return tuple(sorted(own for own in may_be if own.is_file() and _listed(own, *_stamps(own))))


def labels_of(path: Path) -> Iterator[Label]:
    """Labels of the files beside an image. Raises `InputError` for one that cannot be read."""
    for own in files_of(path):
        where = f"side file {own.name}"
        if own.stat().st_size > words.LONGEST_TEXT:
            raise InputError(f"{own.name}: has {own.stat().st_size} bytes, too many for a text beside an image")
        if own.suffix.lower() in (".yaml", ".yml"):
            yield from words.of_keys(words.flat(schema.read_keys(own)), where)
        else:
            yield from words.labels_in(read_text(own), where)
    for folder in path.parents[:2]:
        for own in lists_in(folder):
            yield from _listed(own, *_stamps(own)).get(path.name, ())


def _stamps(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns


@lru_cache(maxsize=32)
def _listed(path: Path, size: int, _changed_ns: int) -> dict[str, tuple[Label, ...]]:
    """Labels by an image's name; empty where the file is no such table or list."""
    try:
        text = read_text(path) if size <= words.LONGEST_TEXT else ""
    except InputError:
        return {}
    if tables.may_be(path):
        return tables.labels_in(text, path.name)
    if not all(line.search(text) for line in _LISTS):
        return {}
    found: dict[str, tuple[Label, ...]] = {}
    head: tuple[Label, ...] = ()
    level: tuple[Label, ...] = ()
    for line in text.splitlines():
        cells = line.split()
        match cells[:1], cells[1:]:
            case ["n"], [bits, *_] if bits.isdecimal():
                head = (Label("sensor.bit_depth", int(bits), line, path.name),)
            case ["b" | "d"], [exposure, *photons]:
                level = _level(cells[0] == "d", exposure, photons, line, path.name)
            case ["i"], [*name]:
                found[PureWindowsPath(" ".join(name)).name] = (*level, *head)
    return found


def _level(dark: bool, exposure: str, photons: list[str], line: str, where: str) -> tuple[Label, ...]:
    seconds, light = words.valued(exposure, "ns", "s"), words.valued((photons or [""])[0], "s", "s")
    out = (Label("kind", "dark" if dark else "flat", line, where), Label("exposure_s", seconds, line, where))
    return out if dark else (*out, Label("photons_per_px", light, line, where))
