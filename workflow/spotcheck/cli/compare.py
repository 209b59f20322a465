"""`spotcheck compare`: writes comparison.html and comparison.nc, the differences of datasets from the first.

Examples
--------
spotcheck compare out/my-frames out/my-flats --page comparison.html --output comparison.nc
"""

import argparse
from pathlib import Path

from spotcheck.io import provenance, store
from spotcheck.report.comparison.datasets import list_sources
from spotcheck.report.comparison.netcdf import build_dataset
from spotcheck.report.comparison.table import compare_datasets
from spotcheck.report.pages.comparison import write_comparison_page


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("results", nargs="+", type=Path, help="two results folders or more, the reference first")
    parser.add_argument("--page", required=True, type=Path, help="page to write")
    parser.add_argument("--output", required=True, type=Path, help="comparison.nc to write")


def run(args: argparse.Namespace) -> None:
    """Write page and numbers of the comparison, and print how many quantities changed beyond their errors.

    A row of the comparison is a quantity; its `is_changed` [dataset] is True for significant differences from the
    first dataset.
    """
    comparison = compare_datasets(args.results)
    code = provenance.code_digest(__name__)
    store.write(build_dataset(comparison), args.output, code=code, inputs=list_sources(args.results))
    write_comparison_page(comparison, args.page, code)
    changed = sum(any(row.is_changed) for row in comparison.rows)
    print(f"{args.page}: {changed} of {len(comparison.rows)} quantities changed beyond their errors")
