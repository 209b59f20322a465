"""`spotcheck ingest`: writes frames.nc, the table of digest (SHA-256), shape and extreme readings of every frame.

Examples
--------
spotcheck ingest my-frames --output out/my-frames/frames.nc
"""

import argparse
from pathlib import Path

from spotcheck.crops.ingest import ingest_frames
from spotcheck.dataset import file_cache, folder
from spotcheck.io import provenance, store


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--output", required=True, help="frames.nc to write")


def run(args: argparse.Namespace) -> None:
    """Check the dataset, decode every frame once, write its properties, and print the number of frames and remarks."""
    dataset = folder.load(args.dataset)
    # Digests of an earlier run are reused for files that have not changed.
    frame_table = ingest_frames(dataset, file_cache.read_cache(file_cache.get_cache_path(Path(args.output).parent)))
    inputs = [dataset.folder / "manifest.csv", *dataset.instrument_files]
    store.write(frame_table, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    print(f"{dataset.name}: {frame_table.sizes['frame']} frames recorded")
    for remark in store.remarks_of(frame_table):
        print(remark)
