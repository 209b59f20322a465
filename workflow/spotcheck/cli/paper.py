"""`spotcheck paper`: paper_numbers.csv and its page."""

import argparse
import sys
from pathlib import Path

from spotcheck.dataset import folder as dataset
from spotcheck.io import provenance, store
from spotcheck.paper import verdicts
from spotcheck.paper.results import Results
from spotcheck.report.pages.numbers import write_numbers_page

EXAMPLE = """Example:
  spotcheck paper data/paper_numbers.yaml --dataset data/virtual-rig --results results/virtual-rig \\
      --table numbers.csv --page numbers.html --summary numbers.md
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("numbers", type=Path, help="paper_numbers.yaml")
    parser.add_argument("--dataset", required=True, help="dataset folder")
    parser.add_argument("--results", required=True, type=Path, help="results folder of the dataset")
    parser.add_argument("--table", required=True, help="paper_numbers.csv to write")
    parser.add_argument("--page", required=True, type=Path, help="paper_numbers.html to write")
    parser.add_argument("--summary", required=True, help="Markdown to write: how many hold, and which do not")
    parser.add_argument("--strict", action="store_true", help="fail when a number that held no longer does")


def run(args: argparse.Namespace) -> None:
    """Judge every number; with --strict, end with status 1 when one left its tolerance."""
    results = Results(dataset.load(args.dataset), args.results)
    found = verdicts.judge(verdicts.read_numbers(args.numbers), results)
    inputs = [args.numbers, results.dataset.folder / "instrument.yaml", *sorted(results.opened)]
    store.write_text(args.table, verdicts.table(found), code=provenance.code_digest(__name__), inputs=inputs)
    write_numbers_page(args.page, found)
    store.write_text(args.summary, verdicts.summary(found))
    for kind, (held, counted) in verdicts.shares(found).items():
        print(f"{kind}: {held} of {counted} hold")
    lost = verdicts.lost(found)
    for verdict in lost:
        print(
            f"left its tolerance: {verdict.entry['id']} is {verdict.ours:.6g},"
            f" not {verdict.low:.6g} … {verdict.high:.6g}"
        )
    if lost and args.strict:
        sys.exit(1)
