"""`spotcheck limits`: what a verdict did not find, and how large it could still be."""

import argparse
import json
from pathlib import Path

from spotcheck.cli.explain import only_one
from spotcheck.discrepancy.words import limits_text
from spotcheck.errors import InputError

EXAMPLE = """Example:
  spotcheck limits --results out/my-frames
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("--results", type=Path, help="results folder of a dataset (default: the only one in results/)")


def run(args: argparse.Namespace) -> None:
    """Print a line for each effect that was asked and not named."""
    path = (args.results or only_one(Path("results"))) / "verdict.json"
    if not path.is_file():
        raise InputError(f"{path}: is not there; name the results of a dataset that was judged")
    print(
        "\n".join(
            limits_text(json.loads(path.read_text(encoding="utf-8"))) or ["Every effect that was asked is named."]
        )
    )
