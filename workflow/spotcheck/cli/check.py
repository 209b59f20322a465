"""`spotcheck check`: checks that a dataset folder keeps the dataset contract, without decoding a pixel.

The contract is the required form of manifest.csv, instrument.yaml and the frames.
"""

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
    """Print the number of frames of each kind, remarks on implausible values, and the command to run next.

    Raises `InputError` for a breach of the contract.
    """
    dataset = folder.load(args.dataset)
    frame_format = check_dataset(dataset)
    # Raises `InputError` for a profile of the light that cannot be read.
    of_instrument(dataset.instrument, dataset.exposures)
    kinds = ", ".join(f"{sum(frame.kind == kind for frame in dataset.frames)} {kind}" for kind in KINDS)
    rows, columns = frame_format.shape
    print(f"{dataset.name}: {kinds} frames of {columns} × {rows} px, {frame_format.bits} bit: in order")
    remarks = (*frame_format.remarks, *list_unusual_values(dataset), configuration.remark_on_quotes(args.dataset))
    for remark in filter(None, remarks):
        print(remark)
    path = shlex.quote(str(dataset.folder.resolve()))
    print(f"next, in the repository's folder: snakemake --cores 2 --config dataset={path} results=out")
    if find_spec("snakemake") is None:
        print("That needs Snakemake, which is not installed here: pip install '.[workflow]' in the repository's folder")
