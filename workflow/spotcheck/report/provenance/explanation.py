"""Explanations of a number and its provenance: as text, and as JSON."""

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

# Hex digits of a digest in a text.
DIGEST_DIGITS = 8
# Units that `quantity_text` does not know.
UNITS = {"pixel2": "px²", "DN2": "DN²"}


def explanation_text(number: Number, results: Path, question: str, purpose: str) -> str:
    """Return value, meaning, file, rule and inputs of a number as lines of text.

    Parameters
    ----------
    number : Number
        The number.
    results : Path
        Results folder.
    question : str
        Name by which the user asked for the number.
    purpose : str
        Purpose of the subcommand that wrote the file.
    """
    source, frame = number.source, find_frame(results, number)
    rule = f"rule {source.rule} (spotcheck {source.command}: {purpose})"
    rows = {
        "how": number.method,
        "key": number.key,
        "in": f"{results / source.file}: {spaced_variable(number.variable)}",
        "frame": f"{frame[0]}  {frame[1][:DIGEST_DIGITS]}" if frame else "",
        "by": rule if source.rule else "the user, who provided the file",
        "made": _writing_text(source) if source.rule else "",
    }
    lines = [f"{question} = {number_text(number)}", f"  {number.description}", ""]
    lines += [f"  {name:<7}{text}" for name, text in rows.items() if text]
    inputs = [f"    {line}" for item in trace_inputs(results, source) for line in _input_lines(item)]
    lines += ["  from", *inputs] if inputs else []
    related = [f"    {other.key} = {number_text(other)}" for other in find_related(results, question, number)]
    lines += ["  see also", *related] if related else []
    return "\n".join(lines)


def number_text(number: Number) -> str:
    """Return value ± error with unit; a fraction just below 1 is not rounded to 1."""
    value, text = number.value, quantity_text(number.value, number.stderr, UNITS.get(number.unit, number.unit))
    return f"{value:.9g}" if text == "1" and value != 1 else text


def _writing_text(source: Source) -> str:
    """Return when, and by which version of the code, a file was written."""
    if not source.written:
        time = "time not recorded"
    else:
        time = f"{datetime.fromisoformat(source.written):%Y-%m-%d %H:%M} UTC"
    return f"{time}{f', code {source.code}' if source.code else ''}"


def _input_lines(item: InputFile, depth: int = 0) -> Iterator[str]:
    """Yield one line for an input file and each of its inputs, indented by depth."""
    parts = [item.name, item.digest[:DIGEST_DIGITS], f"by rule {item.rule}" if item.rule else "", item.remark]
    yield "  " * depth + "  ".join(filter(None, parts))
    for inner in item.inputs:
        yield from _input_lines(inner, depth + 1)


def explanation_record(number: Number, results: Path) -> dict[str, Any]:
    """Return a number and its provenance as JSON stores them."""
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
        "inputs": [asdict(item) for item in trace_inputs(results, source)],
    }


def listing_text(numbers: list[str], tables: list[str]) -> str:
    """Return the names of all numbers and tables as lines of text."""
    lines = ["Numbers:", *(f"  {name}" for name in numbers)]
    return "\n".join([*lines, "", "One for each …:", *(f"  {name}" for name in tables)])
