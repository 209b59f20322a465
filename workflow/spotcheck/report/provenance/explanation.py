"""Explanations of a number and its provenance: as text, and as JSON.

A rule is a step of the workflow, which calls a subcommand of `spotcheck` to write result files.
"""

from collections.abc import Iterator
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from spotcheck.io.number_text import quantity_text
from spotcheck.report.provenance.frames import find_frame
from spotcheck.report.provenance.inputs import InputFile, trace_inputs
from spotcheck.report.provenance.lookup import find_related, spaced_variable
from spotcheck.report.provenance.records import Number, Source

# Hex digits of a SHA-256 in a text.
DIGEST_DIGITS = 8
# Units as a person writes them, which `quantity_text` does not know.
UNITS = {"pixel2": "px²", "DN2": "DN²"}


def explanation_text(number: Number, results: Path, question: str, purpose: str) -> str:
    """Return value, meaning, file, rule and inputs of a number, and related numbers, as lines of text.

    Parameters
    ----------
    number : Number
        The number.
    results : Path
        Results folder that holds the number.
    question : str
        Name by which the user asked for the number, with labels.
    purpose : str
        Purpose of the subcommand that wrote the file, in words.
    """
    source, frame = number.source, find_frame(results, number)
    rule = f"rule {source.rule} (spotcheck {source.command}: {purpose})"
    rows = {
        "how": number.method,
        "key": number.key,
        "in": f"{results / source.file}: {spaced_variable(number.variable)}",
        # Name and SHA-256 of the frame, if the number belongs to a single one.
        "frame": f"{frame[0]}  {frame[1][:DIGEST_DIGITS]}" if frame else "",
        "by": rule if source.rule else "the user, who provided the file",
        "made": _writing_text(source) if source.rule else "",
    }
    lines = [f"{question} = {number_text(number)}", f"  {number.description}", ""]
    lines += [f"  {name:<7}{text}" for name, text in rows.items() if text]
    inputs = [f"    {line}" for input_file in trace_inputs(results, source) for line in _list_lines(input_file)]
    lines += ["  from", *inputs] if inputs else []
    related = [f"    {other.key} = {number_text(other)}" for other in find_related(results, question, number)]
    lines += ["  see also", *related] if related else []
    return "\n".join(lines)


def number_text(number: Number) -> str:
    """Return value ± error with unit as text; a value near 1 without error has up to nine digits."""
    value, text = number.value, quantity_text(number.value, number.stderr, UNITS.get(number.unit, number.unit))
    return f"{value:.9g}" if text == "1" and value != 1 else text


def _writing_text(source: Source) -> str:
    """Return when, and by which version of the code, a file was written."""
    if not source.written:
        time = "time not recorded"
    else:
        time = f"{datetime.fromisoformat(source.written):%Y-%m-%d %H:%M} UTC"
    return f"{time}{f', code {source.code}' if source.code else ''}"


def _list_lines(file: InputFile, depth: int = 0) -> Iterator[str]:
    """Yield one line for an input file, and one for each of its inputs and theirs, indented by depth."""
    fields = [file.name, file.digest[:DIGEST_DIGITS], f"by rule {file.rule}" if file.rule else "", file.remark]
    yield "  " * depth + "  ".join(filter(None, fields))
    for input_file in file.inputs:
        yield from _list_lines(input_file, depth + 1)


def explanation_record(number: Number, results: Path) -> dict[str, Any]:
    """Return a number and its provenance as the object that `spotcheck explain --json` writes."""
    source = number.source
    return {
        "key": number.key,
        "value": number.value,
        "stderr": number.stderr,
        "unit": number.unit,
        "words": number.description,
        "method": number.method,
        "variable": number.variable,
        "file": str(results / source.file),
        "rule": source.rule,
        "command": source.command,
        "code": source.code,
        "written": source.written,
        "inputs": [asdict(input_file) for input_file in trace_inputs(results, source)],
    }


def listing_text(numbers: list[str], tables: list[str]) -> str:
    """Return the names of all numbers, and of all tables with their dimensions, as lines of text."""
    lines = ["Numbers:", *(f"  {name}" for name in numbers)]
    return "\n".join([*lines, "", "One for each …:", *(f"  {name}" for name in tables)])
