"""`spotcheck where`: lists where the results of a dataset are.

Examples
--------
spotcheck where out/my-frames
"""

import argparse
from pathlib import Path

from spotcheck.errors import InputError

# (name in the results folder, what it contains), in the order of the list.
RESULTS = (
    ("report.html", "everything on one page"),
    ("figures", "every figure as SVG and PNG"),
    ("paper_numbers.html", "the paper's numbers beside ours"),
    ("notebooks", "executed notebooks"),
    ("docs", "equation and symbol tables"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("results", type=Path, help="results folder of a dataset")


def run(args: argparse.Namespace) -> None:
    """Print the paths of the results that a person can open. Raises `InputError` if there are none."""
    present = [(args.results / name, text) for name, text in RESULTS if (args.results / name).exists()]
    if not present:
        raise InputError(f"{args.results}: holds no results to look at; name those of a dataset, such as results/mine")
    print("\nWhere to look:")
    for path, text in present:
        print(f"  {path!s:45} {text}")
