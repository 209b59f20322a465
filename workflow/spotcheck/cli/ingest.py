"""`spotcheck ingest`: frames.nc."""

import argparse
from pathlib import Path

from spotcheck.crops import stages
from spotcheck.dataset import folder, ingested
from spotcheck.io import provenance, store

EXAMPLES = "spotcheck ingest my-frames --output out/my-frames/frames.nc"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--output", required=True, help="frames.nc to write")


def run(args: argparse.Namespace) -> None:
    """Check the dataset, decode every frame once and record its properties."""
    dataset = folder.load(args.dataset)
    table = stages.ingest(dataset, ingested.recall(ingested.memory_of(Path(args.output).parent)))
    inputs = [dataset.folder / "manifest.csv", *dataset.sheets]
    store.write(table, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    print(f"{dataset.name}: {table.sizes['frame']} frames recorded")
    for remark in store.remarks_of(table):
        print(remark)
