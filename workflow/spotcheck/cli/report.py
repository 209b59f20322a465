"""`spotcheck report`: report.html."""

import argparse
import json
from pathlib import Path

from spotcheck.cli import vocabulary
from spotcheck.dataset import folder as dataset
from spotcheck.report.dataset_page.report import write_report

EXAMPLE = """Example:
  spotcheck report --dataset my-frames --results out/my-frames --output out/my-frames/report.html
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("--dataset", required=True, help="dataset folder")
    parser.add_argument("--results", required=True, type=Path, help="results folder of the dataset")
    parser.add_argument("--output", required=True, type=Path, help="page to write")
    vocabulary.arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Write the page."""
    vocabulary.choose(args)
    verdict = args.results / "verdict.json"
    if verdict.exists():
        vocabulary.same(json.loads(verdict.read_text(encoding="utf-8")), str(verdict))
    write_report(dataset.load(args.dataset), args.results, args.output)
    print(f"{args.output}: {args.output.stat().st_size / 1e6:.1f} MB")
