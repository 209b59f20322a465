"""`spotcheck crop`: writes crops.nc, a square image around the spot of each frame.

Examples
--------
spotcheck crop my-frames --frames out/my-frames/frames.nc --output out/my-frames/crops.nc
"""

import argparse
from pathlib import Path

from spotcheck.crops.cropping import crop_spots
from spotcheck.dataset import folder
from spotcheck.io import provenance, store


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    parser.add_argument("--output", required=True, help="crops.nc to write")


def run(args: argparse.Namespace) -> None:
    """Crop every spot, frame by frame, and print the side of the crops [px] and remarks."""
    dataset = folder.load(args.dataset)
    with store.read(args.frames) as frame_table:
        crop_spots(dataset, frame_table, Path(args.output), code=provenance.code_digest(__name__), inputs=[args.frames])
    print(f"{dataset.name}: {len(dataset.spots)} spots cropped to {dataset.instrument.crop_px} px")
    with store.read(args.output) as crops:
        for remark in store.remarks_of(crops):
            print(remark)
