"""Which rule writes which file of the results, as the subcommands themselves say, and what the files carry of it."""

import ast
import json
import re
from functools import cache
from pathlib import Path

import netCDF4

from spotcheck.origin.number import Input, Source
from spotcheck.provenance import PACKAGE

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


def source_of(results: Path, file: str) -> Source | None:
    """How a file of a results folder came about; None where no rule writes a file of this name.

    Where several rules may have written it, the files that each writes beside it tell.
    """
    path = results / file
    able = [
        (len(options), command)
        for command, options in written_by().items()
        if any(path.name in names for names in options)
        and all(any(path.with_name(name).exists() for name in names) for names in options)
    ]
    if not able:
        return None
    command = max(able)[1]
    names = next(own for own in written_by()[command] if path.name in own)
    variants = [Path(file).parent.name, "" if path.name == names[0] else path.stem]
    told = carried(path)
    return Source(
        file,
        "_".join([command, *filter(None, variants)]),
        command,
        inputs_in(told.get("inputs", "")),
        told.get("code_version", ""),
        told.get("written", ""),
    )


def carried(path: Path) -> dict[str, str]:
    """What a file says of its making: its note, and the attributes of a netCDF file."""
    note = path.parent / ".runs" / f"{path.name}.json"
    told = json.loads(note.read_text(encoding="utf-8")) if note.is_file() else {}
    if path.suffix == ".nc":
        with netCDF4.Dataset(path) as nc:
            told |= {name: nc.getncattr(name) for name in nc.ncattrs()}
    return told


def inputs_in(text: str) -> tuple[Input, ...]:
    """The inputs in an attribute `inputs`, as `store.write` writes it: "crops.nc 10c624ef4d826b7e; …"."""
    return tuple(Input(*own.rsplit(" ", 1)) for own in text.split("; ") if own)
