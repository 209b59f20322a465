"""`spotcheck effects`: writes the documentation page of the effects that a verdict can name.

Examples
--------
spotcheck effects --output effects.md
"""

import argparse
from pathlib import Path

from spotcheck.cli import effect_options
from spotcheck.report.pages import effects


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser, also --effects, --only and --without (`effect_options`)."""
    parser.add_argument("--output", required=True, type=Path, help="effects.md to write")
    effect_options.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Write the page from the effects' own files, and print their number."""
    effect_options.apply_options(args)
    print(f"{args.output}: {effects.write_effects_page(args.output)} effects")
