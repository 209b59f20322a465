"""`spotcheck equations`: writes tables of the equations and symbols in the docstrings of the code.

Examples
--------
spotcheck equations --symbols data/symbols.yaml --tests tests --output docs
"""

import argparse
from pathlib import Path

from spotcheck.report.pages import equations


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("--symbols", required=True, type=Path, help="symbols.yaml")
    parser.add_argument("--tests", required=True, type=Path, help="folder of the tests")
    parser.add_argument("--output", required=True, type=Path, help="folder for equations.html and symbols.html")


def run(args: argparse.Namespace) -> None:
    """Write both tables. Fails if an equation has no function or no test."""
    equations.write_equation_pages(args.symbols, args.tests, args.output)
    print(f"{len(equations.EQUATIONS)} equations, each with a function and a test")
