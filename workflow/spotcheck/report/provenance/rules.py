"""Workflow rules that write the result files, as the help texts of the subcommands declare them.

A rule is a step of the workflow (Snakefile). It calls a subcommand of `spotcheck`, which writes result files. A variant
of a rule calls the same subcommand for simulated frames or for the extended model, and has a suffix: `fit_simulated`
is the variant of `fit` that writes simulated/fits.nc.
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
    """Return the output files of each subcommand, by its name; subcommands without output files are omitted.

    A subcommand has one tuple of file names for each option that names an output file. The first file name is that of
    the rule named like the subcommand, the others are those of its variants.
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
        None if no subcommand writes a file of this name. If several subcommands do, the one with the largest share of
        its outputs in the folder of the file is chosen.
    """
    path = results / file
    candidates = [
        (_compute_present_share(path, options), command)
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


def _compute_present_share(path: Path, options: tuple[tuple[str, ...], ...]) -> tuple[float, int]:
    """Return (share of the outputs of a subcommand that exist in the folder of the file `path`, number of outputs).

    `options` are the outputs of the subcommand as `list_outputs` returns them.
    """
    is_present = [any(path.with_name(name).exists() for name in names) for names in options]
    return sum(is_present) / len(is_present), len(is_present)


def read_source(results: Path, file: str, attributes: Mapping[str, Any]) -> Source | None:
    """Return the provenance of a result file; None if no rule writes it.

    Parameters
    ----------
    results : Path
        Results folder of a dataset.
    file : str
        Path of the file in that folder.
    attributes : mapping
        netCDF attributes of the file; empty for a file of another format. A file of another format has its provenance
        in `.runs/<name>.json` in the same folder.
    """
    rule = find_rule(results, file)
    if rule is None:
        return None
    json_file = (results / file).parent / ".runs" / f"{Path(file).name}.json"
    record = (json.loads(json_file.read_text(encoding="utf-8")) if json_file.is_file() else {}) | dict(attributes)
    inputs, code, written = (str(record.get(name, "")) for name in ("inputs", "code_version", "written"))
    # Name and digest of each input: "crops.nc 10c624ef4d826b7e; fits.nc 88d1…".
    listed = tuple(Input(*item.rsplit(" ", 1)) for item in inputs.split("; ") if item)
    return Source(file, rule.name, rule.command, listed, code, written)
