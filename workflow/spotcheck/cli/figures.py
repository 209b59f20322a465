"""`spotcheck figures`: draws every figure of the results as SVG and PNG, and writes index.json, the list of them.

Examples
--------
spotcheck figures --dataset my-frames --results out/my-frames --output out/my-frames/figures
"""

import argparse
from pathlib import Path

from spotcheck.report.figures.results import Results
from spotcheck.report.figures.write import write_all


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("--results", required=True, help="folder of the results of one dataset")
    parser.add_argument("--dataset", required=True, help="dataset folder")
    parser.add_argument("--output", required=True, help="folder to write the figures to")


def run(args: argparse.Namespace) -> None:
    """Draw the figures that the results support, and print their number and why others were skipped."""
    with Results(args.results, args.dataset) as results:
        index = write_all(results, Path(args.output))
    for record in index["skipped"]:
        print(f"skipped {record['name']}: {record['why']}")
    print(f"{len(index['figures'])} figures drawn")
