"""`spotcheck adopt`: what results say of the instrument, as an instrument file."""

import argparse
from pathlib import Path

from spotcheck.cli import vocabulary
from spotcheck.dataset import folder as dataset
from spotcheck.errors import InputError
from spotcheck.export.instrument_file import format_table, write_instrument_file
from spotcheck.export.learned_values import collect_learned_values
from spotcheck.export.value_choice import choose_values
from spotcheck.io import store


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.add_argument("results", type=Path, help="results folder of a dataset, such as results/my-frames")
    parser.add_argument(
        "--to", type=Path, help="instrument file to write, which must be new; without it only the table"
    )
    vocabulary.arguments(parser)
    parser.epilog = "Example:\n  spotcheck adopt out/my-frames --to camera.yaml\n"


def run(args: argparse.Namespace) -> None:
    """Print what was learned of each key and what of it is taken, and write the file."""
    vocabulary.choose(args)
    folder = store.read_owner(args.results) if args.results.is_dir() else ""
    if not folder:
        raise InputError(f"{args.results}: holds no results of a dataset; name its folder, such as results/my-frames")
    given = dataset.load(folder).instrument
    learned, unused = collect_learned_values(args.results, given)
    if not learned and not unused:
        raise InputError(f"{args.results}: says nothing of the instrument; run the workflow on {folder} to its end")
    choices = choose_values(learned, given)
    print(format_table(choices, unused))
    if not (args.results / "verdict.json").is_file():
        print("there is no verdict yet, so that effects and the light's shape are not among these")
    if args.to is None:
        print("nothing is written: name a new instrument file with --to")
        return
    write_instrument_file(args.to, choices, unused, given, args.results)
    print(f"wrote {args.to}; a dataset uses it by `based_on:` and its path in instrument.yaml")
