"""`spotcheck crop`: crops.nc."""

import argparse
from pathlib import Path

from spotcheck.crops.cropping import crop_spots
from spotcheck.dataset import folder as dataset
from spotcheck.io import provenance, store

EXAMPLE = """Example:
  spotcheck crop my-frames --frames out/my-frames/frames.nc --output out/my-frames/crops.nc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    parser.add_argument("--output", required=True, help="crops.nc to write")


def run(args: argparse.Namespace) -> None:
    """Crop frame by frame."""
    found = dataset.load(args.dataset)
    with store.read(args.frames) as table:
        crop_spots(found, table, Path(args.output), code=provenance.code_digest(__name__), inputs=[args.frames])
    print(f"{found.name}: {len(found.spots)} spots cropped to {found.instrument.crop_px} px")
    with store.read(args.output) as written:
        for remark in store.remarks_of(written):
            print(remark)
