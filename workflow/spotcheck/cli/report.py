"""`spotcheck report`: report.html."""

import argparse
import json
from pathlib import Path

from spotcheck.cli import effect_options
from spotcheck.dataset import folder
from spotcheck.report.dataset_page.report import write_report

EXAMPLES = "spotcheck report --dataset my-frames --results out/my-frames --output out/my-frames/report.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser, also --effects, --only and --without (`effect_options`)."""
    parser.add_argument("--dataset", required=True, help="dataset folder")
    parser.add_argument("--results", required=True, type=Path, help="results folder of the dataset")
    parser.add_argument("--output", required=True, type=Path, help="page to write")
    effect_options.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Write the page."""
    effect_options.apply_options(args)
    verdict = args.results / "verdict.json"
    if verdict.exists():
        effect_options.check_same(json.loads(verdict.read_text(encoding="utf-8")), str(verdict))
    write_report(folder.load(args.dataset), args.results, args.output)
    print(f"{args.output}: {args.output.stat().st_size / 1e6:.1f} MB")
