"""`spotcheck check`: checks that a dataset folder keeps the dataset contract.

The contract is the required form of manifest.csv, instrument.yaml and the frames. Of these, a sample is decoded.

Examples
--------
spotcheck check my-frames
"""

import argparse
import shlex
from importlib.util import find_spec

from spotcheck.crops.ingest import check_dataset, check_readings
from spotcheck.dataset import folder
from spotcheck.dataset.manifest import KINDS
from spotcheck.dataset.plausibility import list_unusual_values
from spotcheck.fitting.calibration import explain_missing_law, explain_missing_sites
from spotcheck.fitting.scan_caustic import explain_missing_caustic
from spotcheck.io import configuration
from spotcheck.model import baseline


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")


def run(args: argparse.Namespace) -> None:
    """Print the number of frames of each kind, remarks, what a run will skip, and the command to run next.

    The remarks concern the format of the frames, implausible values, and a path that needs quotes in config.yaml.
    Raises `InputError` for a breach of the contract.
    """
    dataset = folder.load(args.dataset)
    frame_format = check_dataset(dataset)
    # Called for its check only: it raises `InputError` if the file that instrument.yaml names as `light.profile`, the
    # shape of the light, cannot be read.
    baseline.build_baseline(dataset.instrument, dataset.exposures)
    check_readings(dataset)
    kinds = ", ".join(f"{sum(frame.kind == kind for frame in dataset.frames)} {kind}" for kind in KINDS)
    rows, columns = frame_format.shape
    print(f"{dataset.name}: {kinds} frames of {columns} × {rows} px, {frame_format.bits} bit: in order")
    # `remark_on_quotes` returns None for a path without need of quotes.
    remarks = (*frame_format.remarks, *list_unusual_values(dataset), configuration.remark_on_quotes(args.dataset))
    for remark in filter(None, remarks):
        print(remark)
    if dataset.spots:
        reasons = (
            explain_missing_law(dataset.instrument, dataset.exposures) or explain_missing_sites(dataset),
            explain_missing_caustic(dataset.instrument),
        )
        for reason in filter(None, reasons):
            print(f"will be skipped: {reason}")
    path = shlex.quote(str(dataset.folder.resolve()))
    print(f"next, in the repository's folder: snakemake --cores 2 --config dataset={path} results=out")
    if find_spec("snakemake") is None:
        print("That needs Snakemake, which is not installed here: pip install '.[workflow]' in the repository's folder")
