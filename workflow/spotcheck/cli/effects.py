"""`spotcheck effects`: the page of effects."""

import argparse
from pathlib import Path

from spotcheck.cli import vocabulary
from spotcheck.report.pages import effects

EXAMPLES = "spotcheck effects --output effects.md"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("--output", required=True, type=Path, help="effects.md to write")
    vocabulary.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Write the page from the effects' own files."""
    vocabulary.apply_options(args)
    print(f"{args.output}: {effects.write_effects_page(args.output)} effects")
