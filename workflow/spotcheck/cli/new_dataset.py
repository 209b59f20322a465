"""`spotcheck new-dataset`: a commented manifest and instrument file to fill in."""

import argparse
from pathlib import Path

from spotcheck import configuration, template

EXAMPLE = """Example:
  spotcheck new-dataset new-frames
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("folder", type=Path, help="folder to make; images already in its frames/ are listed")


def run(args: argparse.Namespace) -> None:
    """Write both files; nothing that is there is overwritten."""
    written = template.write(args.folder)
    if others := template.others(args.folder):
        print(f"{args.folder}: files of {', '.join(others)} are not listed; frames must be TIFF, PNG or PGM")
    print(f"{args.folder}: wrote {', '.join(written)}; fill in the blanks, then: spotcheck check {args.folder}")
    if remark := configuration.remark_on(str(args.folder)):
        print(remark)
