"""`spotcheck adopt`: writes the results about the instrument, such as a measured gain, into an instrument file.

A choice is the decision whether a learned value replaces that of the data sheet, the dataset's own instrument.yaml. An
unused result is one that no key of an instrument file can hold.

Examples
--------
spotcheck adopt out/my-frames --to camera.yaml
"""

import argparse
import shutil
from pathlib import Path

from spotcheck.cli import effect_options
from spotcheck.dataset.folder import load
from spotcheck.errors import InputError
from spotcheck.export.instrument_file import format_table, write_instrument_file
from spotcheck.export.learned_values import collect_learned_values
from spotcheck.export.value_choice import choose_values
from spotcheck.io import store


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser, also --effects, --only and --without (`effect_options`)."""
    parser.add_argument("results", type=Path, help="results folder of a dataset, such as results/my-frames")
    parser.add_argument("--to", type=Path, help="new instrument file to write; without it only the table is printed")
    effect_options.add_options(parser)


def run(args: argparse.Namespace) -> None:
    """Print what the results say about each key of the instrument, and write the chosen values to the file of --to.

    Raises `InputError` if the folder has no results of a dataset, or none about the instrument.
    """
    effect_options.apply_options(args)
    # Path of the dataset folder whose results these are, "" if the folder has no results.
    folder = store.read_owner(args.results) if args.results.is_dir() else ""
    if not folder:
        raise InputError(f"{args.results}: holds no results of a dataset; name its folder, such as results/my-frames")
    instrument = load(folder).instrument
    learned_values, unused_results = collect_learned_values(args.results, instrument)
    if not learned_values and not unused_results:
        raise InputError(f"{args.results}: says nothing about the instrument; run the workflow on {folder} to its end")
    choices = choose_values(learned_values, instrument)
    print(format_table(choices, unused_results, shutil.get_terminal_size((120, 24)).columns))
    if not (args.results / "verdict.json").is_file():
        print("there is no verdict yet, so effects and the shape of the light are missing here")
    if args.to is None:
        print("nothing is written: name a new instrument file with --to")
        return
    write_instrument_file(args.to, choices, unused_results, instrument, args.results)
    print(f"wrote {args.to}; a dataset uses it by `based_on:` and its path in instrument.yaml")
