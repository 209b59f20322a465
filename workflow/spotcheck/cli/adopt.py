"""`spotcheck adopt`: results about the instrument, as an instrument file."""

import argparse
from pathlib import Path

from spotcheck.cli import vocabulary
from spotcheck.dataset.folder import load
from spotcheck.errors import InputError
from spotcheck.export.adoption import written
from spotcheck.export.adoption.chosen import choices_of
from spotcheck.export.adoption.learned import learned_of
from spotcheck.io import store

EXAMPLES = "spotcheck adopt out/my-frames --to camera.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("results", type=Path, help="results folder of a dataset, such as results/my-frames")
    parser.add_argument(
        "--to", type=Path, help="instrument file to write, which must be new; without it only the table"
    )
    vocabulary.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Print the results for each key and the value to adopt, and write the file."""
    vocabulary.apply_options(args)
    dataset = store.owner_of(args.results) if args.results.is_dir() else ""
    if not dataset:
        raise InputError(f"{args.results}: holds no results of a dataset; name its folder, such as results/my-frames")
    instrument = load(dataset).instrument
    learned, left = learned_of(args.results, instrument)
    if not learned and not left:
        raise InputError(f"{args.results}: says nothing about the instrument; run the workflow on {dataset} to its end")
    choices = choices_of(learned, instrument)
    print(written.table(choices, left))
    if not (args.results / "verdict.json").is_file():
        print("there is no verdict yet, so effects and the shape of the light are missing here")
    if args.to is None:
        print("nothing is written: name a new instrument file with --to")
        return
    written.write(args.to, choices, left, instrument, args.results)
    print(f"wrote {args.to}; a dataset uses it by `based_on:` and its path in instrument.yaml")
