"""`spotcheck explain`: shows where a number of the results comes from: file, variable, rule and inputs.

A rule is a step of the workflow that runs a subcommand. A number has a name such as p1 or fits.sigma_mean[…].

Examples
--------
spotcheck explain p1 --results out/my-frames
spotcheck explain unexplained.size --results out/my-frames
spotcheck explain "fits.sigma_mean[angle=90, exposure=0.0009, repeat=1]" --json --results out/my-frames
spotcheck explain --results out/my-frames      # lists all names
"""

import argparse
import json
from pathlib import Path

from spotcheck.cli import COMMANDS
from spotcheck.errors import InputError
from spotcheck.report import provenance
from spotcheck.report.provenance import explanation


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("name", nargs="?", metavar="number", help="name, such as p1; without it, all names are listed")
    parser.add_argument("--results", type=Path, help="results folder of a dataset (default: the only one in results/)")
    parser.add_argument("--json", action="store_true", help="write JSON, for programs")


def run(args: argparse.Namespace) -> None:
    """Print the explanation of a number, or the names of all numbers and tables, as text or JSON.

    Raises `InputError` for an unknown name.
    """
    results = args.results or find_only_results(Path("results"))
    if args.name is None:
        names = {"numbers": provenance.list_numbers(results), "tables": provenance.list_tables(results)}
        print(json.dumps(names, indent=1) if args.json else explanation.listing_text(**names))
        return
    number = provenance.find_number(results, args.name)
    if args.json:
        print(json.dumps(explanation.explanation_record(number, results), indent=1, ensure_ascii=False))
    else:
        # The source of a number names the subcommand that wrote it, whose sentence says what it does.
        print(explanation.explanation_text(number, results, args.name, COMMANDS.get(number.source.command, "")))


def find_only_results(base: Path) -> Path:
    """Return the only folder in `base` that holds results of a dataset.

    Raises `InputError` if there are none or several.
    """
    # The file .dataset names the dataset to which a folder of results belongs.
    folders = sorted(owner_file.parent for owner_file in base.glob("*/.dataset"))
    if len(folders) == 1:
        return folders[0]
    if not folders:
        raise InputError(f"{base}: no results here; name those of a dataset with --results")
    names = ", ".join(folder.name for folder in folders)
    raise InputError(f"{base}: holds {names}; choose one, as in --results {folders[0]}")
