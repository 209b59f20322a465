"""`spotcheck paper`: paper_numbers.csv and its page."""

import argparse
import sys
from pathlib import Path

from spotcheck.dataset import folder
from spotcheck.io import provenance, store
from spotcheck.paper import verdicts
from spotcheck.paper.results import Results
from spotcheck.report.pages import numbers

EXAMPLES = """spotcheck paper data/paper_numbers.yaml --dataset data/virtual-rig --results results/virtual-rig \\
    --table numbers.csv --page numbers.html --summary numbers.md"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("numbers", type=Path, help="paper_numbers.yaml")
    parser.add_argument("--dataset", required=True, help="dataset folder")
    parser.add_argument("--results", required=True, type=Path, help="results folder of the dataset")
    parser.add_argument("--table", required=True, help="paper_numbers.csv to write")
    parser.add_argument("--page", required=True, type=Path, help="paper_numbers.html to write")
    parser.add_argument("--summary", required=True, help="Markdown to write: how many hold, and which do not")
    parser.add_argument("--strict", action="store_true", help="fail when a number that held no longer does")


def run(args: argparse.Namespace) -> None:
    """Judge every number; with --strict, end with status 1 when one left its tolerance."""
    results = Results(folder.load(args.dataset), args.results)
    judged = verdicts.judge(verdicts.read_numbers(args.numbers), results)
    inputs = [args.numbers, results.dataset.folder / "instrument.yaml", *sorted(results.opened)]
    store.write_text(args.table, verdicts.table(judged), code=provenance.code_digest(__name__), inputs=inputs)
    numbers.write(args.page, judged)
    store.write_text(args.summary, verdicts.summary(judged))
    for kind, (number_held, number) in verdicts.shares(judged).items():
        print(f"{kind}: {number_held} of {number} hold")
    lost = verdicts.lost(judged)
    for verdict in lost:
        print(
            f"left its tolerance: {verdict.entry['id']} is {verdict.ours:.6g},"
            f" not {verdict.low:.6g} … {verdict.high:.6g}"
        )
    if lost and args.strict:
        sys.exit(1)
