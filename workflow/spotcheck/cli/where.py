"""`spotcheck where`: say where the results of a dataset lie."""

import argparse
from pathlib import Path

from spotcheck.errors import InputError

PLACES = (
    ("report.html", "everything on one page"),
    ("figures", "every figure as SVG and PNG"),
    ("paper_numbers.html", "the paper's numbers beside ours"),
    ("notebooks", "executed notebooks"),
    ("docs", "equation and symbol tables"),
)


EXAMPLE = """Example:
  spotcheck where out/my-frames
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("results", type=Path, help="results folder of a dataset")


def run(args: argparse.Namespace) -> None:
    """List what is there to look at. Raises `InputError` where there is nothing."""
    if not any((args.results / name).exists() for name, _ in PLACES):
        raise InputError(f"{args.results}: holds no results to look at; name those of a dataset, such as results/mine")
    print("\nWhere to look:")
    for name, text in PLACES:
        if (args.results / name).exists():
            print(f"  {args.results / name!s:45} {text}")
