"""`spotcheck check`: the contract, without decoding a pixel."""

import argparse
import shlex
from importlib.util import find_spec

from spotcheck.crops.ingest import check_dataset
from spotcheck.dataset import folder as dataset
from spotcheck.dataset.manifest import KINDS
from spotcheck.dataset.plausibility import list_unusual_values
from spotcheck.io import configuration
from spotcheck.model.baseline import of_instrument

EXAMPLE = """Example:
  spotcheck check my-frames
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")


def run(args: argparse.Namespace) -> None:
    """Say how many frames of which kind there are and what is odd about their numbers, or raise `InputError`."""
    found = dataset.load(args.dataset)
    probe = check_dataset(found)
    of_instrument(found.instrument, found.exposures)
    kinds = ", ".join(f"{sum(f.kind == kind for f in found.frames)} {kind}" for kind in KINDS)
    print(f"{found.name}: {kinds} frames of {probe.shape[1]} × {probe.shape[0]} px, {probe.bits} bit: in order")
    for remark in (*probe.remarks, *list_unusual_values(found), configuration.remark_on_quotes(args.dataset)):
        if remark:
            print(remark)
    named = shlex.quote(str(found.folder.resolve()))
    print(f"next, in the repository's folder: snakemake --cores 2 --config dataset={named} results=out")
    if find_spec("snakemake") is None:
        print("That needs Snakemake, which is not installed here: pip install '.[workflow]' in the repository's folder")
