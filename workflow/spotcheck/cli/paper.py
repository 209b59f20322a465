"""`spotcheck paper`: compares the numbers of the paper with the results, and writes paper_numbers.csv and a page.

A number holds if the result is within the tolerance of the number.

Examples
--------
spotcheck paper data/published.yaml --seeds data/published_seeds.csv \\
    --dataset data/virtual-rig --results results/virtual-rig --table numbers.csv \\
    --page numbers.html --summary numbers.md
"""

import argparse
import sys
from pathlib import Path

from spotcheck.dataset import folder
from spotcheck.io import provenance, store
from spotcheck.io.schema import read_yaml
from spotcheck.paper import number_checks
from spotcheck.paper.results import Results
from spotcheck.report.pages.numbers import write_numbers_page


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("numbers", type=Path, help="published.yaml")
    parser.add_argument("--seeds", required=True, type=Path, help="published_seeds.csv: counts with other seeds")
    parser.add_argument("--dataset", required=True, help="dataset folder")
    parser.add_argument("--results", required=True, type=Path, help="results folder of the dataset")
    parser.add_argument("--table", required=True, help="paper_numbers.csv to write")
    parser.add_argument("--page", required=True, type=Path, help="paper_numbers.html to write")
    parser.add_argument("--summary", required=True, help="Markdown to write: how many hold, and which do not")
    parser.add_argument("--strict", action="store_true", help="fail when a number that held no longer does")


def run(args: argparse.Namespace) -> None:
    """Check every number, write table, page and summary, and print how many numbers hold.

    Numbers that are declared to hold but are outside their tolerance (`low` to `high`) are printed. With --strict they
    end the process with status 1.
    """
    with Results(folder.load(args.dataset), args.results) as results:
        checks = number_checks.check_numbers(read_yaml(args.numbers), results)
    # `opened` has the paths of the results that the checks have read.
    inputs = [args.numbers, args.seeds, results.dataset.folder / "instrument.yaml", *sorted(results.opened)]
    store.write_text(args.table, number_checks.format_csv(checks), code=provenance.code_digest(__name__), inputs=inputs)
    write_numbers_page(args.page, checks)
    store.write_text(args.summary, number_checks.summarise_checks(checks, number_checks.read_other_seeds(args.seeds)))
    # Group of numbers → how many hold, and how many there are.
    for group, (count, total) in number_checks.count_met(checks).items():
        print(f"{group.replace('_', ' ')}: {count} of {total} hold")
    regressions = number_checks.find_regressions(checks)
    for check in regressions:
        print(f"left its tolerance: {check.entry['id']} is {check.value:.6g}, not {check.low:.6g} … {check.high:.6g}")
    if regressions and args.strict:
        sys.exit(1)
