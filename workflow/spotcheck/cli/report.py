"""`spotcheck report`: writes report.html, one self-contained page of figures, tables and skipped parts.

Examples
--------
spotcheck report --dataset my-frames --results out/my-frames --output out/my-frames/report.html
"""

import argparse
import json
from pathlib import Path

from spotcheck.cli import effect_options
from spotcheck.dataset import folder
from spotcheck.report.dataset_page.report import write_report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser, also --effects, --only and --without (`effect_options`)."""
    parser.add_argument("--dataset", required=True, help="dataset folder")
    parser.add_argument("--results", required=True, type=Path, help="results folder of the dataset")
    parser.add_argument("--output", required=True, type=Path, help="page to write")
    effect_options.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Write the page, and print its size [MB].

    Raises `InputError` if the verdict was found with other effects than those of the options.
    """
    effect_options.apply_options(args)
    verdict_path = args.results / "verdict.json"
    if verdict_path.exists():
        effect_options.check_same_vocabulary(json.loads(verdict_path.read_text(encoding="utf-8")), str(verdict_path))
    write_report(folder.load(args.dataset), args.results, args.output)
    print(f"{args.output}: {args.output.stat().st_size / 1e6:.1f} MB")
