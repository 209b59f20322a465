"""Write the instrument file of `spotcheck adopt`, and format the table that it prints.

The file describes the instrument and not the dataset: it has no name, conditions or crop. Each learned value has a
comment with its error, its source and the value of the data sheet. A key is "section.name", such as
sensor.gain_dn_per_e. The data sheet is what the dataset's own instrument.yaml states. A choice is the decision on one
learned value, with `is_adopted` and `reason`; its `learned` has key, value, standard error, unit and source. An unused
result is a result that no key can hold. A digest is the SHA-256 of a file.
"""

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from tabulate import tabulate

import spotcheck
from spotcheck.dataset.instrument import SECTIONS, BadPixels, Instrument
from spotcheck.errors import InputError
from spotcheck.export.learned_values import UnusedResult, digest_sources
from spotcheck.export.value_choice import Choice
from spotcheck.io import store
from spotcheck.io.number_text import quantity_text
from spotcheck.io.schema import read_schema

# Significant digits of a learned value and of its error, more than results determine.
DIGITS, ERROR_DIGITS = 6, 3
# Files of a results folder that values come from.
SOURCES = ("frames.nc", "transfer.nc", "sensor.nc", "fits.nc", "verdict.json", "light.nc")

# Widths of columns of the table of `format_table` [characters]: the value of the sheet, the decision, least of a text.
STATED_WIDTH, DECISION_WIDTH, NARROWEST_TEXT = 16, 5, 16


def write_instrument_file(
    path: Path, choices: Sequence[Choice], unused: Sequence[UnusedResult], instrument: Instrument, results: Path
) -> None:
    """Write an instrument file, and beside it the light shape if one was learned.

    Parameters
    ----------
    path : Path
        File to write; the light shape gets its stem with "-light.nc".
    choices : sequence of Choice
        Adopted values are written, the others are listed in a comment.
    unused : sequence of UnusedResult
        Results that are listed in the same comment.
    instrument : Instrument
        Data sheet of the dataset, for the other keys.
    results : Path
        Results folder, whose files are named with their digests.

    Raises
    ------
    InputError
        If a file already exists.
    """
    adopted_choices = {choice.learned.key: choice for choice in choices if choice.is_adopted}
    light_path = path.with_name(f"{path.stem}-light.nc")
    has_light = "light.profile" in adopted_choices
    for file in (path, *([light_path] if has_light else [])):
        if file.exists():
            raise InputError(f"{file}: is already there; name a new file, nothing is overwritten")
    path.parent.mkdir(parents=True, exist_ok=True)
    if has_light:
        with store.write_with_sidecar(light_path) as scratch:
            shutil.copyfile(adopted_choices["light.profile"].learned.value, scratch)
    lines = [*_format_head(results)]
    for section in SECTIONS:
        if rows := list(_format_section(path, section, adopted_choices, instrument, light_path.name)):
            lines += [f"{section}:", *(f"  {row}" for row in rows)]
    rejected = [
        f"{choice.learned.key}: learned {format_value(choice)}, {choice.learned.source}: {choice.reason}"
        for choice in choices
        if not choice.is_adopted
    ]
    rejected += [f"{result.name}: {result.text}: {result.reason}" for result in unused]
    if rejected:
        lines += ["# Not adopted:", *(f"# - {row}" for row in rejected)]
    store.write_text(path, "\n".join(lines) + "\n")


def _format_head(results: Path) -> Iterator[str]:
    """Yield the lines of the comment at the top of the file, with the first digits of the digest of each source."""
    yield f"# What the data sheet of {results.name} states, and what was learned from its frames: written by"
    yield f"# `spotcheck adopt`, version {spotcheck.__version__}. A dataset names this file by `based_on:` in its"
    yield "# instrument.yaml, or has it as its instrument.yaml."
    for name, digest in digest_sources(results, SOURCES).items():
        yield f"# {name}: SHA-256 {digest}"


def _format_section(
    path: Path, section: str, adopted_choices: Mapping[str, Choice], instrument: Instrument, light_name: str
) -> Iterator[str]:
    """Yield the lines of a section without its header, in the order of the schema; none if nothing is known.

    Parameters
    ----------
    path : Path
        File to write, to which paths of other files become relative.
    section : str
        Name of the section.
    adopted_choices : mapping of str to Choice
        Decisions to adopt a value, by key. Bad pixels are adopted as a whole, by the name of their section.
    instrument : Instrument
        Data sheet, for keys that have no adopted value.
    light_name : str
        Name of the file with the light shape, which lies beside `path`.
    """
    if section in adopted_choices:
        learned = adopted_choices[section].learned
        yield f"# {learned.source}"
        # A dataclass, whose fields have the names of the keys; empty ones are left out.
        fields = {name: value for name, value in asdict(learned.value).items() if value}
        yield from (f"{name}: {_format_yaml(name, value, path)}" for name, value in fields.items())
        return
    for name in read_schema("instrument")["properties"][section]["properties"]:
        key = f"{section}.{name}"
        if key in adopted_choices:
            choice = adopted_choices[key]
            text = _format_yaml(name, light_name if name == "profile" else choice.learned.value, path)
            yield f"{name}: {text}  # learned: {format_value(choice)}, {choice.learned.source}; {_explain(choice)}"
        # The stated error of an adopted value does not apply any more; an unknown one (NaN) is left out.
        elif name.endswith("_stderr") and key.removesuffix("_stderr") in adopted_choices:
            stderr = adopted_choices[key.removesuffix("_stderr")].learned.stderr
            if np.isfinite(stderr):
                yield f"{name}: {stderr:.{ERROR_DIGITS}g}"
        elif key in instrument.given_keys:
            yield f"{name}: {_format_yaml(name, getattr(getattr(instrument, section), name), path)}"


def _format_yaml(name: str, value: Any, path: Path) -> str:
    """Return the value of a key as YAML; `name` is the key without its section.

    The values of `profile` and `mask` are paths of files: absolute ones become relative to the folder of the new file
    `path`. Finite floats are rounded to `DIGITS`. Learned values are finite, other values are those of the data sheet.
    """
    if name in ("profile", "mask") and Path(value).is_absolute():
        value = os.path.relpath(value, path.parent.resolve())
    if isinstance(value, float) and np.isfinite(value):
        return f"{value:.{DIGITS}g}"
    return json.dumps(value)


def _explain(choice: Choice) -> str:
    """Return why a value was adopted, and the value of the data sheet if it states one."""
    if choice.stated is None:
        return choice.reason
    return f"{choice.reason}, which said {quantity_text(float(choice.stated), choice.stated_stderr)}"


def format_value(choice: Choice) -> str:
    """Return a learned value as text: a number with error and unit, counts of bad pixels, or "a shape" for a file."""
    value = choice.learned.value
    if isinstance(value, BadPixels):
        counts = {name: len(getattr(value, name)) for name in ("columns", "rows", "pixels")}
        return ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    if isinstance(value, Path):
        return "a shape"
    return quantity_text(float(value), choice.learned.stderr, choice.learned.unit)


def format_table(choices: Sequence[Choice], unused: Sequence[UnusedResult], width: int) -> str:
    """Return a text table of all learned values and unused results, with the decision on each and its reason.

    `width` is the number of characters of a line. Long texts are wrapped, to at least `NARROWEST_TEXT` characters.
    """
    rows = []
    for choice in choices:
        learned = choice.learned
        stated = "–" if choice.stated is None else quantity_text(float(choice.stated), choice.stated_stderr)
        decision = "taken" if choice.is_adopted else "left"
        rows.append((learned.key, stated, format_value(choice), decision, choice.reason, learned.source))
    rows += [(result.name, "–", result.text, "left", result.reason, "verdict.json") for result in unused]
    key_width = max((len(key) for key, *_ in rows), default=0)
    # The rest of a line for the learned value, the reason and the origin; two spaces stand between columns.
    text_width = max(NARROWEST_TEXT, (width - key_width - STATED_WIDTH - DECISION_WIDTH - 10) // 3)
    widths = [None, STATED_WIDTH, text_width, None, text_width, text_width]
    headers = ("key", "sheet", "learned", "", "why", "origin")
    return tabulate(rows, headers, tablefmt="plain", disable_numparse=True, maxcolwidths=widths)
