"""`spotcheck ingest`: frames.nc."""

import argparse
from pathlib import Path

from spotcheck.crops.ingest import ingest_frames
from spotcheck.dataset import file_cache
from spotcheck.dataset import folder as dataset
from spotcheck.io import provenance, store

EXAMPLE = """Example:
  spotcheck ingest my-frames --output out/my-frames/frames.nc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--output", required=True, help="frames.nc to write")


def run(args: argparse.Namespace) -> None:
    """Check the dataset, decode every frame once, record what it is."""
    found = dataset.load(args.dataset)
    table = ingest_frames(found, file_cache.read_cache(file_cache.get_cache_path(Path(args.output).parent)))
    inputs = [found.folder / "manifest.csv", *found.instrument_files]
    store.write(table, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    print(f"{found.name}: {table.sizes['frame']} frames recorded")
    for remark in store.remarks_of(table):
        print(remark)
