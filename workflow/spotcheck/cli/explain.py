"""`spotcheck explain`: where a number of the results comes from."""

import argparse
import json
from pathlib import Path

from spotcheck.cli import COMMANDS
from spotcheck.errors import InputError
from spotcheck.report import provenance
from spotcheck.report.provenance import explanation

EXAMPLES = """Examples:
  spotcheck explain p1 --results out/my-frames
  spotcheck explain unexplained.size --results out/my-frames
  spotcheck explain "fits.sigma_mean[angle=90, exposure=0.0009, repeat=1]" --json --results out/my-frames
  spotcheck explain --results out/my-frames      # lists all that can be asked for
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLES
    parser.add_argument("number", nargs="?", help="name of the number, long or short; none: list all")
    parser.add_argument("--results", type=Path, help="results folder of a dataset (default: the only one in results/)")
    parser.add_argument("--json", action="store_true", help="write JSON, for programs")


def run(args: argparse.Namespace) -> None:
    """Explain a number, or list what can be explained."""
    results = args.results or only_one(Path("results"))
    if args.number is None:
        listed = {"numbers": provenance.list_numbers(results), "tables": provenance.list_tables(results)}
        print(json.dumps(listed, indent=1) if args.json else explanation.listing_text(**listed))
        return
    number = provenance.find_number(results, args.number)
    if args.json:
        print(json.dumps(explanation.explanation_record(number, results), indent=1, ensure_ascii=False))
    else:
        print(explanation.explanation_text(number, results, args.number, COMMANDS.get(number.source.command, "")))


def only_one(base: Path) -> Path:
    """The folder of results where there is one dataset. Raises `InputError`."""
    there = sorted(note.parent for note in base.glob("*/.dataset"))
    if len(there) == 1:
        return there[0]
    if not there:
        raise InputError(f"{base}: no results here; name those of a dataset with --results")
    raise InputError(f"{base}: holds {', '.join(own.name for own in there)}; choose one, as in --results {there[0]}")
