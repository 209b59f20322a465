"""`spotcheck compare`: comparison.html and comparison.nc."""

import argparse
from pathlib import Path

from spotcheck.io import provenance, store
from spotcheck.report.comparison.sets import sources_of
from spotcheck.report.comparison.table import compare
from spotcheck.report.comparison.written import dataset_of
from spotcheck.report.pages.comparison import write_comparison_page

EXAMPLE = """Example:
  spotcheck compare out/my-frames out/my-flats --page comparison.html --output comparison.nc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument(
        "results", nargs="+", type=Path, help="results folders of two datasets or more, the first is the reference"
    )
    parser.add_argument("--page", required=True, type=Path, help="page to write")
    parser.add_argument("--output", required=True, type=Path, help="comparison.nc to write")


def run(args: argparse.Namespace) -> None:
    """Set the datasets side by side, and write the page and the numbers."""
    found = compare(args.results)
    code = provenance.code_digest(__name__)
    store.write(dataset_of(found), args.output, code=code, inputs=sources_of(args.results))
    write_comparison_page(found, args.page, code)
    changed = sum(any(row.changed) for row in found.rows)
    print(f"{args.page}: {changed} of {len(found.rows)} quantities changed beyond their errors")
