"""`spotcheck sensor`: sensor.nc."""

import argparse

from spotcheck.characterization import sensor_choice as sensor
from spotcheck.characterization.dark_frames import select_dark_levels
from spotcheck.characterization.frame_pairs import iterate_pairs
from spotcheck.characterization.transfer_data import read_quantities
from spotcheck.crops import stages as crops
from spotcheck.dataset import folder as dataset
from spotcheck.dataset import frames
from spotcheck.dataset import ingested as seen
from spotcheck.io import provenance, store

EXAMPLE = """Example:
  spotcheck sensor my-frames --crops out/my-frames/crops.nc --frames out/my-frames/frames.nc \\
      --output out/my-frames/sensor.nc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("dataset", help="dataset folder")
    parser.add_argument("--crops", required=True, help="crops.nc of the dataset")
    parser.add_argument("--frames", required=True, help="frames.nc of the dataset")
    parser.add_argument("--transfer", nargs="*", default=[], help="transfer.nc, where the dataset has flats or darks")
    parser.add_argument("--output", required=True, help="sensor.nc to write")


def run(args: argparse.Namespace) -> None:
    """Settle every sensor quantity and say where each comes from."""
    found = dataset.load(args.dataset)
    with store.read(args.crops) as images, store.read(args.frames) as table, seen.as_ingested(found, table):
        own = images.sel(centring="light")
        usable = (
            own["image"].isel(index).values
            for index in crops.cells(own, store.grid_dims(images))
            if crops.usable(own["status"].isel(index))
        )
        darks = (frames.reduce_frame(frames.read_good(found, own)) for own in found.frames if own.kind == "dark")
        beside = (
            frames.Surround(*(images[name].isel(index).values for name in frames.Surround._fields))
            for index in crops.cells(images, store.grid_dims(images))
        )
        dark = select_dark_levels(darks, beside, float(table["full_scale"]))
        measured = {}
        for path in args.transfer:
            with store.read(path) as transfer:
                measured = read_quantities(transfer)
        pairs = {"exposures of a site": iterate_pairs(own, "exposure"), "repeats": iterate_pairs(own, "repeat")}
        highest = float(table["maximum"].max())
        settled = sensor.choose_sensor_values(found, crops.end_in(table), usable, dark, measured, pairs, highest)
    inputs = [args.crops, args.frames, *args.transfer, *found.sheets]
    store.write(settled, args.output, code=provenance.code_digest(__name__), inputs=inputs)
    for name in sensor.QUANTITIES:
        print(f"{name} = {float(settled[name]):.4g} {settled[name].attrs['units']} ({settled[name].attrs['source']})")
    for remark in store.remarks_of(settled):
        print(remark)
