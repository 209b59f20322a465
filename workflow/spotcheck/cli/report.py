"""`spotcheck report`: report.html."""

import argparse
from pathlib import Path

from spotcheck import dataset
from spotcheck.pages import report


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("--dataset", required=True, help="dataset folder")
    parser.add_argument("--results", required=True, type=Path, help="results folder of the dataset")
    parser.add_argument("--output", required=True, type=Path, help="page to write")


def run(args: argparse.Namespace) -> None:
    """Write the page."""
    report.write(dataset.load(args.dataset), args.results, args.output)
    print(f"{args.output}: {args.output.stat().st_size / 1e6:.1f} MB")
