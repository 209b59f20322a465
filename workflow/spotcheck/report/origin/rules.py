"""Which rule writes which file of the results, as the subcommands themselves say, and what the files carry of it."""

import ast
import json
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from spotcheck.io.provenance import PACKAGE
from spotcheck.report.origin.number import Input, Source

# An option that names a file to write says so in its help: "calibration.nc to write".
WRITES = re.compile(r"((?:\w+\.\w+)(?: or \w+\.\w+)*) to write")


@cache
def written_by() -> dict[str, tuple[tuple[str, ...], ...]]:
    """Subcommand → for each option that names a file to write, the files that it may name.

    Of several the first is that of the rule named like the subcommand, the others those of its variants.
    """
    found = {}
    for path in sorted((PACKAGE / "cli").glob("*.py")):
        helps = [
            keyword.value.value
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "add_argument"
            for keyword in node.keywords
            if keyword.arg == "help" and isinstance(keyword.value, ast.Constant)
        ]
        if files := tuple(tuple(match[1].split(" or ")) for text in helps if (match := WRITES.match(str(text)))):
            found[path.stem.replace("_", "-")] = files
    return found


class Maker(NamedTuple):
    """The rule that writes a file, and the subcommand that it calls."""

    rule: str
    command: str


def maker_of(results: Path, file: str) -> Maker | None:
    """What writes a file of a results folder; None where nothing writes a file of this name.

    Where several subcommands write one of this name, it is that whose other files lie beside it.
    """
    path = results / file
    able = [
        (_beside(path, options), command)
        for command, options in written_by().items()
        if any(path.name in names for names in options)
    ]
    if not able:
        return None
    command = max(able)[1]
    first, *_ = next(names for names in written_by()[command] if path.name in names)
    # Frames of a simulation, and a simulation of another model, go through variants of a rule.
    variants = [Path(file).parent.name, "" if path.name == first else path.stem]
    return Maker("_".join([command, *filter(None, variants)]), command)


def _beside(path: Path, options: tuple[tuple[str, ...], ...]) -> tuple[float, int]:
    """Which part of the files that a subcommand writes lies in a file's folder, and how many they are."""
    there = [any(path.with_name(name).exists() for name in names) for names in options]
    return sum(there) / len(there), len(there)


def source_of(results: Path, file: str, attributes: Mapping[str, Any]) -> Source | None:
    """How a file of a results folder came about, by its note and, of a netCDF file, its attributes; None where nothing
    writes a file of this name."""
    maker = maker_of(results, file)
    if maker is None:
        return None
    note = (results / file).parent / ".runs" / f"{Path(file).name}.json"
    told = (json.loads(note.read_text(encoding="utf-8")) if note.is_file() else {}) | dict(attributes)
    inputs, code, written = (str(told.get(name, "")) for name in ("inputs", "code_version", "written"))
    return Source(file, maker.rule, maker.command, inputs_in(inputs), code, written)


def inputs_in(text: str) -> tuple[Input, ...]:
    """The inputs in an attribute `inputs`, as `store.write` writes it: "crops.nc 10c624ef4d826b7e; …"."""
    return tuple(Input(*own.rsplit(" ", 1)) for own in text.split("; ") if own)
