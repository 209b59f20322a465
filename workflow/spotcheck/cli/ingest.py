"""`spotcheck ingest`: frames.nc."""

import argparse
from pathlib import Path

from spotcheck.crops.ingest import ingest_frames
from spotcheck.dataset import file_cache, folder
from spotcheck.io import provenance, store

EXAMPLES = "spotcheck ingest my-frames --output out/my-frames/frames.nc"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--output", required=True, help="frames.nc to write")


def run(args: argparse.Namespace) -> None:
    """Check the dataset, decode every frame once and record its properties."""
    dataset = folder.load(args.dataset)
    table = ingest_frames(dataset, file_cache.read_cache(file_cache.get_cache_path(Path(args.output).parent)))
    inputs = [dataset.folder / "manifest.csv", *dataset.instrument_files]
    store.write(table, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    print(f"{dataset.name}: {table.sizes['frame']} frames recorded")
    for remark in store.remarks_of(table):
        print(remark)
