"""The instrument file that `spotcheck adopt` writes, and the table that it prints.

The file holds what describes the instrument, not the dataset: no name, no conditions, no crop. Each value that was
learned says in a comment its error, where it comes from and what the sheet stated.
"""

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import spotcheck
from spotcheck.dataset.instrument import SECTIONS, BadPixels, Instrument
from spotcheck.errors import InputError
from spotcheck.export.adoption.chosen import Choice
from spotcheck.export.adoption.learned import Left, number
from spotcheck.io import provenance, store
from spotcheck.io.plus_minus import plus_minus
from spotcheck.io.schema import read_schema

# Digits of a value that was learned and of its error: more than any of them is known to.
DIGITS, DIGITS_OF_ERROR = 6, 3
# Files that values come from.
SOURCES = ("frames.nc", "transfer.nc", "sensor.nc", "fits.nc", "verdict.json", "light.nc")


def write(path: Path, choices: Sequence[Choice], left: Sequence[Left], given: Instrument, results: Path) -> None:
    """Write an instrument file, and beside it the light's shape where one was learned. Raises `InputError` where a file
    is already there."""
    profile = next((own.learned.value for own in choices if own.learned.key == "light.profile" and own.taken), None)
    light = path.with_name(f"{path.stem}-light.nc")
    for file in (path, *([light] if profile else [])):
        if file.exists():
            raise InputError(f"{file}: is already there; name a new file, nothing is overwritten")
    path.parent.mkdir(parents=True, exist_ok=True)
    if profile:
        with store.write_with_sidecar(light) as scratch:
            shutil.copyfile(profile, scratch)
    store.write_text(path, "\n".join(_lines(path, choices, left, given, results, light)) + "\n")


def _lines(
    path: Path, choices: Sequence[Choice], left: Sequence[Left], given: Instrument, results: Path, light: Path
) -> Iterator[str]:
    yield f"# What the data sheet of {results.name} states, and what was learned from its frames: written by"
    yield f"# `spotcheck adopt`, version {spotcheck.__version__}. A dataset names this file by `based_on:` in its"
    yield "# instrument.yaml, or has it as its instrument.yaml."
    for name in SOURCES:
        if (results / name).is_file():
            yield f"# {name}: SHA-256 {provenance.file_digest(results / name)[:16]}"
    taken = {own.learned.key: own for own in choices if own.taken}
    for section in SECTIONS:
        rows = list(_section(path, section, taken, given, light))
        if rows:
            yield f"{section}:"
            yield from (f"  {row}" for row in rows)
    kept = [
        f"{own.learned.key}: learned {said(own)}, {own.learned.origin}: {own.why}" for own in choices if not own.taken
    ]
    kept += [f"{own.what}: {own.said}: {own.why}" for own in left]
    if kept:
        yield "# Not adopted:"
        yield from (f"# - {row}" for row in kept)


def _section(path: Path, section: str, taken: Mapping[str, Choice], given: Instrument, light: Path) -> Iterator[str]:
    """The keys of a section, in the order of the schema."""
    if section in taken:
        own = taken[section]
        assert isinstance(own.learned.value, BadPixels)
        yield f"# {own.learned.origin}"
        values = {key: value for key, value in asdict(own.learned.value).items() if value}
        yield from (f"{key}: {_text(key, value, path)}" for key, value in values.items())
        return
    for key in read_schema("instrument")["properties"][section]["properties"]:
        name = f"{section}.{key}"
        if name in taken:
            own = taken[name]
            value = light.name if key == "profile" else own.learned.value
            yield f"{key}: {_text(key, value, path)}  # learned: {said(own)}, {own.learned.origin}; {_before(own)}"
        elif key.endswith("_stderr") and name.removesuffix("_stderr") in taken:
            error = taken[name.removesuffix("_stderr")].learned.stderr
            if np.isfinite(error):
                yield f"{key}: {error:.{DIGITS_OF_ERROR}g}"
        elif name in given.given_keys:
            yield f"{key}: {_text(key, getattr(getattr(given, section), key), path)}"


def _text(key: str, value: Any, path: Path) -> str:
    """A value as YAML has it; files by their way from the new one."""
    if key in ("profile", "mask") and Path(value).is_absolute():
        value = os.path.relpath(value, path.parent.resolve())
    if isinstance(value, float):
        return f"{value:.{DIGITS}g}" if np.isfinite(value) else json.dumps(value)
    return json.dumps(value)


def _before(own: Choice) -> str:
    """Why a value was taken, and what stood there."""
    if own.stated is None:
        return own.why
    return f"{own.why}, which said {plus_minus(float(own.stated), own.stated_stderr)}"


def said(own: Choice) -> str:
    """A learned value with its error and unit."""
    value = own.learned.value
    if isinstance(value, BadPixels):
        parts = (
            (len(own), name)
            for name, own in (("columns", value.columns), ("rows", value.rows), ("pixels", value.pixels))
        )
        return ", ".join(f"{count} {name}" for count, name in parts if count)
    if isinstance(value, Path):
        return "a shape"
    return number(float(value), own.learned.stderr, own.learned.unit)


def table(choices: Sequence[Choice], left: Sequence[Left]) -> str:
    """Key, what the sheet says, what was learned, whether it is taken and why, and where it comes from."""
    rows = [("key", "sheet", "learned", "", "why", "origin")]
    for own in choices:
        stated = "–" if own.stated is None else plus_minus(float(own.stated), own.stated_stderr)
        rows.append((own.learned.key, stated, said(own), "taken" if own.taken else "left", own.why, own.learned.origin))
    rows += [(own.what, "–", own.said, "left", own.why, "verdict.json") for own in left]
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.ljust(wide) for cell, wide in zip(row, widths, strict=True)).rstrip() for row in rows
    )
