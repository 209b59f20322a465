"""`spotcheck equations`: tables of equations and symbols."""

import argparse
from pathlib import Path

from spotcheck.report.pages import equations

EXAMPLE = """Example:
  spotcheck equations --symbols data/symbols.yaml --tests tests --output docs
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("--symbols", required=True, type=Path, help="symbols.yaml")
    parser.add_argument("--tests", required=True, type=Path, help="folder of the tests")
    parser.add_argument("--output", required=True, type=Path, help="folder for equations.html and symbols.html")


def run(args: argparse.Namespace) -> None:
    """Write both tables; fail when an equation has no function or no test."""
    equations.write_equation_pages(args.symbols, args.tests, args.output)
    print(f"{len(equations.EQUATIONS)} equations, each with a function and a test")
