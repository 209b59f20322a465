"""Workflow rules that write the result files, as the help texts of the subcommands declare them.

A rule is a step of the workflow (Snakefile), which calls a subcommand of `spotcheck` to write result files. Rules for
simulated frames, and for the extended model with added effects, are variants that call the same subcommand.
"""

import ast
import json
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from spotcheck.io.provenance import PACKAGE
from spotcheck.report.provenance.records import Input, Source

# Help text of an option that names an output file: "calibration.nc to write".
OUTPUT_HELP = re.compile(r"((?:\w+\.\w+)(?: or \w+\.\w+)*) to write")


@cache
def list_outputs() -> dict[str, tuple[tuple[str, ...], ...]]:
    """Return the possible file names of each output option of a subcommand, by the name of the subcommand.

    The first name of an option is written by the rule named like the subcommand, the others by variants of this rule.
    """
    outputs = {}
    for path in sorted((PACKAGE / "cli").glob("*.py")):
        help_texts = [
            str(keyword.value.value)
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "add_argument"
            for keyword in node.keywords
            if keyword.arg == "help" and isinstance(keyword.value, ast.Constant)
        ]
        matches = filter(None, map(OUTPUT_HELP.match, help_texts))
        if options := tuple(tuple(match[1].split(" or ")) for match in matches):
            # Modules have underscores where subcommands have hyphens.
            outputs[path.stem.replace("_", "-")] = options
    return outputs


class Rule(NamedTuple):
    """A workflow rule."""

    name: str  # name of the rule
    command: str  # subcommand that the rule calls


def find_rule(results: Path, file: str) -> Rule | None:
    """Return the rule that writes a file of a results folder.

    Parameters
    ----------
    results : Path
        Results folder of a dataset.
    file : str
        Path of the file in that folder.

    Returns
    -------
    Rule or None
        None if no subcommand writes a file of this name. If several do, the one with the largest share of its
        outputs in the same folder is chosen.
    """
    path = results / file
    candidates = [
        (_count_present(path, options), command)
        for command, options in list_outputs().items()
        if any(path.name in names for names in options)
    ]
    if not candidates:
        return None
    command = max(candidates)[1]
    default_name = next(names[0] for names in list_outputs()[command] if path.name in names)
    # A variant is named after the folder of simulated frames, the file if it is not the default one, or both.
    suffixes = [Path(file).parent.name, "" if path.name == default_name else path.stem]
    return Rule("_".join([command, *filter(None, suffixes)]), command)


def _count_present(path: Path, options: tuple[tuple[str, ...], ...]) -> tuple[float, int]:
    """Return the share of a subcommand's outputs that are in the folder of a file, and the number of outputs.

    `options` holds the possible file names of each output.
    """
    is_present = [any(path.with_name(name).exists() for name in names) for names in options]
    return sum(is_present) / len(is_present), len(is_present)


def read_source(results: Path, file: str, attributes: Mapping[str, Any]) -> Source | None:
    """Return the provenance of a result file; None if no rule writes it.

    The inputs, the code version and the time are recorded in the netCDF `attributes` of the file, or else in its note
    in the folder `.runs`.
    """
    rule = find_rule(results, file)
    if rule is None:
        return None
    note = (results / file).parent / ".runs" / f"{Path(file).name}.json"
    record = (json.loads(note.read_text(encoding="utf-8")) if note.is_file() else {}) | dict(attributes)
    inputs, code, written = (str(record.get(name, "")) for name in ("inputs", "code_version", "written"))
    return Source(file, rule.name, rule.command, parse_inputs(inputs), code, written)


def parse_inputs(text: str) -> tuple[Input, ...]:
    """Return the inputs in the attribute `inputs` of a result file, such as "crops.nc 10c624ef4d826b7e; …"."""
    return tuple(Input(*item.rsplit(" ", 1)) for item in text.split("; ") if item)
