"""`spotcheck report`: report.html."""

import argparse
import json
from pathlib import Path

from spotcheck.cli import vocabulary
from spotcheck.dataset import folder
from spotcheck.report.dataset_page.report import write_report

EXAMPLES = "spotcheck report --dataset my-frames --results out/my-frames --output out/my-frames/report.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("--dataset", required=True, help="dataset folder")
    parser.add_argument("--results", required=True, type=Path, help="results folder of the dataset")
    parser.add_argument("--output", required=True, type=Path, help="page to write")
    vocabulary.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Write the page."""
    vocabulary.apply_options(args)
    verdict = args.results / "verdict.json"
    if verdict.exists():
        vocabulary.check_same(json.loads(verdict.read_text(encoding="utf-8")), str(verdict))
    write_report(folder.load(args.dataset), args.results, args.output)
    print(f"{args.output}: {args.output.stat().st_size / 1e6:.1f} MB")
