"""`spotcheck check`: the contract, without decoding a pixel."""

import argparse
import shlex
from importlib.util import find_spec

from spotcheck.crops.ingest import check_dataset
from spotcheck.dataset import folder
from spotcheck.dataset.manifest import KINDS
from spotcheck.dataset.plausibility import list_unusual_values
from spotcheck.io import configuration
from spotcheck.model.baseline import of_instrument

EXAMPLES = "spotcheck check my-frames"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")


def run(args: argparse.Namespace) -> None:
    """Print the number of frames of each kind and remarks on implausible values. Raises `InputError` for breaches."""
    dataset = folder.load(args.dataset)
    probe = check_dataset(dataset)
    of_instrument(dataset.instrument, dataset.exposures)
    kinds = ", ".join(f"{sum(frame.kind == kind for frame in dataset.frames)} {kind}" for kind in KINDS)
    print(f"{dataset.name}: {kinds} frames of {probe.shape[1]} × {probe.shape[0]} px, {probe.bits} bit: in order")
    for remark in (*probe.remarks, *list_unusual_values(dataset), configuration.remark_on_quotes(args.dataset)):
        if remark:
            print(remark)
    path = shlex.quote(str(dataset.folder.resolve()))
    print(f"next, in the repository's folder: snakemake --cores 2 --config dataset={path} results=out")
    if find_spec("snakemake") is None:
        print("That needs Snakemake, which is not installed here: pip install '.[workflow]' in the repository's folder")
