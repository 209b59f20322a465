"""`spotcheck effects`: the page of effects."""

import argparse
from pathlib import Path

from spotcheck.cli import vocabulary
from spotcheck.report.pages import effects

EXAMPLE = """Example:
  spotcheck effects --output effects.md
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("--output", required=True, type=Path, help="effects.md to write")
    vocabulary.arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Write the page from the effects' own files."""
    vocabulary.choose(args)
    print(f"{args.output}: {effects.write_effects_page(args.output)} effects")
