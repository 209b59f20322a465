"""`spotcheck limits`: prints upper limits on the sizes of the effects that a verdict does not name.

Examples
--------
spotcheck limits --results out/my-frames
"""

import argparse
import json
from pathlib import Path

from spotcheck.cli.explain import find_only_results
from spotcheck.discrepancy.words import limits_text
from spotcheck.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("--results", type=Path, help="results folder of a dataset (default: the only one in results/)")


def run(args: argparse.Namespace) -> None:
    """Print a line for each effect that was tested but is not named in the verdict.

    Raises `InputError` if the results have no verdict.
    """
    verdict_path = (args.results or find_only_results(Path("results"))) / "verdict.json"
    if not verdict_path.is_file():
        raise InputError(f"{verdict_path}: is not there; name the results of a dataset that was judged")
    lines = limits_text(json.loads(verdict_path.read_text(encoding="utf-8")))
    print("\n".join(lines or ["Every effect that was tested is named."]))
