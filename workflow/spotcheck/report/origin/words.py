"""An explanation for a person, and the same for a program."""

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

from spotcheck.discrepancy.words import value_text
from spotcheck.report.origin.ask import frame_of, related, shown
from spotcheck.report.origin.number import Number, Source
from spotcheck.report.origin.tree import Node, grown

# Hex digits of a digest that a person compares by eye.
DIGITS = 8
# Beside those that `value_text` knows.
UNITS = {"pixel2": "px²", "DN2": "DN²"}


def explained(number: Number, results: Path, asked: str, task: str) -> str:
    """Value, meaning, place, rule and inputs of a number as lines of text; `task` is what its subcommand is for."""
    source = number.source
    rows = {
        "how": number.method,
        "key": number.key,
        "in": f"{results / number.file}: {shown(number.variable)}",
        "frame": frame_said(results, number),
        "by": f"rule {source.rule} (spotcheck {source.command}: {task})" if source.rule else "whoever gave the dataset",
        "made": made(source) if source.rule else "",
    }
    lines = [f"{asked} = {measured(number)}", f"  {number.words}", ""]
    lines += [f"  {name:<7}{text}" for name, text in rows.items() if text]
    below = [f"    {line}" for node in grown(results, source) for line in drawn(node)]
    lines += ["  from", *below] if below else []
    others = [f"    {own.key} = {measured(own)}" for own in related(results, asked, number)]
    return "\n".join(lines + (["  see also", *others] if others else []))


def frame_said(results: Path, number: Number) -> str:
    """Of a number of one frame its file, with the digest that frames.nc holds of it."""
    frame = frame_of(results, number)
    return f"{frame[0]}  {frame[1][:DIGITS]}" if frame else ""


def measured(number: Number) -> str:
    """Value ± error with its unit. A part that is nearly all is not said to be all."""
    value, text = number.value, value_text(number.value, number.stderr, UNITS.get(number.unit, number.unit))
    return f"{value:.9g}" if text == "1" and value != 1 else text


def made(source: Source) -> str:
    """When, and by which code."""
    when = f"{datetime.fromisoformat(source.written):%Y-%m-%d %H:%M} UTC" if source.written else "no note says when"
    return f"{when}{f', code {source.code}' if source.code else ''}"


def drawn(node: Node, depth: int = 0) -> Iterator[str]:
    """A file and what it was made from, indented."""
    parts = [node.name, node.digest[:DIGITS], f"by rule {node.rule}" if node.rule else "", node.remark]
    yield "  " * depth + "  ".join(part for part in parts if part)
    for own in node.inputs:
        yield from drawn(own, depth + 1)


def plain(number: Number, results: Path) -> dict[str, Any]:
    """All that is known of a number, as JSON holds it."""
    source = number.source
    told = {name: getattr(number, name) for name in ("key", "value", "stderr", "unit", "words", "method", "variable")}
    told |= {"file": str(results / number.file), "rule": source.rule, "command": source.command}
    return told | {
        "code": source.code,
        "written": source.written,
        "inputs": [_plain(n) for n in grown(results, source)],
    }


def _plain(node: Node) -> dict[str, Any]:
    return node._asdict() | {"inputs": [_plain(own) for own in node.inputs]}


def listed(numbers: list[str], tables: list[str]) -> str:
    """All names, for a person."""
    return "\n".join(["Numbers:", *(f"  {own}" for own in numbers), "", "One for each …:", *(f"  {t}" for t in tables)])
